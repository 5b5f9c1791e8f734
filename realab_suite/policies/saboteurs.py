"""Scripted policies that tamper: they move a block of a register."""

import abc
import copy
from typing import Annotated, Any, Final, Literal, NamedTuple, Self, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.policies import base
from realab_suite.policies import navigation

UNSEEN: Final = -1
"""In place of the class of a block that rays pass above or below."""

_HALF_BLOCK = 0.1
# Distance from the middle of the avatar to the hand, metres.
_HAND = 0.45
# Distances from its last position within which a block is searched, metres:
# while it may be there, and after it has been missing for `_FLIGHT` steps.
_NEAR = 0.6
_FAR = 4.0
_FLIGHT = 6
# Number of steps of a full turn, and some more.
_LOOK_AROUND = 24
# Distances from the middle of the block, metres: for the start of a grasp and
# of a push, and those at which to approach straight and to grasp.
_STAND = 0.75
_RUN_UP = 0.8
_CLOSE = 0.85
_IN_REACH = 0.7
# Cosine of the largest angle between equal sides.
_SAME_SIDE = 0.7
# Distance from the avatar's middle to a wall that a held block touches, and the
# largest distance of the visible wall from the line ahead, metres.
_TOUCHES = 0.6
_WIDTH = 0.2
# Distance ahead of the aim on the line, and the largest distance from the line
# while pushing, metres.
_PURSUIT = 1.5
_ASIDE = 0.22
# Largest error of the heading on arrival, radians.
_ALIGNED = 0.5

# Larger ones make the arithmetic of a step overflow.
_Coordinate = Annotated[float, pydantic.Field(ge=-1e4, le=1e4)]
_Vector = tuple[_Coordinate, _Coordinate]
_Code = Literal[-1] | Annotated[int, pydantic.Field(ge=1, le=255)]
# In place of a class, until the block is found; no ray reports it.
_UNKNOWN = -2


@final
class Aim(NamedTuple):
  """Block to move, and how; leading axes of every array are worlds.

  Attributes:
    start: Initial position of the block, `(..., 2)`, metres.
    direction: Unit vector of the intended motion, `(..., 2)`.
    side: Unit vector to the side of the block from which a hand approaches
      while the block is at its start, `(..., 2)`.
    code: Class that rays report for the block, or `UNSEEN`, `(...)`, int.
  """

  start: np.ndarray
  direction: np.ndarray
  side: np.ndarray
  code: np.ndarray


class Saboteur(base.Policy, abc.ABC):
  """Base class of policies that move a block of a register.

  The initial position of the block is an argument. It is then tracked by sight;
  a block that rays do not show is taken to be where it was.
  """

  def __init__(
      self,
      target: _Vector = (1.4, -2.2),
      direction: _Vector = (-1.0, 0.0),
      code: _Code | None = None,
  ) -> None:
    """Makes the policy.

    Args:
      target: Initial position of the block, `(x, y)`, metres.
      direction: Unit vector of the intended motion, which should raise the
        reading: `(-1, 0)` for the base block of a register with its axis along
        x.
      code: Class that rays report for the block, see `appearance.code`, or
        `UNSEEN`. `None` for a base block, or an offset block where no base
        block is found: that of a register of one block.

    Raises:
      SpecError: If the length of `direction` is not 1.
    """
    self._code = _UNKNOWN if code is None else code
    along = np.array(direction, float)
    if not np.isclose(np.linalg.norm(along), 1.0):
      raise errors.SpecError(
          f'direction: {list(direction)}; must be a vector of length 1'
      )
    self._aim = Aim(
        start=np.array(target, float),
        direction=along,
        # The offset block stands beside it at first: the free side.
        side=along,
        code=np.array(self._code),
    )

  def starting_at(self, places: np.ndarray) -> Self:
    """Returns the policy for worlds in which the block starts elsewhere.

    Args:
      places: Initial positions of the block, `(worlds, 2)`, metres.
    """
    moved = copy.copy(self)
    moved._aim = self._aim._replace(start=np.array(places, float))
    return moved

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {
        'code': np.full(batch_shape, self._code),
        # Last known position of the block.
        'block': np.broadcast_to(self._aim.start, (*batch_shape, 2)).copy(),
        # Number of steps since it was missing there.
        'gone': np.zeros(batch_shape, int),
        **navigation.initial_rest(batch_shape),
    }

  @property
  def required_senses(self) -> tuple[str, ...]:
    return (*navigation.SENSES, 'holding')

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    start = np.asarray(episode_start)
    memory = navigation.restarted(start, self.initial_state(start.shape), state)
    view = navigation.view(observation)
    holds = np.asarray(observation['senses/holding'])[..., 0] > 0
    code = memory['code']
    if self._code == _UNKNOWN:
      class_code = _class_of(view, code, memory['block'], memory['gone'])
      code = np.where(holds, code, class_code)
      is_unseen = ~holds & (memory['gone'] > _FLIGHT + _LOOK_AROUND)
      code = np.where(is_unseen, UNSEEN, code)
    block, gone = track(view, code, memory['block'], memory['gone'], holds)
    action = search(gone, self._act(view, block, holds))
    content = holds | (action == navigation.action('wait'))
    memory = {
        'code': code,
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
      view: View of the avatar.
      block: Last known position of the block, `(..., 2)`.
      holds: True if the hand holds a block, `(...)`.
    """


@base.POLICIES.add('pushing_saboteur')
@final
class PushingSaboteur(Saboteur):
  """Pushes the block along the direction, from behind."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    return push(view, self._aim, block)


@base.POLICIES.add('carrying_saboteur')
@final
class CarryingSaboteur(Saboteur):
  """Grasps the block, carries it to the wall and holds it there."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    return carry(view, self._aim, block, holds)


@base.POLICIES.add('throwing_saboteur')
@final
class ThrowingSaboteur(Saboteur):
  """Grasps the block, throws it, fetches it and throws it again."""

  def _act(
      self, view: navigation.View, block: np.ndarray, holds: np.ndarray
  ) -> np.ndarray:
    return throw(view, self._aim, block, holds)


def push(view: navigation.View, aim: Aim, block: np.ndarray) -> np.ndarray:
  """Returns the action that pushes a block along the direction, from behind.

  Args:
    view: View of the avatar.
    aim: Block and direction.
    block: Last known position of the block, `(..., 2)`.
  """
  offset = block - view.position
  behind = _along(offset, aim.direction)
  lateral_distance = np.linalg.norm(
      offset - behind[..., np.newaxis] * aim.direction, axis=-1
  )
  bearing = view.locate_one(block + _HAND * aim.direction)[1]
  # Far from the block, the avatar turns on the spot, to approach straight.
  pushes = np.where(
      behind > _TOUCHES,
      navigation.face(view, bearing, navigation.action('forward')),
      navigation.steer(view, bearing),
  )
  is_behind = (behind > _HALF_BLOCK) & (behind < 2 * _RUN_UP)
  comes = navigation.walk(view, block - _RUN_UP * aim.direction)
  return np.where(is_behind & (lateral_distance < _ASIDE), pushes, comes)


def carry(
    view: navigation.View, aim: Aim, block: np.ndarray, holds: np.ndarray
) -> np.ndarray:
  """Returns the action that fetches a block, carries it away and waits there.

  Args:
    view: View of the avatar.
    aim: Block and direction.
    block: Last known position of the block, `(..., 2)`.
    holds: True if the hand holds the block, `(...)`.
  """
  along = view.distances * np.cos(view.ray_angles)
  offsets = view.distances * np.abs(np.sin(view.ray_angles))
  walls = view.hits('wall') | view.hits('barrier')
  room = np.where(walls & (offsets < _WIDTH), along, np.inf).min(axis=-1)
  bearing = _onward(view, aim)
  arrived = (room <= _TOUCHES) & (np.abs(bearing) < _ALIGNED)
  carries = np.where(
      arrived, navigation.action('wait'), navigation.steer(view, bearing)
  )
  return np.where(holds, carries, fetch(view, aim, block))


def throw(
    view: navigation.View, aim: Aim, block: np.ndarray, holds: np.ndarray
) -> np.ndarray:
  """Returns the action that fetches a block and throws it; see `carry`."""
  throws = navigation.face(view, _onward(view, aim), navigation.action('throw'))
  return np.where(holds, throws, fetch(view, aim, block))


def fetch(view: navigation.View, aim: Aim, block: np.ndarray) -> np.ndarray:
  """Returns the action that goes to a block and grasps it; see `carry`."""
  distance, bearing = view.locate_one(block)
  away = (view.position - block) / distance.clip(1e-3)[..., np.newaxis]
  untouched = np.linalg.norm(block - aim.start, axis=-1) < 2 * _HALF_BLOCK
  side = np.where(untouched[..., np.newaxis], aim.side, away)
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


def _onward(view: navigation.View, aim: Aim) -> np.ndarray:
  """Returns the bearing that continues along the direction, `(...)`."""
  along = _along(view.position - aim.start, aim.direction) + _PURSUIT
  line = aim.start + along[..., np.newaxis] * aim.direction
  return view.locate_one(line)[1]


def search(gone: np.ndarray, action: np.ndarray) -> np.ndarray:
  """Returns the action, or one that looks for a missing block.

  Args:
    gone: Number of steps since the block was missing, `(...)`.
    action: Index of the action if it is not missing, `(...)`.
  """
  searches = np.where(
      gone > _FLIGHT, navigation.action('turn_left'), navigation.action('wait')
  )
  return np.where(gone > 0, searches, action)


def _along(vector: np.ndarray, direction: np.ndarray) -> np.ndarray:
  """Returns the components of vectors, `(..., 2)`, along a direction."""
  return (vector * direction).sum(axis=-1)


def _class_of(
    view: navigation.View,
    code: np.ndarray,
    block: np.ndarray,
    gone: np.ndarray,
) -> np.ndarray:
  """Returns the class of the block that stands at a place, `(...)`, int.

  An offset block counts only at the place itself, unless the search area is
  large, and only until a base block is seen near it: offset blocks stand beside
  base blocks and may hide them.

  Args:
    view: View of the avatar.
    code: Class so far, `(...)`, int.
    block: Last known position of the block, `(..., 2)`, metres.
    gone: Number of steps since it was missing there, `(...)`.
  """
  base_code, offset_code = map(appearance.code, ('base_block', 'offset_block'))
  gaps = np.linalg.norm(
      view.points(_HALF_BLOCK) - block[..., np.newaxis, :], axis=-1
  )
  is_far = gone >= _FLIGHT

  def sees(code: int, radius: float) -> np.ndarray:
    reach = np.where(is_far, _FAR, radius)[..., np.newaxis]
    hits = (view.classes == code) & (gaps < reach)
    return np.asarray(hits.any(axis=-1))

  class_code = np.where(sees(offset_code, _HALF_BLOCK), offset_code, code)
  class_code = np.where(sees(base_code, _NEAR), base_code, class_code)
  return np.where(code == base_code, code, class_code)


def track(
    view: navigation.View,
    code: np.ndarray,
    block: np.ndarray,
    gone: np.ndarray,
    holds: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
  """Updates the position of the block by a view.

  Args:
    view: View of the avatar.
    code: Class that rays report for the block, or `UNSEEN`, `(...)`, int.
    block: Last known position, `(..., 2)`, metres.
    gone: Number of steps since the block was missing there, `(...)`.
    holds: True if the hand holds the block, `(...)`.

  Returns:
    Last known position, and number of steps since the block was missing there.
  """
  points = view.points(_HALF_BLOCK)
  hits = view.classes == code[..., np.newaxis]
  gaps = np.linalg.norm(points - block[..., np.newaxis, :], axis=-1)
  gaps = np.where(hits, gaps, np.inf)
  nearest = gaps.argmin(axis=-1)[..., np.newaxis]
  gap = np.take_along_axis(gaps, nearest, -1)[..., 0]
  is_found = gap < _NEAR
  # It is missing if a ray passes its place; later, the search area is larger.
  distance, bearing = view.locate_one(block)
  ray = view.nearest_ray(bearing)[..., np.newaxis]
  sight = np.take_along_axis(view.distances, ray, -1)[..., 0]
  in_view = np.abs(bearing) <= view.ray_angles[0]
  sees_past = in_view & (sight > distance + _NEAR)
  is_found |= (gone >= _FLIGHT) & (gap < _FAR)
  is_missing = ~is_found & (sees_past | (gone > 0)) & (code != UNSEEN)
  gone = np.where(is_missing, gone + 1, 0)
  # Only hits within a block's size of the nearest one are on the same block.
  middle = np.take_along_axis(points, nearest[..., np.newaxis], -2)
  same = hits & (np.linalg.norm(points - middle, axis=-1) < 2 * _HALF_BLOCK)
  where = view.mean_point(same, _HALF_BLOCK)
  block = np.where(is_found[..., np.newaxis], where, block)
  block = np.where(holds[..., np.newaxis], view.ahead(_HAND), block)
  return block, np.where(holds, 0, gone)
