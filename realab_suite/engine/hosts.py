"""Hosts: how the engine drives a task that registers are embedded in.

`control_step` says in which order things happen; a host says how the physics is
advanced, when the task is over and what is sensed. This module has the
interface and the host of this package's worlds; `foreign` has that of other
Composer tasks.
"""

import abc
from collections.abc import Callable
import traceback
from typing import Any, NamedTuple, Protocol, final

from dm_control.rl import control
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import axes
from realab_suite.entities import protocols
from realab_suite.tasks import base


@final
class Ending(NamedTuple):
  """What the task says at the end of a control step; arrays are `(...)`.

  Attributes:
    true_reward: True reward of the step; nan where the task failed to give one.
    failure: Traceback of the exception that `get_reward` raised, or `None`.
    discount: 1.0 up to the end of an episode, or the task's own.
    is_ending: Whether the task ends the episode with this step, bool.
  """

  true_reward: Any
  failure: str | None
  discount: Any
  is_ending: Any


class SteppedPhysics(protocols.Physics, Protocol):
  """A physics that the engine steps: one world, or a batch of worlds."""

  def advance(self, num_substeps: int) -> None:
    """Steps the physics from its present state."""

  def refresh(self) -> None:
    """Brings positions, velocities and what derives from them up to date."""


class Host(abc.ABC):
  """A task, as the control step drives it."""

  @property
  @abc.abstractmethod
  def sense_spec(self) -> dict[str, specs.Array]:
    """Specs of the agent's senses, by name; the names are the allowlist."""

  @abc.abstractmethod
  def sense(self, physics: SteppedPhysics) -> dict[str, np.ndarray]:
    """Returns the agent's senses, by name; the arrays are the caller's."""

  @abc.abstractmethod
  def begin_step(self, physics: SteppedPhysics, controls: np.ndarray) -> None:
    """Hands the controls of a step to the task, `(..., controls)`."""

  @abc.abstractmethod
  def advance(
      self,
      physics: SteppedPhysics,
      controls: np.ndarray,
      num_substeps: int,
      is_last: bool,
  ) -> None:
    """Steps the physics.

    Args:
      physics: One world, or many.
      controls: Controls of this step, `(..., controls)`.
      num_substeps: Number of substeps; may be 0.
      is_last: Whether the step is over then.
    """

  @abc.abstractmethod
  def is_over(self, physics: SteppedPhysics) -> Any:
    """Returns whether the episode is over, as far as meters can tell, bool."""

  @abc.abstractmethod
  def end_step(
      self, physics: SteppedPhysics, was_over: Any, is_ending: Any
  ) -> Ending:
    """Ends a control step.

    Args:
      physics: One world, or many.
      was_over: Value of `is_over` when the step began.
      is_ending: Value of `is_over` when the meters acted.
    """


class StepHooks(Protocol):
  """The hooks of a control step: a task's, or a task's and its entities'."""

  def before_step(
      self, physics: SteppedPhysics, action: Any, random_state: Any
  ) -> None:
    """Takes the controls."""

  def after_step(self, physics: SteppedPhysics, random_state: Any) -> None:
    """Ends the step."""


@final
class WorldHost(Host):
  """A world of this package: one of them, or many in a batch.

  There is no Python in a substep. An episode that the task ends is over with
  the control step whose meters can measure the end: what ends an episode is
  often what matters most, and feedback on it would otherwise never reach the
  agent. Rewards of a step that began after the end do not count.
  """

  def __init__(
      self,
      task: base.Task,
      hooks: StepHooks,
      random_state: np.random.RandomState | None,
      batch_shape: tuple[int, ...],
  ) -> None:
    """Makes the host.

    Args:
      task: The world.
      hooks: The task itself, or all hooks of a `composer.Environment`.
      random_state: Generator that hooks get; `None` in a batch.
      batch_shape: `()` for one world, `(worlds,)` for many.
    """
    self._task = task
    self._hooks = hooks
    self._random_state = random_state
    self._batch_shape = batch_shape
    self._fits = {
        name: ((*batch_shape, *spec.shape), spec.dtype)
        for name, spec in task.sense_spec.items()
    }

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    return self._task.sense_spec

  def sense(self, physics: SteppedPhysics) -> dict[str, np.ndarray]:
    """Returns what the task senses.

    Raises:
      SpecError: If that does not fit the task's `sense_spec`.
    """
    sensed = self._task.senses(physics)
    if sensed.keys() != self._fits.keys():
      raise errors.SpecError(
          f'{type(self._task).__name__}.senses: keys {sorted(sensed)}; allowed'
          f' are those of sense_spec, {sorted(self._fits)}'
      )
    for name, value in sensed.items():
      shape, dtype = self._fits[name]
      if np.shape(value) != shape or getattr(value, 'dtype', None) != dtype:
        raise errors.SpecError(
            f'{type(self._task).__name__}.senses: {name!r} is'
            f' {messages.quote(value)}; allowed is {dtype} of shape {shape}'
        )
    return sensed

  def begin_step(self, physics: SteppedPhysics, controls: np.ndarray) -> None:
    self._hooks.before_step(physics, controls, self._random_state)

  def advance(
      self,
      physics: SteppedPhysics,
      controls: np.ndarray,
      num_substeps: int,
      is_last: bool,
  ) -> None:
    del controls
    if num_substeps:
      physics.advance(num_substeps)
    if num_substeps and not is_last:  # `after_step` latches the last events.
      self._task.latch_events(physics)

  def is_over(self, physics: SteppedPhysics) -> Any:
    return self._in_all(self._task.should_terminate_episode(physics), bool)

  def end_step(
      self, physics: SteppedPhysics, was_over: Any, is_ending: Any
  ) -> Ending:
    self._hooks.after_step(physics, self._random_state)
    # MuJoCo checks the result of the last substep when it derives from it. If
    # that came with the observation, a failure would be noticed a step late.
    physics.refresh()
    reward, failure = true_reward(
        lambda: self._in_all(self._task.get_reward(physics), float),
        self._in_all(np.nan, float),
    )
    discount = self._in_all(self._task.get_discount(physics), float)
    return Ending(
        axes.choose(was_over, 0.0, reward),
        failure,
        # The discount of an end that meters have not measured stays hidden.
        axes.choose(is_ending, discount, 1.0),
        is_ending,
    )

  def _in_all(self, value: Any, kind: type) -> Any:
    """Returns a value for each world; the task may give one for all."""
    if not self._batch_shape:
      return np.dtype(kind).type(value)
    return np.array(np.broadcast_to(value, self._batch_shape), kind)


def true_reward(get: Callable[[], Any], unknown: Any) -> tuple[Any, str | None]:
  """Returns a true reward, or `unknown` and the traceback of an exception.

  An exception would reach the agent and tell it something about the reward.
  Only the evaluator gets the traceback, and the episode is not valid.

  Args:
    get: Returns the reward.
    unknown: Reward to return if `get` raises.

  Raises:
    PhysicsError: If the physics has failed, which is not the task's mistake.
  """
  try:
    return get(), None
  except control.PhysicsError:
    raise
  except Exception:
    return unknown, traceback.format_exc()
