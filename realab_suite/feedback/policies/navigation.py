"""How scripted policies look around and walk, by the ray sense alone."""

from collections.abc import Sequence
import dataclasses
import functools
from typing import final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.feedback import action_sets
from realab_suite.feedback.policies import base

_FIELD_OF_VIEW = np.radians(160.0)
# What is walked round, and how far the middle of the avatar stays from it,
# metres. Its radius is 0.25; blocks, which give way, get a wider berth.
_BERTHS = {
    'other': 0.32,
    'wall': 0.32,
    'barrier': 0.32,
    'door': 0.32,
    'pad': 0.34,
    'pressed_pad': 0.34,
    'base_block': 0.42,
    'offset_block': 0.42,
}
_BERTH = np.array([_BERTHS.get(name, -1.0) for name in appearance.CLASSES])
# How far ahead the way has to be free, metres.
_LOOKAHEAD = 1.0
_CLEARANCE = 0.4
# An error of the heading that needs no turn, and one that is turned away while
# walking, radians.
_STRAIGHT = 0.16
_BEND = 0.7
_RIGHT_BEHIND = 2.6
_ROOM_TO_BEND = 0.6
# For how long the avatar keeps turning as it does now, seconds.
_COAST = 0.045
_PREFER_AHEAD = 0.15
_BLOCKED = 100.0


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
  """

  position: np.ndarray
  angle: np.ndarray
  coast: np.ndarray
  distances: np.ndarray
  classes: np.ndarray

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


def look(observation: base.Observation) -> View:
  """Returns what there is to see."""

  def get(name: str) -> np.ndarray:
    return np.asarray(observation[f'senses/{name}'], float)

  x, y = np.moveaxis(get('heading'), -1, 0)
  return View(
      position=get('position'),
      angle=np.arctan2(y, x),
      coast=_COAST * get('velocity')[..., 2],
      distances=get('ray_distances'),
      classes=np.asarray(observation['senses/ray_classes']),
  )


@functools.cache
def _ray_angles(num_rays: int) -> np.ndarray:
  half = _FIELD_OF_VIEW / 2
  return np.linspace(half, -half, num_rays)


def wrap(angle: np.ndarray) -> np.ndarray:
  """Returns the same angle in [-pi, pi)."""
  return (angle + np.pi) % (2 * np.pi) - np.pi


def free_way(view: View, ignored: Sequence[str] = ()) -> np.ndarray:
  """Returns how far the avatar can walk along each ray, `(..., rays)`, metres.

  Args:
    view: What is seen.
    ignored: Classes of things that are not in the way.
  """
  berths = _BERTH[view.classes]
  for name in ignored:
    berths = np.where(view.hits(name), -1.0, berths)
  between = view.ray_angles[:, np.newaxis] - view.ray_angles
  distances = view.distances[..., np.newaxis, :]
  along = distances * np.cos(between)
  beside = distances * np.abs(np.sin(between))
  in_way = (along > 0) & (beside < berths[..., np.newaxis, :])
  return np.where(in_way, along, np.inf).min(axis=-1)


def walk(
    view: View,
    target: np.ndarray,
    reach: np.ndarray | float = 0.0,
    ignored: Sequence[str] = (),
) -> np.ndarray:
  """Returns the index of the action that goes to a place, round what is solid.

  Args:
    view: What is seen.
    target: The place, `(..., 2)`, metres.
    reach: How far from the place what is solid is in the way no more, metres.
    ignored: Classes of things that are walked into.
  """
  free = free_way(view, ignored)
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


def face(
    view: View, bearing: np.ndarray, then: np.ndarray | int
) -> np.ndarray:
  """Returns the index of the action that turns to a bearing, or what is next.

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


def walk_off(view: View) -> np.ndarray:
  """Returns the index of the action that goes where there is most room."""
  free = free_way(view).clip(0.0, 2 * _LOOKAHEAD)
  # Of equal ones, that which is most nearly ahead.
  best = (free - 0.1 * np.abs(view.ray_angles)).argmax(axis=-1)
  ahead = np.broadcast_to(view.coast, best.shape)[..., np.newaxis]
  room = np.take_along_axis(free, view.nearest_ray(ahead), -1)[..., 0]
  return _head(view.ray_angles[best] - view.coast, room >= _ROOM_TO_BEND)


@functools.cache
def action(name: str) -> int:
  """Returns the index of an action by its name."""
  return action_sets.DMLAB_LIKE.index(name)
