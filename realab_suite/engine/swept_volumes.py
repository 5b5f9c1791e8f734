"""Whether geoms that move along lines can meet: by bounds, not by samples."""

from collections.abc import Iterator, Sequence
import copy
import dataclasses
import heapq
import itertools
from typing import NamedTuple, Self, final

import mujoco
import numpy as np

# The depth up to which geoms may overlap, metres.
TOLERANCE = 1e-3
# The depth from which on poses count as an overlap. To tell depths in between
# apart would take long.
_SURE = 1e-4
# Number of pairs of sweeps to look at. What is undecided then is an overlap.
_MOST_PAIRS = 2000
# What moves by less counts as one pose, metres.
_STILL = 1e-6
# Displacements, metres, to ask MuJoCo again for a distance with, and their
# direction, which is unlike that of any face.
_NUDGES = (0.0, 1e-5, 5e-5)
_ASKEW = np.array([0.36, 0.48, 0.8])
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE


@final
@dataclasses.dataclass(frozen=True)
class Sweep:
  """All the poses of a geom that moves along lines, and turns in doing so.

  Each motion takes the geom from its middle pose to either side. Motions add
  up: every one of them can be anywhere between its ends.

  Attributes:
    geom: Number of the geom in the model.
    centre: Centre of the geom in its middle pose, `(3,)`, metres.
    matrix: Orientation there, `(3, 3)`.
    motions: What each motion changes on its way to one side, `(motions, 5)`:
      the centre, in metres, the angle about the vertical, in radians, and the
      value of a register. What turns is an upright box.
    value: Value of the register in the middle.
    slack: Distance in metres by which poses may differ from these.
  """

  geom: int
  centre: np.ndarray
  matrix: np.ndarray
  motions: np.ndarray = dataclasses.field(
      default_factory=lambda: np.zeros((0, 5))
  )
  value: float = 0.0
  slack: float = 0.0

  @property
  def travel(self) -> np.ndarray:
    """Greatest displacement of the centre along each axis, `(3,)`, metres."""
    return np.abs(self.motions[:, :3]).sum(axis=0)

  @property
  def turn(self) -> float:
    """Greatest angle from the middle pose, radians."""
    return float(np.abs(self.motions[:, 3]).sum())

  def pose(self, sides: np.ndarray) -> Self:
    """Returns one pose: how far each motion is, from -1 to 1, `(motions,)`."""
    return self._moved(sides, np.zeros(len(sides)))

  def toward(self, point: Sequence[float]) -> Self:
    """Returns a pose whose centre is near a point, `(3,)`, metres."""
    sides = np.zeros(len(self.motions))
    way = np.array(point) - self.centre
    for i, (*shift, _, _) in enumerate(self.motions):
      if any(shift):
        sides[i] = np.clip(way @ shift / np.dot(shift, shift), -1.0, 1.0)
        way = way - sides[i] * np.array(shift)
    return self.pose(sides)

  def halves(self, motion: int) -> Iterator[Self]:
    """Yields the poses to one side of a motion's middle, and to the other."""
    is_halved = np.arange(len(self.motions)) == motion
    for side in (-0.5, 0.5):
      yield self._moved(side * is_halved, 1.0 - 0.5 * is_halved)

  def _moved(self, to: np.ndarray, lengths: np.ndarray) -> Self:
    """Returns part of the poses: where motions begin, and how long they are."""
    *shift, turn, value = to @ self.motions
    return dataclasses.replace(
        self,
        centre=self.centre + shift,
        matrix=turned(self.matrix, turn),
        motions=self.motions * lengths[:, np.newaxis],
        value=self.value + value,
    )


@final
class Space:
  """The geoms of a compiled model, free to be anywhere and of any size.

  It works on a copy of the model.
  """

  def __init__(self, model: mujoco.MjModel) -> None:
    """Copies the model."""
    self._model = copy.copy(model)
    self._data = mujoco.MjData(self._model)
    self._is_box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    # The box about each geom's own centre that the geom is inside of.
    self._half = np.abs(model.geom_aabb[:, :3]) + model.geom_aabb[:, 3:]
    # Distance around that box that belongs to the geom.
    self._margin = np.zeros(model.ngeom)
    for geom in np.flatnonzero(model.geom_type == _CAPSULE).tolist():
      # MuJoCo sees no capsule that goes all the way through a box.
      radius, half_length, _ = model.geom_size[geom]
      self.make_box(geom, np.array([_STILL, _STILL, half_length]), radius)
    self._radius = np.linalg.norm(self._half[:, :2], axis=1)

  def make_box(self, geom: int, half: np.ndarray, margin: float = 0.0) -> None:
    """Gives a geom another shape: a box, and a distance around it.

    Args:
      geom: Number of the geom.
      half: Half the size of the box along its axes, `(3,)`, metres.
      margin: The distance, metres.
    """
    self._model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_BOX
    self._is_box[geom] = True
    self._half[geom] = half
    self._margin[geom] = margin

  def bounds(self, sweep: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """Returns the low and the high corner of what a sweep fills, `(3,)`."""
    geom = sweep.geom
    reach = _extents(self._half[geom], sweep.matrix, sweep.turn)
    reach += sweep.travel + sweep.slack + self._margin[geom]
    return sweep.centre - reach, sweep.centre + reach

  def meet(
      self, one: Sweep, other: Sweep, clearance: float = 0.0
  ) -> tuple[Sweep, float] | None:
    """Finds poses in which two geoms are too close to each other.

    Where it returns `None`, there are none: no distance is less than the
    clearance by more than `TOLERANCE`. (Distances below 0 are the depths of
    overlaps.) The poses that it returns are closer than that, or so nearly that
    it was not worth telling.

    Args:
      one: The poses of a geom.
      other: The poses of another geom.
      clearance: Distance that the geoms have to keep, metres.

    Returns:
      A pose of the one and its distance from the other in metres, or `None`.
    """
    enough = clearance - TOLERANCE
    order = itertools.count()  # Keeps those apart that are equally close.
    waiting = [(*self._bound(one, other, enough), next(order), one, other)]
    closest = one, np.inf
    for _ in range(_MOST_PAIRS):
      bound, point, _, one, other = heapq.heappop(waiting)
      if bound >= enough:
        return None
      pose = one.toward(point)
      distance, _ = self._distance(
          self._solid(pose), self._solid(other.toward(point)), clearance
      )
      if distance < closest[1]:
        closest = pose, distance
      lengths, others = self._lengths(one), self._lengths(other)
      longest = lengths.max(initial=0.0), others.max(initial=0.0)
      if distance < clearance - _SURE or max(longest) < _STILL:
        break
      if longest[0] >= longest[1]:
        halves = [(half, other) for half in one.halves(int(lengths.argmax()))]
      else:
        halves = [(one, half) for half in other.halves(int(others.argmax()))]
      for pair in halves:
        found = self._bound(*pair, enough)
        heapq.heappush(waiting, (*found, next(order), *pair))
    return closest

  def _bound(
      self, one: Sweep, other: Sweep, enough: float
  ) -> tuple[float, tuple[float, ...]]:
    """Returns a distance that all poses surely keep, and the point nearest."""
    best: tuple[float, tuple[float, ...]] = -np.inf, tuple(one.centre)
    for first in self._hulls(one):
      for second in self._hulls(other):
        best = max(best, self._distance(first, second, enough))
        if best[0] >= enough:
          return best
    return best

  def _lengths(self, sweep: Sweep) -> np.ndarray:
    """Returns how far each motion takes any point, `(motions,)`, metres."""
    shifts, turns = sweep.motions[:, :3], sweep.motions[:, 3]
    return np.linalg.norm(shifts, axis=1) + (
        np.abs(turns) * self._radius[sweep.geom]
    )

  def _solid(self, sweep: Sweep) -> '_Solid':
    """Returns the geom in the middle pose."""
    geom = sweep.geom
    half = self._half[geom] if self._is_box[geom] else None
    return _Solid(geom, sweep.centre, sweep.matrix, half, self._margin[geom])

  def _hulls(self, sweep: Sweep) -> Iterator['_Solid']:
    """Yields solids that each hold the geom in all of its poses."""
    geom, margin = sweep.geom, self._margin[sweep.geom] + sweep.slack
    if not self._is_box[geom]:
      margin += self._lengths(sweep).sum()
      yield self._solid(sweep)._replace(margin=margin)
      return
    # The first is tight where the box hardly turns, the second where it goes
    # far, the third where it turns far.
    shifts, radius = sweep.motions[:, :3], self._radius[geom]
    lengths = np.linalg.norm(shifts[:, :2], axis=1)
    frames = [sweep.matrix]
    if lengths.any():
      x, y, _ = shifts[lengths.argmax()]
      frames.append(turned(np.eye(3), np.arctan2(y, x)))
    for frame in frames:
      travel = np.abs(shifts @ frame).sum(axis=0)
      half = _extents(self._half[geom], frame.T @ sweep.matrix, sweep.turn)
      yield _Solid(geom, sweep.centre, frame, half + travel, margin)
    if sweep.turn:
      half[:2] = _STILL
      yield _Solid(geom, sweep.centre, frame, half + travel, margin + radius)

  def _distance(
      self, one: '_Solid', other: '_Solid', enough: float
  ) -> tuple[float, tuple[float, ...]]:
    """Returns the distance between two solids and the point between them.

    Beyond `enough`, the distance is some larger one, and the point is any.
    """
    margin = one.margin + other.margin
    limit = max(enough + margin, 0.0) + TOLERANCE
    ends = np.zeros(6)
    for solid in (one, other):
      self._data.geom_xmat[solid.geom] = solid.matrix.ravel()
      self._data.geom_xpos[solid.geom] = solid.centre
      if solid.half is not None:
        self._model.geom_size[solid.geom] = solid.half
    for nudge in _NUDGES:
      self._data.geom_xpos[one.geom] = one.centre + nudge * _ASKEW
      distance = mujoco.mj_geomDistance(
          self._model, self._data, one.geom, other.geom, limit, ends
      )
      # Exactly 0 is also what MuJoCo returns where it finds no answer.
      if distance != 0.0:
        point = (ends[:3] + ends[3:]) / 2
        return distance - nudge - margin, tuple(point)
    return -np.inf, tuple(one.centre)


@final
class _Solid(NamedTuple):
  """A geom somewhere, maybe of another size.

  Attributes:
    geom: Number of the geom in the model.
    centre: `(3,)`, metres.
    matrix: Orientation, `(3, 3)`.
    half: Half the size of a box along its axes, `(3,)`, metres; `None` for a
      geom of another shape, which keeps its size.
    margin: Distance around it that belongs to it, metres.
  """

  geom: int
  centre: np.ndarray
  matrix: np.ndarray
  half: np.ndarray | None
  margin: float = 0.0


def _extents(half: np.ndarray, matrix: np.ndarray, turn: float) -> np.ndarray:
  """Returns half the greatest size of a box along each axis as it turns.

  Args:
    half: Half the size of the box along its own axes, `(3,)`, metres.
    matrix: Orientation of the box, `(3, 3)`; upright, if it turns.
    turn: Angle by which it turns to either side, radians.
  """
  extents = np.abs(matrix) @ half
  if not turn:
    return extents
  angle = np.arctan2(matrix[1, 0], matrix[0, 0])
  corner = np.arctan2(half[1], half[0])
  for axis in range(2):
    # Along an axis a box is widest while one of its corners is on it.
    ways = axis * np.pi / 2 - angle + turn + corner * np.array([1, -1])
    if (ways % np.pi <= 2 * turn).any():
      extents[axis] = np.hypot(*half[:2])
    else:
      for end in (-turn, turn):
        width = (np.abs(turned(matrix, end)) @ half)[axis]
        extents[axis] = max(extents[axis], width)
  return extents


def turned(matrix: np.ndarray, angle: float) -> np.ndarray:
  """Returns an orientation that was turned about the vertical."""
  if not angle:
    return matrix
  cos, sin = np.cos(angle), np.sin(angle)
  return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ matrix
