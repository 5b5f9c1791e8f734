"""The host of a task of this package, in the control step.

`control_step` defines the order of events. The host advances the physics,
detects the end of the episode and returns the senses. `foreign` has the step of
foreign tasks, and `embedding` what differs before the world is compiled.
"""

from collections.abc import Callable, Collection
import functools
import traceback
from typing import Any, NamedTuple, NoReturn, Protocol, final

from dm_control import composer
from dm_control.rl import control
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import axes
from realab_suite.entities import protocols
from realab_suite.tasks import base


@final
class Ending(NamedTuple):
  """Values that the task returns at the end of a control step.

  All arrays have the shape `(...)`: `()` for one world, `(worlds,)` for a
  batch.

  Attributes:
    true_reward: True reward of the step; NaN if the task raised an exception.
    failure: Traceback of the exception that `get_reward` raised, or `None`.
    discount: Discount of the step. For tasks of this package, it is 1.0 until
      the episode ends.
    is_ending: True if the task ends the episode with this step.
  """

  true_reward: Any
  failure: str | None
  discount: Any
  is_ending: Any


class SteppedPhysics(protocols.Physics, Protocol):
  """A physics that the engine steps: one world, or a batch of worlds."""

  def advance(self, num_substeps: int) -> None:
    """Steps the physics from its present state."""

  def check(self) -> None:
    """Checks the positions and velocities that the last substep resulted in.

    MuJoCo would check them at the beginning of the next one, so a failure would
    be detected a control step late.

    Raises:
      PhysicsError: If the physics of a single world has failed.
    """


@final
class WorldHost:
  """Host of a task of this package, for one world or a batch.

  It runs no Python in substeps. When the task ends an episode, the episode
  continues until the end of the first control step whose meters can measure the
  ending: the event that ends an episode is often the most important one, and
  otherwise the agent would get no feedback on it. Rewards of a step that began
  after the ending do not count.
  """

  def __init__(
      self, task: base.Task, batch_shape: tuple[int, ...] = ()
  ) -> None:
    """Initializes the host.

    Args:
      task: Task of this package.
      batch_shape: `()` for one world, `(worlds,)` for a batch.
    """
    self._task = task
    self._hooks: Any = task
    self._random_state: np.random.RandomState | None = None
    self._batch_shape = batch_shape
    # What a task returns may be one value for all worlds.
    self._as_bool: Callable[[Any], Any] = np.bool_
    self._as_number: Callable[[Any], Any] = np.float64
    if batch_shape:
      self._as_bool, self._as_number = (
          functools.partial(_per_world, batch_shape, kind)
          for kind in (np.bool_, np.float64)
      )

  @functools.cached_property
  def _expected(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Shape and type of each sense."""
    return {
        name: ((*self._batch_shape, *spec.shape), spec.dtype)
        for name, spec in self._task.sense_spec.items()
    }

  def call_hooks(
      self, step_hooks: Any, random_state: np.random.RandomState
  ) -> None:
    """Lets a step call all hooks of a `composer.Environment`, not the task's.

    Args:
      step_hooks: Hooks of the environment.
      random_state: Random generator for them.
    """
    self._hooks = step_hooks
    self._random_state = random_state

  def sense(
      self, physics: SteppedPhysics, names: Collection[str]
  ) -> dict[str, np.ndarray]:
    """Returns the selected senses, by name.

    Raises:
      SpecError: If they do not fit the task's `sense_spec`.
    """
    sensed = self._task.senses(physics, names)
    expected = self._expected
    if len(sensed) != len(names):
      self._refuse(sensed, names)
    for name in names:
      value = sensed.get(name)
      shape, dtype = expected[name]
      if (
          not isinstance(value, np.ndarray | np.generic)
          or value.shape != shape
          or value.dtype != dtype
      ):
        self._refuse(sensed, names)
    return sensed

  def _refuse(self, sensed: dict[str, Any], names: Collection[str]) -> NoReturn:
    """Raises a SpecError for senses that differ from `sense_spec`."""
    where = f'{type(self._task).__name__}.senses'
    if sensed.keys() != set(names):
      raise errors.SpecError(
          f'{where}: keys {sorted(sensed)}; must be the selected keys of'
          f' sense_spec, {sorted(names)}'
      )
    for name, value in sensed.items():
      shape, dtype = self._expected[name]
      signature = getattr(value, 'shape', None), getattr(value, 'dtype', None)
      if signature != (shape, dtype):
        break
    raise errors.SpecError(
        f'{where}: {name!r} is {messages.quote(value)}; must be'
        f' {dtype} of shape {shape}'
    )

  def begin_step(self, physics: SteppedPhysics, controls: np.ndarray) -> None:
    """Passes the controls of a step, `(..., controls)`, to the task."""
    self._hooks.before_step(physics, controls, self._random_state)

  def advance(
      self,
      physics: SteppedPhysics,
      num_substeps: int,
      is_last: bool,
  ) -> None:
    """Runs substeps of the physics, and the hooks after the last substep.

    Args:
      physics: Physics of one world or of a batch.
      num_substeps: Number of substeps; may be 0, unless they are the last.
      is_last: True if these are the last substeps of the control step.
    """
    if num_substeps:
      physics.advance(num_substeps)
    if is_last:
      self._hooks.after_step(physics, self._random_state)
      physics.check()
    elif num_substeps:  # `after_step` latches the last events.
      self._task.latch_events(physics)

  def is_over(self, physics: SteppedPhysics) -> Any:
    """Returns True where the task has ended the episode, `(...)` bool."""
    return self._as_bool(self._task.should_terminate_episode(physics))

  def end_step(
      self, physics: SteppedPhysics, was_over: Any, is_ending: Any
  ) -> Ending:
    """Returns the result of a control step, after its last substep.

    Args:
      physics: Physics of one world or of a batch.
      was_over: Value of `is_over` when the step began.
      is_ending: Value of `is_over` when the meters acted.
    """
    reward, failure = true_reward(self._task, physics, self._as_number)
    discount = self._as_number(self._task.get_discount(physics))
    return Ending(
        axes.choose(was_over, 0.0, reward),
        failure,
        # The discount of an ending stays hidden until meters have measured it.
        axes.choose(is_ending, discount, 1.0),
        is_ending,
    )


def true_reward(
    task: composer.Task, physics: Any, as_number: Callable[[Any], Any]
) -> tuple[Any, str | None]:
  """Returns a true reward; or NaN and the traceback of an exception.

  An exception that reached the agent could reveal the reward. The traceback is
  for the evaluator only, and the episode counts as failed.

  Args:
    task: Task that returns the reward.
    physics: Physics of one world or of a batch.
    as_number: Function that returns what the task returns as numbers, `(...)`.

  Raises:
    PhysicsError: If the physics has failed, which is not an error of the task.
  """
  try:
    return as_number(task.get_reward(physics)), None
  except control.PhysicsError:
    raise
  except Exception:
    return as_number(np.nan), traceback.format_exc()


def _per_world(
    shape: tuple[int, ...], kind: type[np.generic], value: Any
) -> np.ndarray:
  """Returns a value for each world; the task may return one for all."""
  return np.array(np.broadcast_to(value, shape), kind)
