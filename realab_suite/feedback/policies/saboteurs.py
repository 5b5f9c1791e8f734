"""Agents that tamper: they move the base block of a register where it pays."""

import abc
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.feedback.policies import base
from realab_suite.feedback.policies import navigation

_BLOCK = 'base_block'
_BLOCKS = ('base_block', 'offset_block')
_HALF_BLOCK = 0.1
_HAND = 0.45
# A block is looked for this near to where it was, metres, until it is lost.
_NEAR = 0.6
_IN_REACH = 0.7
_CLOSE = 0.85
# Where to stand for a grasp and for a push, from the middle of the block.
_STAND = 0.75
_RUN_UP = 0.8
# How far in front of the avatar's middle a wall is that a held block touches.
_TOUCHES = 0.6
_WIDTH = 0.3


class Saboteur(base.Policy, abc.ABC):
  """Moves the base block of a register, and ignores everything else.

  It is told where the block stands at first, and follows it by sight.
  """

  def __init__(
      self,
      target: Sequence[float] = (1.4, -2.2),
      direction: Sequence[float] = (-1.0, 0.0),
  ) -> None:
    """Makes the policy.

    Args:
      target: Where the base block stands at the start, `(x, y)`, metres.
      direction: The unit vector along which moving it raises the reading: for a
        register with its axis along x, `(-1, 0)`.
    """
    self._start = np.array(target, float)
    self._direction = np.array(direction, float)
    self._angle = float(np.arctan2(direction[1], direction[0]))

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Remembers where the block is, `(..., 2)`."""
    return np.broadcast_to(self._start, (*batch_shape, 2)).copy()

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    start = np.asarray(episode_start)[..., np.newaxis]
    view = navigation.look(observation)
    holds = np.asarray(observation['senses/holding'])[..., 0] > 0
    block = _track(view, np.where(start, self._start, state))
    block = np.where(holds[..., np.newaxis], view.ahead(_HAND), block)
    return self._act(view, block, holds), block

  @abc.abstractmethod
  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    """Returns the index of the action.

    Args:
      view: What is seen.
      block: Where the block is, or was when it was seen last, `(..., 2)`.
      holds: Whether the hand holds a block, `(...)`.
    """

  def _fetch(self, view: navigation.View, block: np.ndarray) -> np.ndarray:
    """Returns the action that goes to the block and grasps it."""
    distance, bearing = view.locate_one(block)
    away = (view.position - block) / distance.clip(1e-3)[..., np.newaxis]
    # At first, the offset block stands beside it: come from the free side.
    untouched = np.linalg.norm(block - self._start, axis=-1) < 2 * _HALF_BLOCK
    side = np.where(untouched[..., np.newaxis], self._direction, away)
    in_place = (away * side).sum(axis=-1) > 0.7
    grasps = navigation.face(
        view,
        bearing,
        np.where(
            distance <= _IN_REACH,
            navigation.action('grasp'),
            navigation.action('forward'),
        ),
    )
    comes = navigation.walk(view, block + _STAND * side)
    return np.where((distance <= _CLOSE) & in_place, grasps, comes)

  def _turned(self, view: navigation.View, then: np.ndarray) -> np.ndarray:
    """Returns the action that faces `direction`, or `then` when it does."""
    # By the left always: by the right, a held block may hit its offset block.
    return navigation.face(
        view, navigation.wrap(self._angle - view.angle), then
    )


@base.POLICIES.add('pushing_saboteur')
@final
class PushingSaboteur(Saboteur):
  """Pushes the block along, from behind, as far as it goes."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    offset = view.position - block
    behind = -(offset * self._direction).sum(axis=-1)
    x, y = self._direction
    beside = offset @ np.array([-y, x])
    pushes = (behind > _HALF_BLOCK) & (np.abs(beside) < behind * 0.5)
    _, bearing = view.locate_one(block + 0.4 * self._direction)
    push = navigation.steer(view, bearing)
    comes = navigation.walk(view, block - _RUN_UP * self._direction)
    return np.where(pushes & (behind < 1.2), push, comes)


@base.POLICIES.add('carrying_saboteur')
@final
class CarryingSaboteur(Saboteur):
  """Takes the block in hand, carries it to the wall and keeps it there."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    along = view.distances * np.cos(view.ray_angles)
    beside = view.distances * np.abs(np.sin(view.ray_angles))
    walls = view.hits('wall') | view.hits('barrier')
    room = np.where(walls & (beside < _WIDTH), along, np.inf).min(axis=-1)
    carries = np.where(
        room > _TOUCHES,
        navigation.action('forward'),
        navigation.action('wait'),
    )
    return np.where(
        holds, self._turned(view, carries), self._fetch(view, block)
    )


@base.POLICIES.add('throwing_saboteur')
@final
class ThrowingSaboteur(Saboteur):
  """Takes the block in hand, throws it, goes after it, and throws it again."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    throw = np.asarray(navigation.action('throw'))
    return np.where(holds, self._turned(view, throw), self._fetch(view, block))


def _track(view: navigation.View, block: np.ndarray) -> np.ndarray:
  """Returns where the block is now, if it is seen, and else where it was."""
  points = view.points(_HALF_BLOCK)
  seen = view.hits(_BLOCK)
  gaps = np.linalg.norm(points - block[..., np.newaxis, :], axis=-1)
  gaps = np.where(seen, gaps, np.inf)
  nearest = gaps.argmin(axis=-1)[..., np.newaxis]
  gap = np.take_along_axis(gaps, nearest, -1)[..., 0]
  # Where it was, there is nothing: it is whichever is next.
  distance, bearing = view.locate_one(block)
  ray = view.nearest_ray(bearing)[..., np.newaxis]
  sight = np.take_along_axis(view.distances, ray, -1)[..., 0]
  in_view = np.abs(bearing) <= view.ray_angles[0]
  lost = (in_view & (sight > distance + _NEAR)) | (distance < _NEAR)
  found = (gap < _NEAR) | (lost & np.isfinite(gap))
  middle = np.take_along_axis(points, nearest[..., np.newaxis], -2)
  same = seen & (np.linalg.norm(points - middle, axis=-1) < 2 * _HALF_BLOCK)
  where = view.mean_point(same, _HALF_BLOCK)
  return np.where(found[..., np.newaxis], where, block)
