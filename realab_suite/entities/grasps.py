"""Grasps: the hold of a hand on a block."""

from collections.abc import Callable, Iterable
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
# A hand turns a block of some registers along. A weld would hold its angle, and
# the yaw of the avatar where the block cannot turn. These welds have damping
# and no stiffness: they match velocities, whatever the angle is, and a block
# that is stuck brakes the avatar a little. Each is for the angles of up to an
# eighth of a turn from its own, as a weld half a turn away has no effect. They
# are weak, with a large weight of torques, because a weld that matches the
# other velocities as well keeps a block from coming to the hand.
_NUM_WELDS = 4
_TURNING_IMPEDANCE = 0.5
_TORQUE_SCALE = 5.0


@final
class Grasp:
  """The hold of one hand on one block: an equality constraint per strength.

  At most one of the constraints is active. If the hand turns the block along,
  one of several welds is active as well.
  """

  def __init__(
      self,
      hand: mjcf.Element,
      site: mjcf.Element,
      hand_position: Callable[[Any], np.ndarray],
      turns_along: bool = False,
  ) -> None:
    """Adds the constraints to the model.

    Args:
      hand: Site of the hand.
      site: Site of the block.
      hand_position: Function of the physics that returns the position of the
        hand in the plane of the floor, `(..., 2)`, in m, without derived
        quantities, which are out of date after a write.
      turns_along: True if the block turns with the hand.
    """
    self._ends = hand, site
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
    angles = np.arange(_NUM_WELDS if turns_along else 0) * np.pi / 2
    self._welds = tuple(
        hand.root.root_model.equality.add(
            'weld',
            name=f'{ends}-turn-{i}',
            body1=hand.parent,
            body2=site.parent,
            relpose=[*hand.pos, np.cos(angle / 2), 0, 0, np.sin(angle / 2)],
            anchor=(0, 0, 0),
            active='false',
            torquescale=_TORQUE_SCALE,
            solref=(0, -_DAMPING),
            solimp=(_TURNING_IMPEDANCE, _TURNING_IMPEDANCE, 0.001),
        )
        for i, angle in enumerate(angles)
    )

  @property
  def constraints(self) -> tuple[mjcf.Element, ...]:
    """Equality constraints, from the strongest to the weakest."""
    return self._constraints

  def remove(self) -> None:
    """Removes the constraints from the model."""
    for constraint in (*self._constraints, *self._welds):
      constraint.remove()

  def hold(self, physics: protocols.Physics) -> None:
    """Holds the block, which is where the hand is, in all worlds."""
    axes.assign(
        physics.bind(self._constraints),
        'active',
        _with_strength(np.array(True), np.array(0.0)),
        None,
    )

  def release(self, physics: protocols.Physics, where: axes.Mask) -> None:
    """Releases the block in some worlds."""
    axes.assign(physics.bind(self._constraints), 'active', 0, where)
    if self._welds:
      axes.assign(physics.bind(self._welds), 'active', 0, where)

  def turn_along(self, physics: protocols.Physics, is_held: np.ndarray) -> None:
    """Turns the block with the hand where it is held, `(...)` bool.

    It does nothing for other blocks. Writes can turn a held block, so it is
    called in each control step.
    """
    if not self._welds:
      return
    hand, block = (
        np.reshape(matrix, (*matrix.shape[:-1], 3, 3))
        for matrix in (physics.bind(end).xmat for end in self._ends)
    )
    (x, y, _), (x_of_block, y_of_block, _) = (
        np.moveaxis(matrix, -1, 0) for matrix in (hand, block)
    )
    cos = (x * x_of_block + y * y_of_block).sum(axis=-1)
    sin = (y * x_of_block - x * y_of_block).sum(axis=-1)
    nearest = np.argmax(np.stack([cos, sin, -cos, -sin], axis=-1), axis=-1)
    is_nearest = np.arange(_NUM_WELDS) == nearest[..., np.newaxis]
    active = np.asarray(is_held)[..., np.newaxis] & is_nearest
    physics.bind(self._welds).active = active

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


def constraints_of(grasps: Iterable[Grasp]) -> tuple[mjcf.Element, ...]:
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
