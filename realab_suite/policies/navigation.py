"""Perception and walking of scripted policies, by the ray sense.

The module contains no policy; the functions work with any number of worlds.
"""

from collections.abc import Mapping
import dataclasses
import functools
from typing import final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.policies import action_sets
from realab_suite.policies import base

SENSES = ('ray_distances', 'ray_classes', 'velocity', 'position', 'heading')
"""Names of the senses that `view` reads."""

_FIELD_OF_VIEW = np.radians(160.0)
_NO_OBSTACLE = -1.0
# Distance between the middle of the avatar and obstacles, metres. The radius of
# the avatar is 0.25. Blocks get a wider berth, because they can be pushed.
_BERTHS = {
    appearance.WALL: 0.3,
    appearance.BARRIER: 0.3,
    appearance.DOOR: 0.3,
    appearance.PAD: 0.34,
    appearance.PRESSED_PAD: 0.34,
    appearance.BASE_BLOCK: 0.42,
    appearance.OFFSET_BLOCK: 0.42,
    appearance.NOTHING: _NO_OBSTACLE,
    appearance.APPLE: _NO_OBSTACLE,
    appearance.LARGE_APPLE: _NO_OBSTACLE,
}
# By code. Objects of all other classes may be in the way.
_BERTH = np.full(appearance.CAPACITY, 0.3)
_BERTH[[appearance.code(name) for name in _BERTHS]] = list(_BERTHS.values())
# An obstacle within its berth is passed at this fraction of its distance, but
# not closer than `_TIGHT`, metres.
_SQUEEZE = 0.85
_TIGHT = 0.28
# Free distance ahead that is required, metres: usually, at least, for a bend.
_LOOKAHEAD = 1.0
_CLEARANCE = 0.4
_ROOM_TO_BEND = 0.6
# Errors of the heading, radians. Up to the first, no turn is needed; up to the
# second, the avatar turns while walking; beyond the third, it always turns
# left.
_STRAIGHT = 0.16
_BEND = 0.7
_RIGHT_BEHIND = 2.6
# Time for which the avatar continues its present turn, seconds.
_COAST = 0.045
# Cost of a turn away from ahead, relative to one away from the target. Cost of
# an obstructed way: more than any turn.
_PREFER_AHEAD = 0.15
_BLOCKED = 100.0
# Size of an area, metres, and numbers of steps in it after which the avatar is
# stuck, or jammed. Half a turn takes 11 steps.
_SMALL = 0.3
_STUCK = 16
_JAMMED = 40
_ESCAPES = ('backward', 'strafe_left', 'strafe_right', 'forward_turn_left')
_ESCAPE_STEPS = 4


@final
@dataclasses.dataclass(frozen=True)
class View:
  """Observation of the surroundings; leading axes of every array are worlds.

  Attributes:
    position: Position of the avatar, `(..., 2)`, metres.
    angle: Heading of the avatar, `(...)`, radians.
    coast: Turn that happens before a command takes effect, `(...)`, radians.
    distances: Length of each ray, `(..., rays)`, metres.
    classes: Class of the thing that each ray hits, `(..., rays)`.
    free: Distance that the avatar can walk along each ray, `(..., rays)`,
      metres.
  """

  position: np.ndarray
  angle: np.ndarray
  coast: np.ndarray
  distances: np.ndarray
  classes: np.ndarray
  free: np.ndarray

  @property
  def ray_angles(self) -> np.ndarray:
    """Angle of each ray to the left of ahead, `(rays,)`, radians."""
    return _ray_angles(self.distances.shape[-1])

  def hits(self, name: str) -> np.ndarray:
    """Returns True for rays that hit a class, `(..., rays)`, bool."""
    return self.classes == appearance.code(name)

  def through(self, hit: np.ndarray) -> 'View':
    """Returns the view for walking through what rays hit, `(..., rays)`."""
    berths = np.where(hit, _NO_OBSTACLE, _BERTH[self.classes])
    return dataclasses.replace(self, free=_free_way(self.distances, berths))

  def points(self, depth: float) -> np.ndarray:
    """Returns the points that lie `depth` behind the hits of all rays.

    Args:
      depth: Distance from a visible surface to the middle of the thing, metres.

    Returns:
      Points, `(..., rays, 2)`, metres.
    """
    reach = (self.distances + depth)[..., np.newaxis]
    return self.position[..., np.newaxis, :] + reach * self._directions

  @functools.cached_property
  def _directions(self) -> np.ndarray:
    """Direction of each ray, `(..., rays, 2)`, a unit vector."""
    angles = self.angle[..., np.newaxis] + self.ray_angles
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)

  def ahead(self, distance: float) -> np.ndarray:
    """Returns the place at a distance straight ahead, `(..., 2)`, metres."""
    direction = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
    return self.position + distance * direction

  def mean_point(self, hit: np.ndarray, depth: float) -> np.ndarray:
    """Returns the mean of `points(depth)` of some rays, `(..., 2)`.

    Args:
      hit: True for the rays, `(..., rays)`; the mean of none is the origin.
      depth: See `points`.
    """
    total = (self.points(depth) * hit[..., np.newaxis]).sum(axis=-2)
    return total / np.maximum(hit.sum(axis=-1), 1)[..., np.newaxis]

  def locate(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns distances and bearings of places.

    Args:
      places: Positions, `(..., places, 2)`, metres.

    Returns:
      Distances, metres, and angles to the left of ahead, radians in [-pi, pi),
      each `(..., places)`.
    """
    offsets = places - self.position[..., np.newaxis, :]
    x, y = offsets[..., 0], offsets[..., 1]
    return (
        np.sqrt(x * x + y * y),  # As `np.linalg.norm`, and faster.
        wrap(np.arctan2(y, x) - self.angle[..., np.newaxis]),
    )

  def locate_one(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns distance and bearing of one place, `(..., 2)`; see `locate`."""
    distance, bearing = self.locate(place[..., np.newaxis, :])
    return distance[..., 0], bearing[..., 0]

  def nearest_ray(self, bearing: np.ndarray) -> np.ndarray:
    """Returns the index of the ray that is closest to a bearing."""
    angles = self.ray_angles
    index = np.rint((angles[0] - bearing) / (angles[0] - angles[1]))
    return index.clip(0, len(angles) - 1).astype(int)


def view(observation: base.Observation) -> View:
  """Returns the view in an observation."""

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
      free=_free_way(distances, _BERTH[classes]),
  )


@functools.cache
def _ray_angles(num_rays: int) -> np.ndarray:
  half = _FIELD_OF_VIEW / 2
  return np.linspace(half, -half, num_rays)


def wrap(angle: np.ndarray) -> np.ndarray:
  """Returns the equal angle in [-pi, pi)."""
  return (angle + np.pi) % (2 * np.pi) - np.pi


def _free_way(distances: np.ndarray, berths: np.ndarray) -> np.ndarray:
  """Returns the free distance along each ray, `(..., rays)`, metres."""
  squeezed = np.maximum(_SQUEEZE * distances, _TIGHT)
  berths = np.minimum(berths, squeezed)[..., np.newaxis, :]
  cosines, sines = _between_rays(distances.shape[-1])
  distances = distances[..., np.newaxis, :]
  in_way = (distances * sines < berths) & (cosines > 0)
  return np.where(in_way, distances * cosines, np.inf).min(axis=-1)


@functools.cache
def _between_rays(num_rays: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns cosine and absolute sine of the angle between any two rays."""
  angles = _ray_angles(num_rays)
  between = angles[:, np.newaxis] - angles
  return np.cos(between), np.abs(np.sin(between))


def walk(
    view: View, target: np.ndarray, reach: np.ndarray | float = 0.0
) -> np.ndarray:
  """Returns the index of the action that walks to a place around obstacles.

  Args:
    view: View of the avatar.
    target: Place, `(..., 2)`, metres.
    reach: Distance from the place within which obstacles are ignored, metres.
  """
  free = view.free
  distance, bearing = view.locate_one(target)
  # The heading of the avatar when the command takes effect.
  ahead = np.broadcast_to(view.coast, bearing.shape)[..., np.newaxis]
  needed = np.clip(distance - reach, _CLEARANCE, _LOOKAHEAD)
  is_free = free >= needed[..., np.newaxis]
  cost = (
      np.abs(wrap(view.ray_angles - bearing[..., np.newaxis]))
      + _PREFER_AHEAD * np.abs(view.ray_angles - ahead)
      + np.where(is_free, 0.0, _BLOCKED - free.clip(0.0, _LOOKAHEAD))
  )
  best = cost.argmin(axis=-1)[..., np.newaxis]
  # A target behind the avatar is out of sight, so the avatar turns first.
  behind = np.abs(bearing) > view.ray_angles[0]
  way = np.where(behind, bearing, view.ray_angles[best[..., 0]]) - view.coast
  room = np.take_along_axis(free, view.nearest_ray(ahead), -1)[..., 0]
  clear = (room >= np.minimum(needed, _ROOM_TO_BEND)) & ~behind
  return _head(way, clear)


def face(view: View, bearing: np.ndarray, then: np.ndarray | int) -> np.ndarray:
  """Returns the index of the action that turns to a bearing, or `then`.

  Args:
    view: View of the avatar.
    bearing: Angle to the left of ahead, `(...)`, radians.
    then: Index of the action to take once the avatar has that heading.
  """
  error = bearing - view.coast
  turn = _head(error, np.zeros(error.shape, bool))
  return np.where(np.abs(error) <= _STRAIGHT, then, turn)


def steer(view: View, bearing: np.ndarray) -> np.ndarray:
  """Returns the index of the action that walks to a bearing regardless."""
  error = bearing - view.coast
  return _head(error, np.ones(error.shape, bool))


def _head(error: np.ndarray, clear: np.ndarray) -> np.ndarray:
  """Returns the action that turns, and walks if the way ahead is clear."""
  # Always left if the target is behind, so that the turn does not alternate.
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
    episode_start: True for these worlds, `(...)`, bool.
    initial: Initial state of one world, or of each world.
    memory: State of each world; leading axes are worlds.
  """
  fresh = {}
  for name, value in memory.items():
    missing = (1,) * (value.ndim - episode_start.ndim)
    where = episode_start.reshape(episode_start.shape + missing)
    fresh[name] = np.where(where, initial[name], value)
  return fresh


def initial_rest(batch_shape: tuple[int, ...]) -> dict[str, np.ndarray]:
  """Returns the initial part of a state that detects a stuck avatar."""
  return {
      # Number of steps in the small area around the anchor.
      'still': np.zeros(batch_shape, int),
      'anchor': np.full((*batch_shape, 2), np.inf),
  }


def rest(
    view: View, memory: Mapping[str, np.ndarray], content: np.ndarray
) -> dict[str, np.ndarray]:
  """Returns the part of a state from `initial_rest`, updated by a view.

  Args:
    view: View of the avatar.
    memory: State.
    content: True if standing still is intended, `(...)`, bool.
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
  """Returns `action_`, or an action that frees a stuck avatar."""
  free = view.free.clip(0.0, 2 * _LOOKAHEAD)
  # The ray with the most room, less 0.1 m for each radian off ahead.
  best = (free - 0.1 * np.abs(view.ray_angles)).argmax(axis=-1)
  ahead = view.nearest_ray(view.coast[..., np.newaxis])
  room = np.take_along_axis(free, ahead, -1)[..., 0]
  leave = _head(view.ray_angles[best] - view.coast, room >= _ROOM_TO_BEND)
  # These move without sight, so they come last.
  blind = np.array([action(name) for name in _ESCAPES])
  turn = (still - _JAMMED) // _ESCAPE_STEPS % len(blind)
  return np.where(
      still < _STUCK, action_, np.where(still < _JAMMED, leave, blind[turn])
  )


@functools.cache
def action(name: str) -> int:
  """Returns the index of an action by its name."""
  return action_sets.DMLAB_LIKE.index(name)
