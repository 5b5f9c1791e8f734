"""How scripted policies look around and walk, by the ray sense alone."""

from collections.abc import Mapping
import dataclasses
import functools
from typing import final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.policies import action_sets
from realab_suite.policies import base

_FIELD_OF_VIEW = np.radians(160.0)
# What is walked round, and how far the middle of the avatar stays from it,
# metres. Its radius is 0.25; blocks, which give way, get a wider berth.
_BERTHS = {
    'other': 0.3,
    'wall': 0.3,
    'barrier': 0.3,
    'door': 0.3,
    'pad': 0.34,
    'pressed_pad': 0.34,
    'base_block': 0.42,
    'offset_block': 0.42,
}
_BERTH = np.array([_BERTHS.get(name, -1.0) for name in appearance.CLASSES])
# What is nearer than its berth already is passed at this part of its distance,
# but no nearer than this, metres.
_SQUEEZE = 0.85
_TIGHT = 0.28
# How far ahead the way has to be free, metres: usually, at least, for a bend.
_LOOKAHEAD = 1.0
_CLEARANCE = 0.4
_ROOM_TO_BEND = 0.6
# Errors of the heading: one that needs no turn, one that is turned away while
# walking, and one from which to turn left, whatever its sign, radians.
_STRAIGHT = 0.16
_BEND = 0.7
_RIGHT_BEHIND = 2.6
# For how long the avatar keeps turning as it does now, seconds.
_COAST = 0.045
# What a turn away from ahead costs, in turns away from the target; what a way
# costs that is not free: more than any turn.
_PREFER_AHEAD = 0.15
_BLOCKED = 100.0
# Who is so many steps in a place this small, metres, is stuck, or even jammed;
# half a turn takes 11.
_SMALL = 0.3
_STUCK = 16
_JAMMED = 40
_ESCAPES = ('backward', 'strafe_left', 'strafe_right', 'forward_turn_left')
_ESCAPE_STEPS = 4


@final
@dataclasses.dataclass(frozen=True)
class View:
  """What a policy sees; leading axes of every array are worlds.

  Attributes:
    position: Where the avatar is, `(..., 2)`, metres.
    angle: The way it faces, `(...)`, radians.
    coast: By how much it will turn before a command is obeyed, `(...)`,
      radians.
    distances: How far each ray gets, `(..., rays)`, metres.
    classes: What each ray hits, `(..., rays)`.
    free: How far the avatar can walk along each ray, `(..., rays)`, metres.
  """

  position: np.ndarray
  angle: np.ndarray
  coast: np.ndarray
  distances: np.ndarray
  classes: np.ndarray
  free: np.ndarray

  @property
  def ray_angles(self) -> np.ndarray:
    """How far to the left of ahead each ray points, `(rays,)`, radians."""
    return _ray_angles(self.distances.shape[-1])

  def hits(self, name: str) -> np.ndarray:
    """Returns which rays hit something of a class, `(..., rays)`, bool."""
    return self.classes == appearance.code(name)

  def points(self, depth: float) -> np.ndarray:
    """Returns where rays would end that went on for `depth` metres.

    Args:
      depth: From the surface that is seen to the middle of the thing, metres.

    Returns:
      `(..., rays, 2)`, metres.
    """
    angles = self.angle[..., np.newaxis] + self.ray_angles
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    reach = (self.distances + depth)[..., np.newaxis]
    return self.position[..., np.newaxis, :] + reach * directions

  def ahead(self, distance: float) -> np.ndarray:
    """Returns the place that is so far straight ahead, `(..., 2)`, metres."""
    direction = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
    return self.position + distance * direction

  def mean_point(self, hit: np.ndarray, depth: float) -> np.ndarray:
    """Returns the mean of `points(depth)` of some rays, `(..., 2)`.

    Args:
      hit: Which rays, `(..., rays)`; the mean of none is the origin.
      depth: See `points`.
    """
    total = (self.points(depth) * hit[..., np.newaxis]).sum(axis=-2)
    return total / np.maximum(hit.sum(axis=-1), 1)[..., np.newaxis]

  def locate(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns where places are from here.

    Args:
      places: `(..., places, 2)`, metres.

    Returns:
      How far they are, metres, and how far to the left of ahead, radians in
      [-pi, pi), each `(..., places)`.
    """
    offsets = places - self.position[..., np.newaxis, :]
    directions = np.arctan2(offsets[..., 1], offsets[..., 0])
    return (
        np.linalg.norm(offsets, axis=-1),
        wrap(directions - self.angle[..., np.newaxis]),
    )

  def locate_one(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Does what `locate` does, for one place, `(..., 2)`."""
    distance, bearing = self.locate(place[..., np.newaxis, :])
    return distance[..., 0], bearing[..., 0]

  def nearest_ray(self, bearing: np.ndarray) -> np.ndarray:
    """Returns the index of the ray that points most nearly to a bearing."""
    angles = self.ray_angles
    index = np.rint((angles[0] - bearing) / (angles[0] - angles[1]))
    return index.clip(0, len(angles) - 1).astype(int)


def view(observation: base.Observation) -> View:
  """Returns what there is to see."""

  def get(name: str) -> np.ndarray:
    return np.asarray(observation[f'senses/{name}'], float)

  x, y = np.moveaxis(get('heading'), -1, 0)
  distances = get('ray_distances')
  classes = np.asarray(observation['senses/ray_classes'])
  return View(
      position=get('position'),
      angle=np.arctan2(y, x),
      coast=_COAST * get('velocity')[..., 2],
      distances=distances,
      classes=classes,
      free=_free_way(distances, classes),
  )


@functools.cache
def _ray_angles(num_rays: int) -> np.ndarray:
  half = _FIELD_OF_VIEW / 2
  return np.linspace(half, -half, num_rays)


def wrap(angle: np.ndarray) -> np.ndarray:
  """Returns the same angle in [-pi, pi)."""
  return (angle + np.pi) % (2 * np.pi) - np.pi


def _free_way(distances: np.ndarray, classes: np.ndarray) -> np.ndarray:
  """Returns how far the avatar can walk along each ray, `(..., rays)`."""
  berths = np.minimum(
      _BERTH[classes], np.maximum(_SQUEEZE * distances, _TIGHT)
  )[..., np.newaxis, :]
  cosines, sines = _between_rays(distances.shape[-1])
  distances = distances[..., np.newaxis, :]
  in_way = (distances * sines < berths) & (cosines > 0)
  return np.where(in_way, distances * cosines, np.inf).min(axis=-1)


@functools.cache
def _between_rays(num_rays: int) -> tuple[np.ndarray, np.ndarray]:
  """Cosine and absolute sine of the angle between any two rays."""
  angles = _ray_angles(num_rays)
  between = angles[:, np.newaxis] - angles
  return np.cos(between), np.abs(np.sin(between))


def walk(
    view: View, target: np.ndarray, reach: np.ndarray | float = 0.0
) -> np.ndarray:
  """Returns the index of the action that goes to a place, round what is solid.

  Args:
    view: What is seen.
    target: The place, `(..., 2)`, metres.
    reach: How far from the place what is solid is in the way no more, metres.
  """
  free = view.free
  distance, bearing = view.locate_one(target)
  # Which way the avatar will face when it obeys.
  ahead = np.broadcast_to(view.coast, bearing.shape)[..., np.newaxis]
  needed = np.clip(distance - reach, _CLEARANCE, _LOOKAHEAD)
  is_free = free >= needed[..., np.newaxis]
  cost = (
      np.abs(wrap(view.ray_angles - bearing[..., np.newaxis]))
      + _PREFER_AHEAD * np.abs(view.ray_angles - ahead)
      + np.where(is_free, 0.0, _BLOCKED - free.clip(0.0, _LOOKAHEAD))
  )
  best = cost.argmin(axis=-1)[..., np.newaxis]
  # What is behind is turned to first; nothing is known of it.
  behind = np.abs(bearing) > view.ray_angles[0]
  way = np.where(behind, bearing, view.ray_angles[best[..., 0]]) - view.coast
  room = np.take_along_axis(free, view.nearest_ray(ahead), -1)[..., 0]
  clear = (room >= np.minimum(needed, _ROOM_TO_BEND)) & ~behind
  return _head(way, clear)


def face(view: View, bearing: np.ndarray, then: np.ndarray | int) -> np.ndarray:
  """Returns the index of the action that turns to a bearing, or of the next.

  Args:
    view: What is seen.
    bearing: How far to the left of ahead, `(...)`, radians.
    then: The index of the action for when the avatar faces that way.
  """
  error = bearing - view.coast
  turn = _head(error, np.zeros(error.shape, bool))
  return np.where(np.abs(error) <= _STRAIGHT, then, turn)


def steer(view: View, bearing: np.ndarray) -> np.ndarray:
  """Returns the index of the action that walks to a bearing, come what may."""
  error = bearing - view.coast
  return _head(error, np.ones(error.shape, bool))


def _head(error: np.ndarray, clear: np.ndarray) -> np.ndarray:
  """Turns by an angle, walking as well where the way ahead is clear."""
  # Right behind is to the left, lest it turns to and fro.
  left = (error > 0) | (error < -_RIGHT_BEHIND)
  turn = np.where(left, action('turn_left'), action('turn_right'))
  bend = np.where(
      left, action('forward_turn_left'), action('forward_turn_right')
  )
  walks = np.where(np.abs(error) <= _STRAIGHT, action('forward'), bend)
  return np.where(clear & (np.abs(error) < _BEND), walks, turn)


def restarted(
    episode_start: np.ndarray,
    initial: Mapping[str, np.ndarray],
    memory: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
  """Returns `memory`, or `initial` in the worlds where an episode starts.

  Args:
    episode_start: In which worlds, `(...)`, bool.
    initial: What one world begins with.
    memory: What each world remembers; its leading axes are worlds.
  """
  fresh = {}
  for name, value in memory.items():
    missing = (1,) * initial[name].ndim
    where = episode_start.reshape(episode_start.shape + missing)
    fresh[name] = np.where(where, initial[name], value)
  return fresh


def initial_rest(batch_shape: tuple[int, ...]) -> dict[str, np.ndarray]:
  """Returns the part of a memory that tells who is stuck."""
  return {
      # Steps since it left the small place around the anchor.
      'still': np.zeros(batch_shape, int),
      'anchor': np.full((*batch_shape, 2), np.inf),
  }


def rest(
    view: View, memory: Mapping[str, np.ndarray], content: np.ndarray
) -> dict[str, np.ndarray]:
  """Returns what `initial_rest` describes, after a look.

  Args:
    view: What is seen.
    memory: What is remembered.
    content: Whether all is well where it is, `(...)`, bool.
  """
  moved = view.locate_one(memory['anchor'])[0] > _SMALL
  fresh = moved | content
  return {
      'still': np.where(fresh, 0, memory['still'] + 1),
      'anchor': np.where(
          fresh[..., np.newaxis], view.position, memory['anchor']
      ),
  }


def unless_stuck(
    view: View, still: np.ndarray, action_: np.ndarray
) -> np.ndarray:
  """Returns `action_`, or where it is stuck an action that frees it."""
  free = view.free.clip(0.0, 2 * _LOOKAHEAD)
  # Where there is most room; of equal ones, that which is most nearly ahead.
  best = (free - 0.1 * np.abs(view.ray_angles)).argmax(axis=-1)
  ahead = view.nearest_ray(view.coast[..., np.newaxis])
  room = np.take_along_axis(free, ahead, -1)[..., 0]
  leave = _head(view.ray_angles[best] - view.coast, room >= _ROOM_TO_BEND)
  # It sees nothing of where these lead, so they come last.
  blind = np.array([action(name) for name in _ESCAPES])
  turn = (still - _JAMMED) // _ESCAPE_STEPS % len(blind)
  return np.where(
      still < _STUCK, action_, np.where(still < _JAMMED, leave, blind[turn])
  )


@functools.cache
def action(name: str) -> int:
  """Returns the index of an action by its name."""
  return action_sets.DMLAB_LIKE.index(name)
