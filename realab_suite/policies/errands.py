"""Errands of scripted policies: to go to the nearest place, to deliver a block.

Solvers know the places of things; see `base.Policy.privileged_senses`.
"""

import abc
from typing import Any, final

import numpy as np

from realab_suite.policies import base
from realab_suite.policies import navigation
from realab_suite.policies import recollections
from realab_suite.policies import saboteurs

# Distance from the middle of the avatar to a held block, metres.
_HAND = 0.45
# Distances of a held block from its goal, metres: at most the first before the
# hand lets go, and beyond it by the second before the avatar steps back.
_THERE = 0.12
_ASTRAY = 0.25


class Errand(base.Policy, abc.ABC):
  """Base class of solvers that decide on an action from the present moment.

  It remembers only for how long the avatar has been in a small area, and frees
  it if that is too long.
  """

  required_senses = (*navigation.SENSES, 'holding')

  @abc.abstractmethod
  def act(
      self, view: navigation.View, holds: np.ndarray, seen: base.Observation
  ) -> np.ndarray:
    """Returns the index of the action, `(...)`.

    Args:
      view: View of the avatar.
      holds: True if the hand holds a block, `(...)`.
      seen: Observation, with the privileged senses `privileged/<name>`.
    """

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return navigation.initial_rest(batch_shape)

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    start = np.asarray(episode_start)
    memory = navigation.restarted(start, self.initial_state(()), state)
    view = navigation.view(observation)
    holds = np.asarray(observation['senses/holding'])[..., 0] > 0
    action = self.act(view, holds, observation)
    is_content = action == navigation.action('wait')
    memory = navigation.rest(view, memory, is_content)
    return navigation.unless_stuck(view, memory['still'], action), memory


class Rememberer(base.Policy, abc.ABC):
  """Base class of policies that go by their senses and a recollection.

  They have an agent's own senses; see `recollections`.
  """

  required_senses = navigation.SENSES

  def __init__(self, reward: str = 'reward') -> None:
    """Makes the policy, given the register whose reading it remembers."""
    self._reading = f'registers/{reward}'

  @abc.abstractmethod
  def own_state(self, batch_shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Returns what else it remembers when an episode begins, by name."""

  @abc.abstractmethod
  def act(
      self, view: navigation.View, recalled: np.ndarray, memory: Any
  ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Returns the index of the action, `(...)`, and the next `own_state`.

    Args:
      view: View of the avatar.
      recalled: Recollection of the present, `(..., numbers)`.
      memory: State of before, in which `recollection` is that of before.
    """

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {
        **self.own_state(batch_shape),
        'recollection': recollections.initial(batch_shape),
        **navigation.initial_rest(batch_shape),
    }

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    start = np.asarray(episode_start)
    memory = navigation.restarted(start, self.initial_state(()), state)
    view = navigation.view(observation)
    recalled = recollections.recall(
        observation, self._reading, start, memory['recollection']
    )
    action, own = self.act(view, recalled, memory)
    rest = navigation.rest(view, memory, np.zeros(start.shape, bool))
    action = navigation.unless_stuck(view, rest['still'], action)
    return action, {**own, 'recollection': recalled, **rest}


@base.POLICIES.add('goal_solver')
@final
class GoalSolver(Errand):
  """Goes to the place that a task names as its goal of the moment."""

  privileged_senses = ('goal',)

  def act(
      self, view: navigation.View, holds: np.ndarray, seen: base.Observation
  ) -> np.ndarray:
    return navigation.walk(view, seen['privileged/goal'], 0.3)


def nearest(
    view: navigation.View, places: np.ndarray, counts: np.ndarray
) -> np.ndarray:
  """Returns the nearest of some places, `(..., 2)`, metres.

  Args:
    view: View of the avatar.
    places: Places, `(..., places, 2)`, metres.
    counts: Which of them count, `(..., places)` bool. If none does, the result
      is the first place.
  """
  distances = np.where(counts, view.locate(places)[0], np.inf)
  index = distances.argmin(axis=-1)[..., np.newaxis, np.newaxis]
  return np.take_along_axis(places, index, -2)[..., 0, :]


def around(
    view: navigation.View, goal: np.ndarray, ends: np.ndarray
) -> np.ndarray:
  """Returns the place to go to first, `(..., 2)`, metres.

  It is the goal, or one end of a screen that stands between.

  Args:
    view: View of the avatar.
    goal: Place to go to, `(..., 2)`, metres.
    ends: Places beyond both ends of the screen, `(..., 2, 2)`, metres.
  """

  def side(start: np.ndarray, end: np.ndarray, place: np.ndarray) -> np.ndarray:
    way, offset = end - start, place - start
    return way[..., 0] * offset[..., 1] - way[..., 1] * offset[..., 0] > 0

  here, first, last = view.position, ends[..., 0, :], ends[..., 1, :]
  is_between = (side(first, last, here) != side(first, last, goal)) & (
      side(here, goal, first) != side(here, goal, last)
  )
  ways = view.locate(ends)[0]
  ways = ways + np.linalg.norm(ends - goal[..., np.newaxis, :], axis=-1)
  is_last = ways[..., 1] < ways[..., 0]
  end = np.where(is_last[..., np.newaxis], last, first)
  return np.where(is_between[..., np.newaxis], end, goal)


def gather(
    view: navigation.View, apples: np.ndarray, reach: float = 0.45
) -> np.ndarray:
  """Returns the action that walks to the nearest apple that is left.

  Args:
    view: View of the avatar.
    apples: Positions of apples, `(..., apples, 3)`, metres; eaten ones are
      below 0.
    reach: Distance from an apple at which it is eaten, metres.
  """
  goal = nearest(view, apples[..., :2], apples[..., 2] > 0)
  return navigation.walk(view, goal, reach)


def deliver(
    view: navigation.View,
    block: np.ndarray,
    holds: np.ndarray,
    goal: np.ndarray,
) -> np.ndarray:
  """Returns the action that brings a block to a place and lets go of it.

  Args:
    view: View of the avatar.
    block: Position of the block, `(..., 2)`, metres.
    holds: True if the hand holds a block, `(...)`.
    goal: Place of the block, `(..., 2)`, metres.
  """
  away = view.position - block
  side = away / np.linalg.norm(away, axis=-1).clip(1e-3)[..., np.newaxis]
  # The start of the aim is far away, so any side of the block is as good.
  nowhere = np.full(block.shape, 1e6)
  aim = saboteurs.Aim(nowhere, side, side, np.array(saboteurs.UNSEEN))
  distance, bearing = view.locate_one(goal)
  action = navigation.action
  brings = np.where(
      distance < _HAND - _ASTRAY,
      action('backward'),
      np.where(
          distance < _HAND + _THERE,
          navigation.face(view, bearing, action('let_go')),
          navigation.steer(view, bearing),
      ),
  )
  return np.where(holds, brings, saboteurs.fetch(view, aim, block))
