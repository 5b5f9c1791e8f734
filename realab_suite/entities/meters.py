"""Meters, which write measurements of the true state to meter registers."""

from collections.abc import Callable, Iterator
import dataclasses
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
import numpy as np

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities import registers

_Measure = Callable[[Any], np.ndarray]


@final
@dataclasses.dataclass(frozen=True)
class Instrument:
  """A measurement that something can obstruct, such as a line of sight.

  A task or a measurement may return one in place of a function.

  Attributes:
    measured: Function of the physics that returns the measurement, `(...)`.
    ideal: Function that returns the measurement without obstruction, `(...)`.
      It is the clean content of the meter register, and a secure register gets
      it in place of `measured`.
  """

  measured: _Measure
  ideal: _Measure

  def __call__(self, physics: protocols.Physics) -> np.ndarray:
    return self.measured(physics)


@final
class Unseen(observable.Generic):
  """An observable for evaluators, which no agent of this package gets."""


@final
class Meter(modelled.ModelledEntity):
  """Measures the true state of the world and writes it to a meter register.

  The measurement itself cannot be influenced, unless it is an `Instrument`. The
  meter register can be, like any other register (paper, sections 3.1 and 4.4).

  It has an observable, which is disabled by default: `measured_` and the name
  of the register. A mechanism decides when its meters measure. A meter that is
  attached by itself, as in `arena.attach(meter)`, does so at the end of each
  control step of `composer.Environment`, after the task and before providers.
  """

  def _build(
      self,
      measurement: _Measure,
      register: registers.Register,
      mjcf_model: mjcf.RootElement | None = None,
  ) -> None:
    """Connects a measurement to a register.

    Args:
      measurement: Function of the physics that returns values of shape `(...)`.
      register: Meter register to write the measured values to.
      mjcf_model: Model that the meter is a part of, because it has no body;
        `None` for one of its own, which can be attached.
    """
    self._ideal: _Measure | None = None
    if isinstance(measurement, Instrument):
      if register.channel == 'secure':
        measurement = measurement.ideal
      else:
        self._ideal = measurement.ideal
    self._measurement: _Measure = measurement
    self._register = register
    self._mjcf_root = mjcf_model or mjcf.RootElement(
        model=f'meter_{register.name}'
    )
    self._hooks = MeterHooks(self) if mjcf_model is None else None

  def iter_entities(
      self, exclude_self: bool = False
  ) -> Iterator[composer.Entity]:
    """Yields the meter, and its hooks if it is in no mechanism."""
    yield from super().iter_entities(exclude_self)
    if self._hooks is not None:
      yield self._hooks

  def _build_observables(self) -> composer.Observables:
    observables = super()._build_observables()
    observables.add_observable(
        f'measured_{self._register.name}',
        Unseen(self.measure),
        enabled=False,
    )
    return observables

  @property
  def register(self) -> registers.Register:
    """Meter register that the meter writes."""
    return self._register

  def measure(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value to write, `(...)`, in the register's units.

    Args:
      physics: One world or a batch of worlds.
    """
    return np.array(self._measurement(physics), np.float64)[()]

  @property
  def can_be_obstructed(self) -> bool:
    """True for an instrument whose register is not secure."""
    return self._ideal is not None

  def ideal(self, physics: protocols.Physics) -> np.ndarray | None:
    """Returns the ideal measurement of an instrument.

    Args:
      physics: One world or a batch of worlds.

    Returns:
      The value, `(...)`; `None` if nothing can obstruct the measurement.
    """
    if self._ideal is None:
      return None
    return np.array(self._ideal(physics), np.float64)[()]

  def update(
      self, physics: protocols.Physics, where: axes.Mask = None
  ) -> tuple[np.ndarray, np.ndarray]:
    """Measures once and writes the measured value to the register.

    Args:
      physics: One world or a batch of worlds.
      where: Worlds whose register is written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Measured value and applied value, each `(...)`, in the register's units.

    Raises:
      RegisterValueError: If the register cannot store a measured value.
    """
    measured = self.measure(physics)
    return measured, self._register.write(physics, measured, where)


@final
class MeterHooks(composer.Entity):
  """Lets a meter measure at the end of each control step of Composer."""

  def _build(self, meter: Meter) -> None:
    self._meter = meter
    self._is_due = False

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._meter.mjcf_model

  def after_compile(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Checks a newly compiled world.

    Raises:
      SpecError: If another meter writes the register.
    """
    del physics, random_state
    register = self._meter.register
    writers = [
        entity
        for entity in modelled.entities_beside(self._meter)
        if isinstance(entity, Meter) and entity.register is register
    ]
    if len(writers) > 1:
      raise errors.SpecError(
          f'meter: register {register.name!r} has {len(writers)} meters in the'
          ' world; must have one'
      )

  def before_step(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    del physics, random_state
    self._is_due = True

  def after_step(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    del random_state
    self.measure_once(physics)

  def measure_once(self, physics: protocols.Physics) -> None:
    """Measures, unless the meter has done so in this control step.

    Providers call it, because Composer may call their hooks first.
    """
    if self._is_due:
      self._is_due = False
      self._meter.update(physics)
