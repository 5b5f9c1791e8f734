"""Grasps: the hold of a hand on a block."""

from collections.abc import Callable, Sequence
import itertools
from typing import Any, final

from dm_control import mjcf
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import protocols

# A hand holds a block with one of several strengths: the first one whose
# largest distance between block and hand, in m, is not exceeded. A write can
# put a held block far from the hand. With the first strength for all distances,
# the block returned at 3 m/s to a standing avatar and at 34 m/s to a walking
# one.
_DISTANCES = (0.1, 0.3, 0.9, 2.7, np.inf)
# Speed at which a block returns from the largest distance of a strength, in
# m/s, and the distance that counts as the largest one for the last strength.
_RETURN_SPEED = 1.5
_FARTHEST = 8.1
# The hand is weaker than walls: with MuJoCo's default of 0.95 it pulled a block
# of 1 kg through one.
_IMPEDANCE = 0.7
# Damping, in 1/s: a block adopts the velocity of the hand in about 0.02 s.
_DAMPING = 40.0
# The first strength is critically damped.
_FIRM = (0.05, 1.0)


@final
class Grasp:
  """The hold of one hand on one block: an equality constraint per strength.

  At most one of the constraints is active.
  """

  def __init__(
      self,
      hand: mjcf.Element,
      site: mjcf.Element,
      hand_position: Callable[[Any], np.ndarray],
  ) -> None:
    """Adds the constraints to the model.

    Args:
      hand: Site of the hand.
      site: Site of the block.
      hand_position: Function of the physics that returns the position of the
        hand in the plane of the floor, `(..., 2)`, in m, without derived
        quantities, which are out of date after a write.
    """
    self._hand_position = hand_position
    self._physics: protocols.Physics | None = None
    self._bound: Any = None
    # Connected by two sites, a held block can turn. A weld would lock the yaw
    # of an avatar while the block that it holds cannot turn. The constraints
    # have names, because dm_control counts all elements of the model to make up
    # a name for an element without one.
    ends = f'{hand.full_identifier}-{site.full_identifier}'.replace('/', '.')
    self._constraints = tuple(
        hand.root.root_model.equality.add(
            'connect',
            name=f'{ends}-{i}',
            site1=hand,
            site2=site,
            active='false',
            solref=solref,
            solimp=(_IMPEDANCE, _IMPEDANCE, 0.001),
        )
        for i, solref in enumerate(_SOLREFS)
    )

  @property
  def constraints(self) -> tuple[mjcf.Element, ...]:
    """Equality constraints, from the strongest to the weakest."""
    return self._constraints

  def remove(self) -> None:
    """Removes the constraints from the model."""
    for constraint in self._constraints:
      constraint.remove()

  def release(self, physics: protocols.Physics, where: axes.Mask) -> None:
    """Releases the block in some worlds."""
    axes.assign(physics.bind(self._constraints), 'active', 0, where)

  def is_anywhere_held(self, physics: protocols.Physics) -> bool:
    """Returns True if the hand holds the block in any world."""
    if physics is not self._physics:
      self._bound = physics.bind(self._constraints)
      self._physics = physics
    return bool(np.count_nonzero(self._bound.active))

  def adapt(
      self, physics: protocols.Physics, position: np.ndarray, where: axes.Mask
  ) -> np.ndarray:
    """Adapts the strength, where the hand holds the block, to their distance.

    Args:
      physics: One world or a batch of worlds.
      position: Position of the block, `(..., 2)`, in m.
      where: Worlds in which to do so, `(...)` bool; `None` for all worlds.

    Returns:
      True where the hand holds the block and `where` is True, `(...)` bool.
    """
    bound = physics.bind(self._constraints)
    is_held = np.asarray(np.any(bound.active, axis=-1))
    offset = position - self._hand_position(physics)
    distance = np.sqrt((offset * offset).sum(axis=-1))
    axes.assign(bound, 'active', _with_strength(is_held, distance), where)
    return is_held if where is None else is_held & where


def constraints_of(grasps: Sequence[Grasp]) -> tuple[mjcf.Element, ...]:
  """Returns the constraints of several grasps, to be bound together."""
  return tuple(itertools.chain(*[grasp.constraints for grasp in grasps]))


def held(active: np.ndarray) -> np.ndarray:
  """Returns True for each grasp that holds its block, `(..., grasps)` bool.

  Args:
    active: Attribute `active` of the constraints of the grasps.
  """
  shape = (*active.shape[:-1], -1, len(_DISTANCES))
  return np.any(active.reshape(shape), axis=-1)


def active(is_held: np.ndarray, distances: np.ndarray) -> np.ndarray:
  """Returns the attribute `active` of the constraints of grasps.

  Args:
    is_held: True for each grasp that holds its block, `(..., grasps)` bool.
    distances: Distances between hand and blocks, `(..., grasps)`, in m.
  """
  result = _with_strength(is_held, distances)
  return result.reshape((*result.shape[:-2], -1))


def _with_strength(is_held: np.ndarray, distances: np.ndarray) -> np.ndarray:
  """Returns which constraints are active, `(..., strengths)` bool.

  Args:
    is_held: True where a hand holds a block, `(...)` bool.
    distances: Distances between hand and block, `(...)`, in m.
  """
  strengths = np.searchsorted(_DISTANCES, distances)[..., np.newaxis]
  is_chosen = np.arange(len(_DISTANCES)) == strengths
  return is_held[..., np.newaxis] & is_chosen


def _solref(distance: float) -> tuple[float, float]:
  """Returns the `solref` of the strength for distances of up to `distance`.

  Negative numbers are stiffness and damping. With little stiffness, the block
  approaches the hand at a speed of `stiffness / damping * distance`.
  """
  if distance <= _DISTANCES[0]:
    return _FIRM
  stiffness = _DAMPING * _RETURN_SPEED / min(distance, _FARTHEST)
  return -stiffness, -_DAMPING


# The attribute `solref` of each strength.
_SOLREFS = tuple(_solref(distance) for distance in _DISTANCES)
