"""What an agent senses of a world, by declared name."""

import abc
import collections
from collections.abc import Mapping
from typing import Any, final

from dm_control import composer
from dm_control.composer import observation as composer_observation
from dm_env import specs
import numpy as np

from realab_suite.feedback import mechanism as feedback_mechanism
from realab_suite.tasks import base

# How much of an episode is left, from 1 to 0.
TIME_LEFT = 'senses/time_left'


def observe(
    sensed: Mapping[str, np.ndarray],
    mechanism: feedback_mechanism.FeedbackMechanism,
    physics: Any,
    max_steps: int | None,
) -> tuple[dict[str, np.ndarray], list[feedback_mechanism.Read]]:
  """Returns what an agent observes, and what was read off registers for it.

  Args:
    sensed: What it senses; the arrays become part of the observation.
    mechanism: What it reads registers of.
    physics: One world, or many.
    max_steps: After how many control steps an episode is cut off, or `None`.
  """
  observation = {f'senses/{name}': value for name, value in sensed.items()}
  if max_steps is not None:
    spent = mechanism.step_count(physics) / max_steps
    observation[TIME_LEFT] = np.asarray(1.0 - spent, np.float32)
  reads = mechanism.read_for_agent(physics)
  for read in reads:
    observation[f'registers/{read.register}'] = np.array(read.reading)
  return observation, reads


class Senses(abc.ABC):
  """The part of an observation that is not feedback."""

  @property
  @abc.abstractmethod
  def spec(self) -> dict[str, specs.Array]:
    """What is sensed, by name; the names are the allowlist."""

  @abc.abstractmethod
  def sense(self, physics: Any) -> dict[str, np.ndarray]:
    """Returns what is sensed now; the arrays are the caller's."""

  def restart(  # noqa: B027 - most senses need not know.
      self, physics: Any, random_state: Any
  ) -> None:
    """Begins an episode."""

  def begin_step(self) -> None:  # noqa: B027 - most senses need not know.
    """Begins a control step."""

  def end_substep(self) -> None:  # noqa: B027 - most senses need not know.
    """Ends a substep, in worlds that ask for it."""


@final
class WorldSenses(Senses):
  """The senses of a world of this package."""

  def __init__(self, task: base.Task) -> None:
    self._task = task

  @property
  def spec(self) -> dict[str, specs.Array]:
    return self._task.sense_spec

  def sense(self, physics: Any) -> dict[str, np.ndarray]:
    return self._task.senses(physics)


@final
class ObservableSenses(Senses):
  """The observables that somebody else's task had enabled when it came.

  Enabling another one afterwards does not show it to the agent.
  """

  def __init__(self, task: composer.Task) -> None:
    enabled = collections.OrderedDict(
        (name, observable)
        for name, observable in task.observables.items()
        if observable.enabled
    )
    self._updater = composer_observation.Updater(
        enabled, task.physics_steps_per_control_step, True, False
    )

  @property
  def spec(self) -> dict[str, specs.Array]:
    return dict(self._updater.observation_spec())

  def sense(self, physics: Any) -> dict[str, np.ndarray]:
    del physics  # The updater has looked already.
    return {
        name: np.array(value)
        for name, value in self._updater.get_observation().items()
    }

  def restart(self, physics: Any, random_state: Any) -> None:
    self._updater.reset(physics, random_state)

  def begin_step(self) -> None:
    self._updater.prepare_for_next_control_step()

  def end_substep(self) -> None:
    self._updater.update()
