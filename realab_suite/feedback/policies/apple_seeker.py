"""An honest agent: it does what the environment designer intends."""

from typing import Any, final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.feedback.policies import base
from realab_suite.feedback.policies import navigation

# From what is seen of a thing to its middle, metres.
_DEPTHS = {'apple': 0.2, 'large_apple': 0.4, 'pad': 0.12, 'door': 0.04}
_SPACING = 0.6
# As far as this, no apple slips between two rays.
_CLEAR_SIGHT = 3.8
_HALF_VIEW = np.radians(78.0)
_MARGIN = 0.4
# How much farther it goes for what needs one radian less of a turn, metres.
_TURN_COST = 0.5
# After how many steps without a new spot ruled out it leaves what it looks for.
_PATIENCE = 60
# After how many steps in a place this small, metres, it is stuck, and after how
# many jammed; half a turn takes 11.
_STUCK = 16
_JAMMED = 40
_SMALL = 0.3
_ESCAPES = ('backward', 'strafe_left', 'strafe_right', 'forward_turn_left')
_ESCAPE_STEPS = 4


@base.POLICIES.add('apple_seeker')
@final
class AppleSeeker(base.Policy):
  """Gathers what small apples there are, then takes the large one.

  It goes to the nearest small apple that it sees; without one, to a pad that is
  not pressed yet, and else to the nearest spot of the room that it has not
  looked at. When there is none left, it leaves through the door, if there is
  one, for the large apple; otherwise it looks everywhere again. It walks round
  registers.

  What it remembers is a map of spots where an apple may be, where the landmarks
  are, and how long nothing has come of what it does.
  """

  def __init__(self, half_width: float = 3.6) -> None:
    """Makes the policy.

    Args:
      half_width: Half the side of the square, around the origin of the world,
        in which it looks for apples, metres.
    """
    count = round(2 * half_width / _SPACING) + 1
    line = np.linspace(-half_width, half_width, count)
    grid = np.meshgrid(line, line, indexing='ij')
    self._spots = np.stack(grid, axis=-1).reshape(-1, 2)

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    spots = len(self._spots)
    return {
        # Where an apple may be, and the fewest such spots so far.
        'open': np.ones((*batch_shape, spots), bool),
        'fewest': np.full(batch_shape, spots),
        # Steps since there were more of them, and since it left a small place.
        'idle': np.zeros(batch_shape, int),
        'still': np.zeros(batch_shape, int),
        'anchor': np.full((*batch_shape, 2), np.inf),
        # Where things are; nan where that is not known.
        'pad': np.full((*batch_shape, 2), np.nan),
        'door': np.full((*batch_shape, 2), np.nan),
        'large_apple': np.full((*batch_shape, 2), np.nan),
        'pressed': np.zeros(batch_shape, bool),
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
    initial = self.initial_state(start.shape)
    memory = {
        name: np.where(_fit(start, value), initial[name], value)
        for name, value in state.items()
    }
    view = navigation.look(observation)
    memory.update(_landmarks(view, memory))
    memory['open'] = self._open_spots(view, memory['open'])
    memory.update(_progress(view, memory))
    target, reach = self._target(view, memory)
    action = navigation.walk(view, target, reach)
    return _unless_stuck(view, memory['still'], action), memory

  def _open_spots(
      self, view: navigation.View, open_spots: np.ndarray
  ) -> np.ndarray:
    """Returns where an apple may be, after a look, `(..., spots)`."""
    distances, angles = view.locate(self._spots)
    ray = view.nearest_ray(angles)
    sight = np.take_along_axis(view.distances, ray, -1)
    seen = np.take_along_axis(view.classes, ray, -1)
    in_view = np.abs(angles) + _MARGIN / distances.clip(_MARGIN) < _HALF_VIEW
    empty = (distances < _CLEAR_SIGHT) & (sight > distances - _MARGIN)
    # Nothing is to be had behind a wall.
    for name in ('wall', 'barrier', 'door'):
      empty |= seen == appearance.code(name)
    left = open_spots & ~(empty & in_view) & (distances > _MARGIN)
    apples = view.points(_DEPTHS['apple'])[..., np.newaxis, :]
    near = np.abs(apples - self._spots).max(axis=-1) <= _SPACING / 2
    marks = near & view.hits('apple')[..., np.newaxis]
    return left | marks.any(axis=-2)

  def _target(
      self, view: navigation.View, memory: Any
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns where to go, and how far from there nothing is in the way."""
    apples = view.hits('apple')
    apple = _nearest(view, view.points(_DEPTHS['apple']), apples)
    spots = np.broadcast_to(self._spots, (*memory["open"].shape, 2))
    spot = _nearest(view, spots, memory['open'])
    patient = memory['idle'] < _PATIENCE
    leaves = ~memory['open'].any(axis=-1) | ~patient
    goes_to_pad = leaves | view.hits('pad').any(axis=-1)
    # The first that applies, from the top.
    choices = (
        (patient & apples.any(axis=-1), apple, 0.45),
        (goes_to_pad & _known(memory['pad']), memory['pad'], 0.7),
        (~leaves, spot, _MARGIN),
        (_known(memory['large_apple']), memory['large_apple'], 0.6),
        (_known(memory['door']), memory['door'], 1.0),
    )
    applies = [condition for condition, _, _ in choices]
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
  """Returns what is known of landmarks after a look."""
  pressed = memory['pressed'] | view.hits('pressed_pad').any(axis=-1)
  known = {'pressed': pressed}
  for name in ('pad', 'door', 'large_apple'):
    hit = view.hits(name)
    seen = hit.any(axis=-1)
    if name == 'door':
      seen = seen & ~pressed  # It slides.
    known[name] = np.where(
        seen[..., np.newaxis],
        view.mean_point(hit, _DEPTHS[name]),
        memory[name],
    )
  known['pad'] = np.where(pressed[..., np.newaxis], np.nan, known['pad'])
  return known


def _progress(view: navigation.View, memory: Any) -> dict[str, np.ndarray]:
  """Returns what is known of how things go, after a look."""
  left = memory['open'].sum(axis=-1)
  progress = left < memory['fewest']
  idle = np.where(progress, 0, memory['idle'] + 1)
  nowhere_to_go = (left == 0) | (idle >= _PATIENCE)
  for name in ('pad', 'door', 'large_apple'):
    nowhere_to_go = nowhere_to_go & ~_known(memory[name])
  looks_again = nowhere_to_go | (idle >= 3 * _PATIENCE)
  moved = progress | (view.locate_one(memory['anchor'])[0] > _SMALL)
  return {
      'open': memory['open'] | looks_again[..., np.newaxis],
      'fewest': np.where(
          looks_again,
          memory['open'].shape[-1],
          np.minimum(left, memory['fewest']),
      ),
      'idle': np.where(looks_again, 0, idle),
      'still': np.where(moved, 0, memory['still'] + 1),
      'anchor': np.where(
          moved[..., np.newaxis], view.position, memory['anchor']
      ),
  }


def _unless_stuck(
    view: navigation.View, still: np.ndarray, action: np.ndarray
) -> np.ndarray:
  """Returns an action that frees the avatar where nothing else has."""
  escapes = np.array([navigation.action(name) for name in _ESCAPES])
  turn = (still - _JAMMED) // _ESCAPE_STEPS % len(escapes)
  # It sees nothing of where these lead, so they come last.
  jammed = still >= _JAMMED
  action = np.where(still < _STUCK, action, navigation.walk_off(view))
  return np.where(jammed, escapes[turn], action)


def _nearest(
    view: navigation.View, places: np.ndarray, allowed: np.ndarray
) -> np.ndarray:
  """Returns that of some places, `(..., places, 2)`, which is soonest there."""
  distances, bearings = view.locate(places)
  cost = distances + _TURN_COST * np.abs(bearings)
  best = np.where(allowed, cost, np.inf).argmin(axis=-1)
  places = np.broadcast_to(places, (*allowed.shape, 2))
  index = best[..., np.newaxis, np.newaxis]
  return np.take_along_axis(places, index, -2)[..., 0, :]


def _known(place: np.ndarray) -> np.ndarray:
  return ~np.isnan(place[..., 0])


def _fit(flag: np.ndarray, array: np.ndarray) -> np.ndarray:
  """Returns `flag` with as many axes as `array`."""
  return flag.reshape(flag.shape + (1,) * (array.ndim - flag.ndim))
