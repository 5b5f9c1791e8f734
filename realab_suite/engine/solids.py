"""Solids: what the poses of a block fill, and their distances to geoms.

All poses of a cube that moves along a line, anywhere in a region, fill an
oriented box. MuJoCo measures the distance of the box to each geom.
"""

from collections.abc import Iterable, Sequence
import copy
from typing import Any, NamedTuple, Self, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import registers

# Depth up to which solids may overlap, in m.
TOLERANCE = 1e-3
# Half the thickness of solids without any, in m.
_THIN = 1e-6
# Displacements for repeated queries of a distance, in m, and their direction,
# which is not parallel or perpendicular to usual faces.
_NUDGES = (0.0, 1e-5, 5e-5)
_NUDGE_DIRECTION = np.array([0.36, 0.48, 0.8])
# Number of poses of a block that turns, to find one that overlaps.
_NUM_TURNS = 9


@final
class Solid(NamedTuple):
  """A geom of a model in some pose, possibly as a box.

  Attributes:
    geom: Index of the geom in the model.
    centre: Its centre in the world, `(3,)`, in m.
    matrix: Its axes, as columns, `(3, 3)`.
    half: Half the edge lengths of a box that takes its place, `(3,)`, in m;
      `None` if the geom has its own shape.
    margin: Width of a margin that is part of the solid, in m.
  """

  geom: int
  centre: np.ndarray
  matrix: np.ndarray
  half: np.ndarray | None = None
  margin: float = 0.0

  def moved(self, displacement: np.ndarray) -> Self:
    """Returns the solid at another place, `(3,)`, in m from this one."""
    return self._replace(centre=self.centre + displacement)


@final
class Region(NamedTuple):
  """The poses of a block: along a path, and anywhere in a region.

  Attributes:
    geom: Geom of the block.
    path: Path of the block in the frame of its register.
    origin: Origin of that frame, `(3,)`, in m.
    matrix: Axes of that frame, as columns, `(3, 3)`.
    half_size: Half the edge length of the block, in m.
    spread: Half-widths of the region, `(3,)`, in m; 0 for the height.
  """

  geom: int
  path: registers.Path
  origin: np.ndarray
  matrix: np.ndarray
  half_size: float
  spread: np.ndarray

  @property
  def middle(self) -> np.ndarray:
    """Middle of the positions of the centre of the block, `(3,)`, in m."""
    return self.origin + self.matrix @ (self.path.first + self.path.last) / 2

  @property
  def half(self) -> np.ndarray:
    """Half the widths of the box of these positions, `(3,)`, in m."""
    path = self.path
    return np.abs(path.last - path.first) / 2 + self.spread + path.slack

  def moved(self, displacement: np.ndarray) -> Self:
    """Returns the region moved by a vector in its frame, `(3,)`, in m."""
    return self._replace(origin=self.origin + self.matrix @ displacement)

  @property
  def hulls(self) -> list[Solid]:
    """Solids, each of which contains all poses of the block.

    The first one is exact for a block that does not turn, and the second one
    for a block that makes a quarter turn.
    """
    size = np.full(3, self.half_size)
    first, last = self.path.headings
    size[:2] = _half_width(self.half_size, first, last)
    box = Solid(self.geom, self.middle, self.matrix, self.half + size)
    if first == last:
      return [box]
    size[:2] = _THIN
    rounded = box._replace(
        half=self.half + size, margin=np.sqrt(2.0) * self.half_size
    )
    return [box, rounded]

  def corners(self) -> np.ndarray:
    """Returns the extreme positions of the centre, `(corners, 3)`, in m."""
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    half = self.half - [0.0, 0.0, self.path.slack]
    return self.middle + (signs * half) @ self.matrix.T

  def poses_near(self, point: np.ndarray) -> list[tuple[float, Solid]]:
    """Returns poses of the block near a point of the world, `(3,)`, in m.

    Returns:
      Values, with the block in the pose of the value.
    """
    path = self.path
    line = path.last - path.first
    local = (point - self.origin) @ self.matrix - path.first
    square = line @ line
    if square:
      along = [float(np.clip(local @ line / square, 0.0, 1.0))]
    else:
      is_turned = path.headings[0] != path.headings[1]
      along = np.linspace(0.0, 1.0, _NUM_TURNS).tolist() if is_turned else [0.0]
    found = []
    for share in along:
      beside = np.clip(local - share * line, -self.spread, self.spread)
      centre = path.first + share * line + beside
      heading = _between(path.headings, share)
      cos, sin = np.cos(heading), np.sin(heading)
      turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
      block = Solid(
          self.geom,
          self.origin + self.matrix @ centre,
          self.matrix @ turn,
          np.full(3, self.half_size),
      )
      found.append((_between(path.values, share), block))
    return found


def regions(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> list[Region]:
  """Returns all poses that writes can give the blocks of a register.

  Args:
    physics: Physics of one world, in which the register stands where it is; the
      blocks are moved.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  return _regions(physics, register, spread, register.footprint(physics))


def initial_regions(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> list[Region]:
  """Returns the poses in which the blocks of a register begin an episode.

  Args:
    physics: Physics of one world, in which the register has just been settled.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  # Episodes begin with the same value in all ports.
  value = float(np.ravel(register.applied(physics))[0])
  paths = []
  for i, block in enumerate(register.blocks):
    centre, heading = np.array(block.position(physics)), block.heading(physics)
    paths.append(
        registers.Path(i, centre, centre, (value,) * 2, (float(heading),) * 2)
    )
  return _regions(physics, register, spread, paths)


def _regions(
    physics: Any,
    register: registers.Register,
    spread: np.ndarray,
    paths: Sequence[registers.Path],
) -> list[Region]:
  """Returns the regions of paths of the blocks of a register."""
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  origin, matrix = np.array(frame.xpos), np.reshape(frame.xmat, (3, 3)).copy()
  blocks = register.blocks
  geoms = [int(physics.bind(block.geom).element_id) for block in blocks]
  return [
      Region(
          geoms[path.block],
          path,
          origin,
          matrix,
          blocks[path.block].half_size,
          np.array([*spread, 0.0]),
      )
      for path in paths
  ]


def settle(physics: Any, named: Iterable[registers.Register]) -> None:
  """Resets a world and puts registers into the middle of their regions."""
  mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
  physics.mark_as_dirty()
  for register in named:
    register.settle(physics, np.zeros(2), is_initialized=False)
  mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)


@final
class Space:
  """Distances of solids. It works on a copy of the model."""

  def __init__(self, model: mujoco.MjModel) -> None:
    """Copies a compiled model."""
    self._model = copy.copy(model)
    self._data = mujoco.MjData(self._model)
    # Half the size of a box around each geom, with the same centre.
    self._half = np.abs(model.geom_aabb[:, :3]) + model.geom_aabb[:, 3:]

  def solid(self, geom: int, centre: np.ndarray, matrix: np.ndarray) -> Solid:
    """Returns a geom in a pose; see `Solid`."""
    if self._model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
      return Solid(geom, centre, matrix)
    # MuJoCo does not detect a capsule that passes entirely through a box.
    radius, half_length, _ = self._model.geom_size[geom]
    return Solid(
        geom, centre, matrix, np.array([_THIN, _THIN, half_length]), radius
    )

  def posed(self, physics: Any, geom: mjcf.Element) -> Solid:
    """Returns a geom in its present pose in one world."""
    bound = physics.bind(geom)
    matrix = np.reshape(bound.xmat, (3, 3)).copy()
    return self.solid(int(bound.element_id), np.array(bound.xpos), matrix)

  def bounds(self, solid: Solid, way: np.ndarray | None = None) -> np.ndarray:
    """Returns the low and the high corner of a solid's bounds, `(2, 3)`, in m.

    Args:
      solid: The solid.
      way: Displacement of the solid, `(3,)`, in m; `None` if it stays.
    """
    half = self._half[solid.geom] if solid.half is None else solid.half
    reach = np.abs(solid.matrix) @ half + solid.margin
    bounds = np.array([solid.centre - reach, solid.centre + reach])
    if way is not None:
      bounds += np.minimum(way, 0.0), np.maximum(way, 0.0)
    return bounds

  def meet(
      self,
      ones: Sequence[Solid],
      others: Sequence[Solid],
      way: np.ndarray | None = None,
      clearance: float = 0.0,
  ) -> np.ndarray | None:
    """Returns a point where two things meet, `(3,)`, or `None`.

    Each of them is inside all of its solids. Overlaps of up to `TOLERANCE` are
    accepted.

    Args:
      ones: Solids that contain one thing.
      others: Solids that contain the other one.
      way: Displacement of the other one, `(3,)`, in m; `None` if it stays.
      clearance: Smallest distance that they may have, in m.
    """
    length = 0.0 if way is None else float(np.linalg.norm(way))
    done = 0.0
    while True:
      shift = np.zeros(3) if way is None else way * (done / (length or 1.0))
      distance, point = max(
          (
              self._distance(one, other.moved(shift), clearance + bool(length))
              for one in ones
              for other in others
          ),
          key=lambda found: found[0],
      )
      if distance < clearance - TOLERANCE:
        return point
      if done >= length:
        return None
      # It cannot meet the first one on this part of its way.
      free = max(distance - clearance, TOLERANCE / 2)
      done = min(done + free, length)

  def describe(
      self, name: str, region: Region, point: np.ndarray, obstacle: Solid
  ) -> str:
    """Returns which pose of a block is inside an obstacle, as text.

    Args:
      name: Name of the register.
      region: Poses of the block.
      point: Point where they meet the obstacle, `(3,)`, in m.
      obstacle: The obstacle.
    """
    distance, value, block = min(
        (
            (self._distance(block, obstacle, 0.0)[0], value, block)
            for value, block in region.poses_near(point)
        ),
        key=lambda found: found[0],
    )
    # MuJoCo finds no depth of solids in the same pose.
    depth = '' if np.isinf(distance) else f'{-distance:.2g} m '
    x, y, _ = block.centre
    other = self._model.geom(obstacle.geom).name or f'geom {obstacle.geom}'
    return (
        f'register {name!r} at value {value:g} would be at ({x:.3g}, {y:.3g}),'
        f' {depth}inside {other!r}'
    )

  def _distance(
      self, one: Solid, other: Solid, enough: float
  ) -> tuple[float, np.ndarray]:
    """Returns the distance between two solids and the point between them.

    If the distance exceeds `enough`, the result is any distance beyond it, with
    an arbitrary point.
    """
    margin = one.margin + other.margin
    ends = np.zeros(6)
    for solid in (one, other):
      self._data.geom_xmat[solid.geom] = solid.matrix.ravel()
      self._data.geom_xpos[solid.geom] = solid.centre
      if solid.half is not None:
        self._model.geom_type[solid.geom] = mujoco.mjtGeom.mjGEOM_BOX
        self._model.geom_size[solid.geom] = np.maximum(solid.half, _THIN)
    for nudge in _NUDGES:
      self._data.geom_xpos[one.geom] = one.centre + nudge * _NUDGE_DIRECTION
      distance = mujoco.mj_geomDistance(
          self._model, self._data, one.geom, other.geom,
          enough + margin + TOLERANCE, ends,
      )  # fmt: skip
      # MuJoCo also returns exactly 0 if it fails to compute the distance.
      if distance != 0.0:
        return distance - nudge - margin, (ends[:3] + ends[3:]) / 2
    return -np.inf, one.centre


def _half_width(half_size: float, first: float, last: float) -> float:
  """Returns half the width of a square that turns, in m.

  Args:
    half_size: Half the edge length of the square, in m.
    first: Angle at which it begins to turn, in rad.
    last: Angle at which it ends.
  """
  quarters = (np.array(sorted([first, last])) - np.pi / 4) / (np.pi / 2)
  if np.ceil(quarters[0]) <= quarters[1]:  # A corner points along an axis.
    return half_size * np.sqrt(2.0)
  return half_size * max(
      abs(np.cos(angle)) + abs(np.sin(angle)) for angle in (first, last)
  )


def _between(ends: tuple[float, float], share: float) -> float:
  return ends[0] + share * (ends[1] - ends[0])
