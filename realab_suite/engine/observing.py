"""Observations: the agent's senses and the readings of registers."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, final

from dm_control import composer
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import meters
from realab_suite.entities import protocols
from realab_suite.entities import registers
from realab_suite.feedback import clean_contents
from realab_suite.feedback import mechanisms
from realab_suite.feedback import providers
from realab_suite.policies import base as policies_base
from realab_suite.tasks import base

Sense = Callable[[Any, Collection[str]], dict[str, np.ndarray]]

TIME_LEFT = 'time_left'
"""Sense with the remaining share of the episode, from 1 to 0."""

_REMEDY = "with 'senses: own', a provider gets them from the state of the world"


@final
class Observer:
  """Makes the observations of one world or of a batch.

  Observations contain the keys `senses/<name>` of the selected senses and
  `registers/<name>` of the registers that agents read. Other keys are never
  added, and senses that are not selected are not computed.
  """

  def __init__(
      self,
      task: composer.Task,
      sense_spec: Mapping[str, specs.Array],
      sense: Sense,
      mechanism: mechanisms.FeedbackMechanism,
      max_steps: int | None,
      senses: Sequence[str] | None = None,
  ) -> None:
    """Initializes the observer.

    Args:
      task: Task of this package, or a foreign one.
      sense_spec: Specs of the senses that it offers, by name.
      sense: Function that returns new arrays with senses of these names.
      mechanism: Registers, meters and providers.
      max_steps: Maximum length of an episode in control steps, or `None`.
      senses: Names of the selected senses, in any order; `None` for the default
        senses of the task and the time left.

    Raises:
      SpecError: If the world does not offer a sense, if a provider needs a
        sense that is not selected, if nothing would be observed, or if the task
        has a sense called `time_left` and `max_steps` is not `None`.
    """
    self._sense_of_task = sense
    self._mechanism = mechanism
    self._phases = mechanism.phases
    self._max_steps = max_steps
    if max_steps is not None and TIME_LEFT in sense_spec:
      raise errors.SpecError(
          f'the task has its own observable {TIME_LEFT!r}; rename it, or pass'
          ' max_steps=None'
      )
    offered = dict(sense_spec)
    default = [*sense_spec]
    if isinstance(task, base.Task):
      default = [*task.default_senses]
    if max_steps is not None:
      offered[TIME_LEFT] = specs.BoundedArray((), np.float32, 0.0, 1.0)
      default.append(TIME_LEFT)
    selected = default if senses is None else senses
    refuse_unknown(selected, offered)
    # In the order of the specs, whatever the order of the selection.
    self._specs = {n: spec for n, spec in offered.items() if n in selected}
    self._keys = {
        name: f'senses/{name}' for name in self._specs if name in sense_spec
    }
    self._has_time_left = len(self._keys) < len(self._specs)
    if senses is not None and not (self._specs or mechanism.read_by_agent):
      raise errors.SpecError(
          'senses: none are selected, and the agent reads no register; must'
          f' be among {list(offered)}'
      )
    privileged = {
        f'privileged/{n}': function
        for n, function in getattr(task, 'privileged_senses', {}).items()
    }
    for i, provider in enumerate(mechanism.design.providers):
      is_own = provider.senses == providers.OWN
      policies_base.check_senses(
          f'design {mechanism.design.name!r}: providers[{i}]:{provider.kind}',
          provider.sensed,
          [*offered, *privileged] if is_own else self._specs,
          'offered by this world' if is_own else 'selected',
          '' if is_own else f'; {_REMEDY}',
      )
    # What providers sense and the agent does not.
    added = [n for n in mechanism.own_senses if n not in self._specs]
    self._added = {n: f'senses/{n}' for n in added if n in sense_spec}
    self._adds_time_left = TIME_LEFT in added and TIME_LEFT not in sense_spec
    self._privileged = {n: f for n, f in privileged.items() if n in added}

  @property
  def senses(self) -> tuple[str, ...]:
    """Names of the selected senses."""
    return tuple(self._specs)

  def spec(self) -> dict[str, specs.Array]:
    """Returns a new dict with the observation spec of one world, by key."""
    spec = {
        f'senses/{name}': part.replace(name=f'senses/{name}')
        for name, part in self._specs.items()
    }
    for name in self._mechanism.read_by_agent:
      key = f'registers/{name}'
      spec[key] = specs.Array((), np.float64, name=key)
    return spec

  def layout(self) -> dict[str, str]:
    """Returns the data type and shape of each entry, for snapshots."""
    return {
        key: f'{spec.dtype} {spec.shape}' for key, spec in self.spec().items()
    }

  def observe(
      self, physics: protocols.Physics
  ) -> tuple[dict[str, np.ndarray], list[registers.Read]]:
    """Makes an observation.

    Args:
      physics: Physics of one world or of a batch.

    Returns:
      The observation, with arrays of shape `(..., *spec.shape)` by key, and the
      reads of registers for it.
    """
    observation = self._sense(physics, self._keys, self._has_time_left)
    reads = self._phases.read_for_agent(physics)
    for read in reads:
      observation[f'registers/{read.register}'] = np.array(read.reading)
    return observation, reads

  def for_providers(
      self, physics: protocols.Physics, observation: dict[str, np.ndarray]
  ) -> dict[str, np.ndarray]:
    """Returns an observation with what providers alone sense, by key.

    The state is that of the observation, so that a provider responds to what
    the agent does.

    Args:
      physics: Physics of one world or of a batch, before a control step.
      observation: Last observation of the agent.
    """
    if not (self._added or self._adds_time_left or self._privileged):
      return observation
    added = self._sense(physics, self._added, self._adds_time_left)
    for key, function in self._privileged.items():
      added[key] = np.array(function(physics))
      if isinstance(function, meters.Instrument):
        ideal = np.array(function.ideal(physics))
        added[clean_contents.IDEAL + key] = ideal
    return {**observation, **added}

  def _sense(
      self,
      physics: protocols.Physics,
      keys: Mapping[str, str],
      has_time_left: bool,
  ) -> dict[str, np.ndarray]:
    """Returns senses by key.

    Args:
      physics: Physics of one world or of a batch.
      keys: Keys of senses of the task, by name.
      has_time_left: True with the time that is left, which is not one of them.
    """
    senses = {}
    if keys:
      for name, value in self._sense_of_task(physics, keys).items():
        senses[keys[name]] = value
    if has_time_left:
      spent = self._mechanism.step_count(physics) / self._max_steps
      senses[f'senses/{TIME_LEFT}'] = np.asarray(1.0 - spent, np.float32)
    return senses


def refuse_unknown(selected: Sequence[str], offered: Collection[str]) -> None:
  """Raises a SpecError if a selected sense is not offered."""
  if unknown := [name for name in selected if name not in offered]:
    raise errors.SpecError(
        f'senses: unknown {messages.quote(unknown)}'
        f'{messages.did_you_mean(unknown[0], offered)}; this world offers'
        f' {list(offered)}'
    )


def frozen(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
  """Makes the arrays read-only, as providers get them, and returns them."""
  for value in observation.values():
    value.setflags(write=False)
  return observation


def copied(observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
  """Returns a copy of an observation with copies of its arrays."""
  return {key: value.copy() for key, value in observation.items()}
