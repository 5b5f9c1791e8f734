"""Collision checks of geoms that move along lines, by bounds, not samples."""

from collections.abc import Iterator, Sequence
import copy
import dataclasses
import heapq
import itertools
from typing import NamedTuple, Self, final

import mujoco
import numpy as np

# Depth up to which geoms may overlap, in metres.
TOLERANCE = 1e-3
# Depth at which a search stops and reports an overlap, in metres. Resolving
# smaller depths would take long.
_STOP_DEPTH = 1e-4
# Number of pairs of sweeps to check. Undecided cases count as overlaps.
_MAX_PAIRS = 2000
# Length of motions that are treated as none, in metres.
_NEGLIGIBLE = 1e-6
# Displacements for repeated queries of a distance, in metres, and their
# direction, which is not parallel or perpendicular to usual faces.
_NUDGES = (0.0, 1e-5, 5e-5)
_NUDGE_DIRECTION = np.array([0.36, 0.48, 0.8])
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE


@final
@dataclasses.dataclass(frozen=True)
class Sweep:
  """Set of the poses of a geom that moves along lines and may turn.

  Each motion displaces the geom from its middle pose to either side. Motions
  are independent and add up.

  Attributes:
    geom: Number of the geom in the model.
    centre: Centre of the geom in its middle pose, `(3,)`, in metres.
    matrix: Orientation of the geom in its middle pose, `(3, 3)`.
    motions: Change by each motion from the middle to one side, `(motions, 5)`:
      of the centre, in metres, of the angle about the vertical, in radians, and
      of the value of a register. Only upright boxes may turn.
    value: Value of the register in the middle pose.
    slack: Distance by which poses may differ from these, in metres.
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
    """Largest displacement of the centre along each axis, `(3,)`, in metres."""
    return np.abs(self.motions[:, :3]).sum(axis=0)

  @property
  def turn(self) -> float:
    """Largest angle from the middle pose, in radians."""
    return float(np.abs(self.motions[:, 3]).sum())

  def pose(self, sides: np.ndarray) -> Self:
    """Returns one pose.

    Args:
      sides: Position along each motion, from -1 to 1, `(motions,)`.
    """
    return self._moved(sides, np.zeros(len(sides)))

  def toward(self, point: Sequence[float]) -> Self:
    """Returns a pose whose centre is near a point, `(3,)`, in metres."""
    sides = np.zeros(len(self.motions))
    offset = np.array(point) - self.centre
    for i, (*shift, _, _) in enumerate(self.motions):
      if square := np.dot(shift, shift):  # It underflows for tiny shifts.
        sides[i] = np.clip(offset @ shift / square, -1.0, 1.0)
        offset = offset - sides[i] * np.array(shift)
    return self.pose(sides)

  def halves(self, motion: int) -> Iterator[Self]:
    """Yields the two halves of the sweep that a motion's middle separates."""
    is_halved = np.arange(len(self.motions)) == motion
    for side in (-0.5, 0.5):
      yield self._moved(side * is_halved, 1.0 - 0.5 * is_halved)

  def _moved(self, to: np.ndarray, lengths: np.ndarray) -> Self:
    """Returns a part of the sweep.

    Args:
      to: Position of the new middle pose along each motion, `(motions,)`.
      lengths: Factors for the lengths of the motions, `(motions,)`.
    """
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
  """Distance queries between geoms of a model, in any pose and size.

  It works on a copy of the model.
  """

  def __init__(self, model: mujoco.MjModel) -> None:
    """Copies a compiled model."""
    self._model = copy.copy(model)
    self._data = mujoco.MjData(self._model)
    self._is_box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    # Half the size of a box around each geom, with the same centre.
    self._half = np.abs(model.geom_aabb[:, :3]) + model.geom_aabb[:, 3:]
    # Width of a margin around that box that is part of the geom.
    self._margin = np.zeros(model.ngeom)
    for geom in np.flatnonzero(model.geom_type == _CAPSULE).tolist():
      # MuJoCo does not detect a capsule that passes entirely through a box.
      radius, half_length, _ = model.geom_size[geom]
      half = np.array([_NEGLIGIBLE, _NEGLIGIBLE, half_length])
      self.make_box(geom, half, radius)
    self._radius = np.linalg.norm(self._half[:, :2], axis=1)

  def make_box(self, geom: int, half: np.ndarray, margin: float = 0.0) -> None:
    """Changes the shape of a geom to a box with a margin around it.

    Args:
      geom: Number of the geom.
      half: Half the size of the box along its axes, `(3,)`, in metres.
      margin: Width of the margin, in metres.
    """
    self._model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_BOX
    self._is_box[geom] = True
    self._half[geom] = half
    self._margin[geom] = margin

  def bounds(self, sweep: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """Returns the low and high corners, `(3,)`, of the bounds of a sweep."""
    geom = sweep.geom
    reach = _extents(self._half[geom], sweep.matrix, sweep.turn)
    reach += sweep.travel + sweep.slack + self._margin[geom]
    return sweep.centre - reach, sweep.centre + reach

  def meet(
      self, one: Sweep, other: Sweep, clearance: float = 0.0
  ) -> tuple[Sweep, float] | None:
    """Finds poses in which two geoms are too close to each other.

    If it returns `None`, no distance is smaller than the clearance by more than
    `TOLERANCE`. (Negative distances are depths of overlaps.) A returned pose is
    closer than that, or too near this limit to be decided in reasonable time.

    Args:
      one: Poses of a geom.
      other: Poses of another geom.
      clearance: Minimum distance between the geoms, in metres.

    Returns:
      A pose of `one` and its distance from `other`, in metres; or `None`.
    """
    enough = clearance - TOLERANCE
    order = itertools.count()  # Breaks ties in the queue.
    queue = [(*self._bound(one, other, enough), next(order), one, other)]
    closest = one, np.inf
    for _ in range(_MAX_PAIRS):
      bound, point, _, one, other = heapq.heappop(queue)
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
      if distance < clearance - _STOP_DEPTH or max(longest) < _NEGLIGIBLE:
        break
      if longest[0] >= longest[1]:
        halves = [(half, other) for half in one.halves(int(lengths.argmax()))]
      else:
        halves = [(one, half) for half in other.halves(int(others.argmax()))]
      for pair in halves:
        found = self._bound(*pair, enough)
        heapq.heappush(queue, (*found, next(order), *pair))
    return closest

  def _bound(
      self, one: Sweep, other: Sweep, enough: float
  ) -> tuple[float, tuple[float, ...]]:
    """Returns a lower bound of the distance of all poses, and a close point."""
    best: tuple[float, tuple[float, ...]] = -np.inf, tuple(one.centre)
    for first in self._hulls(one):
      for second in self._hulls(other):
        best = max(best, self._distance(first, second, enough))
        if best[0] >= enough:
          return best
    return best

  def _lengths(self, sweep: Sweep) -> np.ndarray:
    """Returns the largest displacement by each motion, `(motions,)`, metres."""
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
    """Yields solids, each of which contains the geom in all of its poses."""
    geom, margin = sweep.geom, self._margin[sweep.geom] + sweep.slack
    if not self._is_box[geom]:
      margin += self._lengths(sweep).sum()
      yield self._solid(sweep)._replace(margin=margin)
      return
    # The first is tight for small turns, the second for long displacements, the
    # third for large turns.
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
      half[:2] = _NEGLIGIBLE
      yield _Solid(geom, sweep.centre, frame, half + travel, margin + radius)

  def _distance(
      self, one: '_Solid', other: '_Solid', enough: float
  ) -> tuple[float, tuple[float, ...]]:
    """Returns the distance between two solids and the point between them.

    If the distance exceeds `enough`, the result is any distance beyond it, with
    an arbitrary point.
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
      self._data.geom_xpos[one.geom] = one.centre + nudge * _NUDGE_DIRECTION
      distance = mujoco.mj_geomDistance(
          self._model, self._data, one.geom, other.geom, limit, ends
      )
      # MuJoCo also returns exactly 0 if it fails to compute the distance.
      if distance != 0.0:
        point = (ends[:3] + ends[3:]) / 2
        return distance - nudge - margin, tuple(point)
    return -np.inf, tuple(one.centre)


@final
class _Solid(NamedTuple):
  """A geom in one pose, possibly with another size.

  Attributes:
    geom: Number of the geom in the model.
    centre: Centre of the geom, `(3,)`, in metres.
    matrix: Orientation of the geom, `(3, 3)`.
    half: Half the size of a box along its axes, `(3,)`, in metres; `None` for a
      geom of another shape, whose size does not change.
    margin: Width of a margin that is part of the solid, in metres.
  """

  geom: int
  centre: np.ndarray
  matrix: np.ndarray
  half: np.ndarray | None
  margin: float = 0.0


def _extents(half: np.ndarray, matrix: np.ndarray, turn: float) -> np.ndarray:
  """Returns half the largest extent of a turning box along each axis, `(3,)`.

  Args:
    half: Half the size of the box along its own axes, `(3,)`, in metres.
    matrix: Orientation of the box, `(3, 3)`; upright, if it turns.
    turn: Angle by which it turns to either side, in radians.
  """
  extents = np.abs(matrix) @ half
  if not turn:
    return extents
  angle = np.arctan2(matrix[1, 0], matrix[0, 0])
  corner = np.arctan2(half[1], half[0])
  for axis in range(2):
    # A box is widest along an axis when one of its corners is on the axis.
    angles = axis * np.pi / 2 - angle + turn + corner * np.array([1, -1])
    if (angles % np.pi <= 2 * turn).any():
      extents[axis] = np.hypot(*half[:2])
    else:
      for end in (-turn, turn):
        width = (np.abs(turned(matrix, end)) @ half)[axis]
        extents[axis] = max(extents[axis], width)
  return extents


def turned(matrix: np.ndarray, angle: float) -> np.ndarray:
  """Returns an orientation after a turn about the vertical, in radians."""
  if not angle:
    return matrix
  cos, sin = np.cos(angle), np.sin(angle)
  return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ matrix
