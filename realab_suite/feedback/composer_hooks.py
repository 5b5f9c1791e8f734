"""Hooks that run a mechanism in a plain environment of Composer.

Composer calls the hooks of entities in the order of attachment and passes them
neither the action nor the agent's observation. A mechanism that is attached to
an arena therefore runs designs that need only registers and meters;
`suite.embed` runs all of them.

The phases run before a substep. All entities have then seen the result of the
previous one, so it does not matter whether the mechanism was attached before or
after them.
"""

from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import views
from realab_suite.feedback import specs

# Measurement of the true return, which only the task's environment gets.
_SCORE = 'score'
# More substeps than any control step has.
_MANY = 10**9


@final
class ComposerHooks(composer.Entity):
  """Runs the phases of a mechanism from Composer's hooks.

  It has the state of the current episode that is not physical: the states and
  random keys of the providers.
  """

  def _build(self, mechanism: Any, num_substeps: int | None) -> None:
    """Makes the hooks of a mechanism.

    Args:
      mechanism: The `FeedbackMechanism`.
      num_substeps: Number of substeps in a control step, if it is known.
    """
    self._mechanism = mechanism
    self._num_substeps = num_substeps
    self._schedule: specs.ScheduleSpec | None = None
    if num_substeps is not None or mechanism.design.schedule is not None:
      self._schedule = mechanism.design.schedule_for(num_substeps or _MANY)
    self._is_connected = False
    self._view: Any = None
    # MuJoCo's data of the world that was compiled last.
    self._data: Any = None
    # Substeps of the current control step so far.
    self._num_done = 0
    # Of the current episode; the physics contains the rest of its state.
    self._episode = -1
    self._keys: Any = None
    self._states: list[Any] = []
    self._observation: dict[str, np.ndarray] = {}

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    model: mjcf.RootElement = self._mechanism.mjcf_model
    return model

  def after_compile(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Connects the mechanism to a newly compiled world.

    Raises:
      SpecError: If the design needs what Composer does not pass to entities, or
        does not fit the world.
    """
    del random_state
    if not self._is_connected:
      self._connect()
      self._is_connected = True
    self._data = physics.data.ptr
    self._view = views.View(physics)

  def initialize_episode(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del physics, random_state
    self._episode += 1
    self._keys = None
    self._states = self._mechanism.phases.initial_states(())

  def before_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Reads the registers that the agent's action responds to."""
    if self._keys is None:
      self._keys = self._draw_keys(random_state)
    self._num_done = 0
    if physics.data.ptr is not self._data:
      raise errors.SpecError(
          f'design {self._mechanism.design.name!r}: the task is in two'
          ' environments, and the registers are in the one that was made last;'
          ' make a task for each environment'
      )
    self._view.open(physics)
    self._observation = {
        f'registers/{read.register}': np.array(read.reading)
        for read in self._mechanism.phases.read_for_agent(self._view)
    }

  def before_substep(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Runs the phases that follow the substeps so far."""
    del random_state
    now, phases, view = self._num_done, self._mechanism.phases, self._view
    meter_substep, provider_substep = self._substeps
    if now not in (meter_substep, provider_substep):
      return
    view.open(physics)
    if now == meter_substep:
      phases.update_meters(view)
    if now == provider_substep:
      _, self._states = phases.update_providers(
          view, self._observation, self._keys, self._states
      )
    view.refresh()

  def after_substep(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del physics, random_state
    self._num_done += 1

  def after_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Ends the control step.

    Raises:
      SpecError: If it had another number of substeps, although the physics has
        not failed.
    """
    del random_state
    done, expected = self._num_done, self._num_substeps
    if expected is None:
      expected = max(done, self._substeps[1] + 1)
    # MuJoCo's counts of warnings show a failure, which ends a step early.
    if done != expected and not physics.data.ptr.warning.number.any():
      raise errors.SpecError(
          f'num_substeps: {expected}; must be {done}, as in a control step'
          ' of this environment'
      )
    self._mechanism.phases.end_step(physics, 0.0)

  @property
  def _substeps(self) -> tuple[int, int]:
    """Substeps after which meters and providers act."""
    if self._schedule is None:
      raise errors.SpecError(
          f'design {self._mechanism.design.name!r} has no schedule, so it needs'
          ' the number of substeps; pass'
          ' num_substeps=task.physics_steps_per_control_step to'
          ' FeedbackMechanism'
      )
    return self._schedule.meter_substep, self._schedule.provider_substep

  def _connect(self) -> None:
    """Connects the meters and enables the readings as observables.

    Raises:
      SpecError: If the design needs what entities of Composer do not get.
    """
    mechanism = self._mechanism
    name, _ = mechanism.design.name, self._substeps
    if needs := _needs(mechanism):
      raise errors.SpecError(
          f'design {name!r} needs {", ".join(needs)}, which entities of'
          ' Composer do not get; use suite.embed(task, design)'
      )
    outside = [n for n, r in mechanism.registers.items() if r.parent is None]
    if outside:
      raise errors.SpecError(
          f'design {name!r}: registers {outside} are not in the world, because'
          ' named places belong to an arena; use mechanism.attach_to(arena)'
      )
    if not mechanism.is_connected:
      mechanism.connect({})
    mechanism.observables.enable_all()

  def _draw_keys(self, random_state: np.random.RandomState) -> np.ndarray:
    """Returns the random key of each provider, `(providers, 2)` uint64.

    The generator of the task is not advanced, so its episodes stay the same.
    """
    copy = np.random.RandomState()
    copy.set_state(random_state.get_state())
    entropy = [self._episode, *copy.randint(2**31, size=4).tolist()]
    number = len(self._mechanism.design.providers)
    words = np.random.SeedSequence(entropy).generate_state(
        2 * number, np.uint64
    )
    return words.reshape(number, 2)


def _needs(mechanism: Any) -> list[str]:
  """Returns what a design needs that Composer does not pass to entities."""
  design = mechanism.design
  needs = [f'the query {name!r} of an action' for name in design.names('query')]
  if design.action_set is not None:
    needs.append('the action')
  needs += [
      f'the sense {sense!r}'
      for provider in design.providers
      for sense in provider.sensed
  ]
  needs += [
      f'the end of the episode by {name!r}'
      for name, port in design.ports.items()
      if port.ends_episode is not None
  ]
  if not mechanism.is_connected:
    needs += [
        'the score (mechanism.connect({"score": function}) offers one)'
        for meter in design.meters
        if meter.measures == _SCORE
    ]
  return list(dict.fromkeys(needs))
