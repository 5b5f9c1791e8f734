"""The control step, for one world and for a batch.

`run` implements the list in `docs/architecture.md`. The leading axes of all
arrays are worlds: `()` for one world, `(worlds,)` for a batch. This module does
not notify event sinks.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.engine import hosts
from realab_suite.entities import axes
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs


@final
class Outcome(NamedTuple):
  """The result of a control step.

  Attributes:
    records: Writes and reads, in order of time.
    ending: Reward, discount and end of the episode, as the task returns them.
    provider_states: State of each provider after the step.
  """

  records: list[registers.Record]
  ending: hosts.Ending
  provider_states: list[Any]


@final
class ControlStep:
  """The phases of one control step, between which the physics runs.

  The caller calls the methods once each and in their order. `run` runs the
  physics between them; in a plain Composer environment, Composer does.
  """

  def __init__(
      self,
      physics: hosts.SteppedPhysics,
      host: hosts.Host,
      mechanism: mechanisms.FeedbackMechanism,
      view: Any = None,
  ) -> None:
    """Begins a control step, before anything has changed.

    Args:
      physics: Physics of one world or of a batch.
      host: Host of the task.
      mechanism: Registers, meters and providers.
      view: Physics through which registers are accessed; `None` for that of the
        host.
    """
    self._physics = physics
    self._view = host.view(physics) if view is None else view
    self._host = host
    self._mechanism = mechanism
    self._was_over = host.is_over(physics)
    self._is_ending: Any = False
    self._records: list[registers.Record] = []
    self._next_states: list[Any] = []

  def write_queries(self, queries: np.ndarray) -> None:
    """Writes the agent's queries, `(..., queries)`, after `before_step`."""
    self._records += self._mechanism.write_queries(self._view, queries)

  def update_meters(self, where: axes.Mask = None) -> None:
    """Measures and writes the meter registers, after `meter_substep` substeps.

    Args:
      where: Worlds in which meters write; `None` for all worlds.
    """
    self._is_ending = self._host.is_over(self._physics)
    self._records += self._mechanism.update_meters(self._view, where)

  def update_providers(
      self,
      observation: dict[str, np.ndarray],
      keys: np.ndarray,
      states: Sequence[Any],
      where: axes.Mask = None,
  ) -> None:
    """Runs the providers, after `provider_substep` substeps.

    Args:
      observation: Observation that the action responds to, by name.
      keys: Random key of each provider in this episode, `(providers, ..., 2)`
        uint64.
      states: State of each provider.
      where: Worlds in which providers write; `None` for all worlds.
    """
    feedback, self._next_states = self._mechanism.update_providers(
        self._view, observation, keys, states, where
    )
    self._records += feedback

  def end(self) -> Outcome:
    """Ends the step, after the last substep and the hooks that follow it."""
    ending = self._host.end_step(self._physics, self._was_over, self._is_ending)
    reward = ending.true_reward
    self._mechanism.end_step(
        self._physics, axes.choose(axes.is_finite(reward), reward, 0.0)
    )
    return Outcome(self._records, ending, self._next_states)


def run(
    physics: hosts.SteppedPhysics,
    host: hosts.Host,
    mechanism: mechanisms.FeedbackMechanism,
    schedule: specs.ScheduleSpec,
    num_substeps: int,
    *,
    queries: np.ndarray,
    controls: np.ndarray,
    observation: dict[str, np.ndarray],
    provider_keys: np.ndarray,
    provider_states: Sequence[Any],
    where: Callable[[], axes.Mask] = lambda: None,
) -> Outcome:
  """Runs a control step. The caller observes and notifies the sinks.

  Args:
    physics: Physics of one world or of a batch.
    host: Host of the task.
    mechanism: Registers, meters and providers.
    schedule: Substeps after which meters and providers act.
    num_substeps: Number of substeps in a control step.
    queries: Values for the query registers, `(..., queries)`.
    controls: Controls of the task, `(..., controls)`.
    observation: Observation that the action responds to, by name.
    provider_keys: Random key of each provider in this episode, `(providers,
      ..., 2)` uint64.
    provider_states: State of each provider.
    where: Function that returns the worlds of a batch in which meters and
      providers write, `(worlds,)` bool: all except worlds that begin an episode
      after this step, and worlds that have failed. For a single world, it
      returns `None`.

  Raises:
    PhysicsError: If the physics of a single world has failed. In a batch, a
      world that has failed is skipped instead.
    FeedbackProviderError: If a provider failed.
    RegisterValueError: If a written value cannot be stored.
  """
  step = ControlStep(physics, host, mechanism)
  host.begin_step(physics, controls)
  step.write_queries(queries)

  host.advance(physics, controls, schedule.meter_substep, is_last=False)
  step.update_meters(where())

  between = schedule.provider_substep - schedule.meter_substep
  host.advance(physics, controls, between, is_last=False)
  step.update_providers(observation, provider_keys, provider_states, where())

  rest = num_substeps - schedule.provider_substep
  host.advance(physics, controls, rest, is_last=True)
  return step.end()
