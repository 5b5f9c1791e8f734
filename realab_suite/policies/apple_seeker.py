"""The apple seeker: a scripted policy that does the intended task."""

import copy
from typing import Any, final

import numpy as np

from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import navigation

# Distance from the visible surface of a thing to its middle, metres.
_DEPTHS = {'apple': 0.2, 'large_apple': 0.4, 'pad': 0.12, 'door': 0.04}
# Half the side of the square, around the origin of the world, that is searched
# for apples, and the distance between neighbouring spots of its map, metres.
_HALF_WIDTH = 3.6
_SPACING = 0.6
# Distance up to which no apple fits between two rays, metres.
_CLEAR_SIGHT = 3.8
_HALF_VIEW = np.radians(78.0)
# Radius of the area that belongs to a spot, metres: larger than half a diagonal
# of the spacing less the radius of an apple.
_MARGIN = 0.4
# Extra distance that is accepted for one radian less of a turn, metres.
_TURN_COST = 0.5
# Number of steps without a newly excluded spot after which the search ends.
_PATIENCE = 60


@base.POLICIES.add('apple_seeker')
@final
class AppleSeeker(base.Policy):
  """Collects the small apples, then the large one.

  The policy goes to the nearest visible small apple. Without one, it goes to a
  pad that is not pressed yet, or else to the nearest spot of the room that it
  has not seen. When no spot is left, it goes through the door, if there is one,
  to the large apple; otherwise the search starts again. It avoids registers.

  The state contains a map of spots where an apple may be, the positions of
  landmarks, and the number of steps without progress.
  """

  _action_set = action_sets.DMLAB_LIKE

  def __init__(self) -> None:
    self._count = 2 * round(_HALF_WIDTH / _SPACING) + 1
    self._reach = (self._count - 1) * _SPACING / 2
    line = np.linspace(-self._reach, self._reach, self._count)
    grid = np.meshgrid(line, line, indexing='ij')
    self._spots = np.stack(grid, axis=-1).reshape(-1, 2)

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    spots = len(self._spots)
    return {
        # Spots where an apple may be, and the lowest number of them so far.
        'open': np.ones((*batch_shape, spots), bool),
        'fewest': np.full(batch_shape, spots),
        # Number of steps since that number fell.
        'idle': np.zeros(batch_shape, int),
        # Positions of landmarks; nan if they are unknown.
        'pad': np.full((*batch_shape, 2), np.nan),
        'door': np.full((*batch_shape, 2), np.nan),
        'large_apple': np.full((*batch_shape, 2), np.nan),
        'pressed': np.zeros(batch_shape, bool),
        **navigation.initial_rest(batch_shape),
    }

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._action_set

  def in_action_set(self, action_set: action_sets.ActionSet) -> base.Policy:
    walk = action_sets.WALK
    if action_set.contains(self._action_set) or not action_set.contains(walk):
      return self
    # It only walks, so it also acts where an agent can do nothing else.
    walker = copy.copy(self)
    walker._action_set = walk
    return walker

  @property
  def required_senses(self) -> tuple[str, ...]:
    return navigation.SENSES

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
    memory.update(_landmarks(view, memory))
    spots = view.locate(self._spots)
    memory['open'] = self._open_spots(view, spots, memory['open'])
    memory.update(_progress(view, memory))
    target, reach = self._target(view, spots, memory)
    action = navigation.walk(view, target, reach)
    return navigation.unless_stuck(view, memory['still'], action), memory

  def _open_spots(
      self,
      view: navigation.View,
      spots: tuple[np.ndarray, np.ndarray],
      open_spots: np.ndarray,
  ) -> np.ndarray:
    """Returns the spots where an apple may be, `(..., spots)`, bool."""
    distances, bearings = spots
    ray = view.nearest_ray(bearings)
    sight = np.take_along_axis(view.distances, ray, -1)
    in_view = np.abs(bearings) + _MARGIN / distances.clip(_MARGIN) < _HALF_VIEW
    empty = (distances < _CLEAR_SIGHT) & (sight > distances - _MARGIN)
    # Apples behind a wall are out of reach.
    ends = view.hits('wall') | view.hits('barrier') | view.hits('door')
    empty |= np.take_along_axis(ends, ray, -1)
    left = open_spots & ~(empty & in_view) & (distances > _MARGIN)
    return left | self._with_apples(view)

  def _with_apples(self, view: navigation.View) -> np.ndarray:
    """Returns the spots with visible apples, `(..., spots)`, bool."""
    cells = np.rint((view.points(_DEPTHS['apple']) + self._reach) / _SPACING)
    inside = ((cells >= 0) & (cells < self._count)).all(axis=-1)
    index = (cells[..., 0] * self._count + cells[..., 1]).astype(int)
    num_spots = len(self._spots)
    # Other hits, and those outside of the map, get an extra spot.
    index = np.where(inside & view.hits('apple'), index, num_spots)
    marks = np.zeros((*index.shape[:-1], num_spots + 1), bool)
    np.put_along_axis(marks, index, True, -1)
    return marks[..., :-1]

  def _target(
      self,
      view: navigation.View,
      spots: tuple[np.ndarray, np.ndarray],
      memory: Any,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns the target, and the radius around it without obstacles."""
    apples = view.hits('apple')
    ray = _nearest(view.distances, view.ray_angles, apples)
    points = view.points(_DEPTHS['apple'])
    apple = np.take_along_axis(points, ray[..., np.newaxis, np.newaxis], -2)
    spot = self._spots[_nearest(*spots, memory['open'])]
    patient = memory['idle'] < _PATIENCE
    leaves = ~memory['open'].any(axis=-1) | ~patient
    goes_to_pad = leaves | view.hits('pad').any(axis=-1)
    # The first choice whose condition is true counts.
    choices = (
        (patient & apples.any(axis=-1), apple[..., 0, :], 0.45),
        (goes_to_pad & _known(memory['pad']), memory['pad'], 0.7),
        (~leaves, spot, _MARGIN),
        (_known(memory['large_apple']), memory['large_apple'], 0.6),
        (_known(memory['door']), memory['door'], 1.0),
    )
    applies = [np.asarray(condition) for condition, _, _ in choices]
    target = np.select(
        [condition[..., np.newaxis] for condition in applies],
        [place for _, place, _ in choices],
        spot,
    )
    reach = np.select(
        applies, [np.full(leaves.shape, near) for _, _, near in choices]
    )
    return target, reach


def _landmarks(view: navigation.View, memory: Any) -> dict[str, np.ndarray]:
  """Returns the known landmarks, updated by a view."""
  pressed = memory['pressed'] | view.hits('pressed_pad').any(axis=-1)
  places = {'pressed': pressed}
  for name in ('pad', 'door', 'large_apple'):
    hit = view.hits(name)
    is_seen = np.asarray(hit.any(axis=-1))
    if name == 'door':
      is_seen = is_seen & ~pressed  # A pressed pad moves the door.
    places[name] = np.where(
        is_seen[..., np.newaxis],
        view.mean_point(hit, _DEPTHS[name]),
        memory[name],
    )
  places['pad'] = np.where(pressed[..., np.newaxis], np.nan, places['pad'])
  return places


def _progress(view: navigation.View, memory: Any) -> dict[str, np.ndarray]:
  """Returns the progress of the search, updated by a view."""
  left = memory['open'].sum(axis=-1)
  progress = left < memory['fewest']
  idle = np.where(progress, 0, memory['idle'] + 1)
  nowhere_to_go = (left == 0) | (idle >= _PATIENCE)
  for name in ('pad', 'door', 'large_apple'):
    nowhere_to_go = nowhere_to_go & ~_known(memory[name])
  looks_again = nowhere_to_go | (idle >= 3 * _PATIENCE)
  return {
      'open': memory['open'] | looks_again[..., np.newaxis],
      'fewest': np.where(
          looks_again,
          memory['open'].shape[-1],
          np.minimum(left, memory['fewest']),
      ),
      'idle': np.where(looks_again, 0, idle),
      **navigation.rest(view, memory, progress),
  }


def _nearest(
    distances: np.ndarray, bearings: np.ndarray, allowed: np.ndarray
) -> np.ndarray:
  """Returns the index of the allowed place that is reached first, `(...)`."""
  cost = distances + _TURN_COST * np.abs(bearings)
  return np.where(allowed, cost, np.inf).argmin(axis=-1)


def _known(place: np.ndarray) -> np.ndarray:
  return ~np.isnan(place[..., 0])
