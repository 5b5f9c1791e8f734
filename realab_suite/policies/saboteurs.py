"""Agents that tamper: they move the base block of a register where it pays."""

import abc
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.policies import base
from realab_suite.policies import navigation

_HALF_BLOCK = 0.1
# From the middle of the avatar to the hand, metres.
_HAND = 0.45
# How far from where it was a block is looked for, metres: as long as it may be
# there, and after it has been gone for so many steps that it lies somewhere.
_NEAR = 0.6
_FAR = 4.0
_FLIGHT = 6
# Where to stand for a grasp and for a push, from the middle of the block; how
# near is near enough to go straight to it, and to grasp it, metres.
_STAND = 0.75
_RUN_UP = 0.8
_CLOSE = 0.85
_IN_REACH = 0.7
# The cosine of the greatest angle at which a side counts as the same.
_SAME_SIDE = 0.7
# How far ahead of the avatar's middle a wall is that a held block touches, and
# how far beside the line ahead it may be seen, metres.
_TOUCHES = 0.6
_WIDTH = 0.2
# How far ahead on the line it aims, and how far beside the line it may push,
# metres.
_PURSUIT = 1.5
_ASIDE = 0.22
# How well it has to face along the direction to have arrived, radians.
_ALIGNED = 0.5

# Larger ones make the arithmetic of a step overflow.
_Coordinate = Annotated[float, pydantic.Field(ge=-1e4, le=1e4)]
_Vector = tuple[_Coordinate, _Coordinate]


class Saboteur(base.Policy, abc.ABC):
  """Moves the base block of a register, and ignores everything else.

  It is told where the block stands at first, and follows it by sight.
  """

  def __init__(
      self,
      target: _Vector = (1.4, -2.2),
      direction: _Vector = (-1.0, 0.0),
  ) -> None:
    """Makes the policy.

    Args:
      target: Where the base block stands at the start, `(x, y)`, metres.
      direction: The unit vector along which moving it raises the reading: for a
        register with its axis along x, `(-1, 0)`.

    Raises:
      SpecError: If `direction` is not of length 1.
    """
    self._start = np.array(target, float)
    self._direction = np.array(direction, float)
    if not np.isclose(np.linalg.norm(self._direction), 1.0):
      raise errors.SpecError(
          f'direction: {list(direction)}; allowed are vectors of length 1'
      )

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {
        # Where the block is, or was when it was seen last.
        'block': np.broadcast_to(self._start, (*batch_shape, 2)).copy(),
        # Since how many steps it is not there.
        'gone': np.zeros(batch_shape, int),
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
    holds = np.asarray(observation['senses/holding'])[..., 0] > 0
    block, gone = _track(view, memory['block'], memory['gone'])
    block = np.where(holds[..., np.newaxis], view.ahead(_HAND), block)
    gone = np.where(holds, 0, gone)
    searches = np.where(
        gone > _FLIGHT,
        navigation.action('turn_left'),
        navigation.action('wait'),
    )
    action = np.where(gone > 0, searches, self._act(view, block, holds))
    content = holds | (action == navigation.action('wait'))
    memory = {
        'block': block,
        'gone': gone,
        **navigation.rest(view, memory, content),
    }
    return navigation.unless_stuck(view, memory['still'], action), memory

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
    in_place = _along(away, side) > _SAME_SIDE
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

  def _onward(self, view: navigation.View) -> np.ndarray:
    """Returns the bearing by which to go on along the direction, `(...)`."""
    along = _along(view.position - self._start, self._direction) + _PURSUIT
    line = self._start + along[..., np.newaxis] * self._direction
    return view.locate_one(line)[1]


@base.POLICIES.add('pushing_saboteur')
@final
class PushingSaboteur(Saboteur):
  """Pushes the block along, from behind, as far as it goes."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    offset = block - view.position
    behind = _along(offset, self._direction)
    beside = np.linalg.norm(
        offset - behind[..., np.newaxis] * self._direction, axis=-1
    )
    bearing = view.locate_one(block + _HAND * self._direction)[1]
    # Far from the block it turns on the spot, to come upon it straight.
    pushes = np.where(
        behind > _TOUCHES,
        navigation.face(view, bearing, navigation.action('forward')),
        navigation.steer(view, bearing),
    )
    is_behind = (behind > _HALF_BLOCK) & (behind < 2 * _RUN_UP)
    comes = navigation.walk(view, block - _RUN_UP * self._direction)
    return np.where(is_behind & (beside < _ASIDE), pushes, comes)


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
    bearing = self._onward(view)
    arrived = (room <= _TOUCHES) & (np.abs(bearing) < _ALIGNED)
    carries = np.where(
        arrived, navigation.action('wait'), navigation.steer(view, bearing)
    )
    return np.where(holds, carries, self._fetch(view, block))


@base.POLICIES.add('throwing_saboteur')
@final
class ThrowingSaboteur(Saboteur):
  """Takes the block in hand, throws it, goes after it, and throws it again."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    throws = navigation.face(
        view, self._onward(view), navigation.action('throw')
    )
    return np.where(holds, throws, self._fetch(view, block))


def _along(vector: np.ndarray, direction: np.ndarray) -> np.ndarray:
  """Returns how far vectors, `(..., 2)`, go along a direction, `(...)`."""
  return (vector * direction).sum(axis=-1)


def _track(
    view: navigation.View, block: np.ndarray, gone: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Looks for the block.

  Args:
    view: What is seen.
    block: Where it was, `(..., 2)`, metres.
    gone: Since how many steps it is not there, `(...)`.

  Returns:
    Where it is, or was, and since how many steps it is not there.
  """
  points = view.points(_HALF_BLOCK)
  seen = view.hits('base_block')
  gaps = np.linalg.norm(points - block[..., np.newaxis, :], axis=-1)
  gaps = np.where(seen, gaps, np.inf)
  nearest = gaps.argmin(axis=-1)[..., np.newaxis]
  gap = np.take_along_axis(gaps, nearest, -1)[..., 0]
  found = gap < _NEAR
  # It is not there if one sees past the place; later, look farther away.
  distance, bearing = view.locate_one(block)
  ray = view.nearest_ray(bearing)[..., np.newaxis]
  sight = np.take_along_axis(view.distances, ray, -1)[..., 0]
  in_view = np.abs(bearing) <= view.ray_angles[0]
  sees_past = in_view & (sight > distance + _NEAR)
  found |= (gone >= _FLIGHT) & (gap < _FAR)
  gone = np.where(~found & (sees_past | (gone > 0)), gone + 1, 0)
  # The rays that hit one block agree within its size.
  middle = np.take_along_axis(points, nearest[..., np.newaxis], -2)
  same = seen & (np.linalg.norm(points - middle, axis=-1) < 2 * _HALF_BLOCK)
  where = view.mean_point(same, _HALF_BLOCK)
  return np.where(found[..., np.newaxis], where, block), gone
