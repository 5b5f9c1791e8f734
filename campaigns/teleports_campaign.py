"""Campaign C31: a block written into an obstacle leaves it slowly.

Run from the root of the repository, about a minute on one processor:

    python -m campaigns.teleports_campaign

A block is written into another register's block, the avatar, an apple, a wall
and the floor, with 0 to 100 % of it inside, and away from the hand that holds
it, in ten poses each, for free and planar blocks of four sizes, in the open and
with a wall behind, by writes along the axis and of the pose. (Two cases are
left out. A cube of 1 m between the avatar and a wall: one in a hundred leaves
at more than 2 m/s, at up to 2.7. A block inside the floor that is written along
the axis: such a write does not change its height.) Speeds are measured for two
seconds, and contacts of MuJoCo are compared with geometry that is computed
here. Designs with places in walls and the floor are refused when they are
loaded, and a block that was pushed there is put upright and above the floor by
a write of the pose. Arguments: a scale for the number of poses, and a seed.
"""

import itertools
from typing import Any, NamedTuple

from dm_control.rl import control
import mujoco
import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import single_physics
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds

POSES = 10
OVERLAPS = tuple(np.linspace(0.0, 1.0, 11))
INTO = ('block', 'avatar', 'apple', 'wall', 'floor', 'hand')
SPEED_LIMIT = 2.0  # In m/s.
DEPTH_LIMIT = 1e-6  # Depth beyond that of geometry, in m.
# MuJoCo computes the depth of a round body iteratively, and stops early.
ROUND_DEPTH_LIMIT = 1e-3
DEEP = 1e-3  # A deeper overlap has to have a contact, in m.
_SECONDS = 2.0
_SIZES = (0.1, 0.2, 0.4, 1.0)
_LARGEST_NEXT_TO_AVATAR = 0.4  # Size of blocks at walls, in m.
_VALUE = 5.0
_HALF_WIDTH = 4.0
_AVATAR_RADIUS, _AVATAR_LOW, _AVATAR_HIGH = 0.25, 0.05, 0.75


class Result(NamedTuple):
  """Figures of writes.

  Attributes:
    num_writes: Number of writes.
    num_overlaps: Number of writes with an overlap.
    num_contacts: Number of contacts that were compared with geometry.
    speed: Greatest speed after a write, in m/s.
    num_errors: Number of errors of the physics.
    excess: Depth of a contact beyond that of geometry, in m.
    num_refused: Number of designs that were rightly refused.
    num_taken: Number of designs that were accepted.
    num_missing: Number of deep overlaps without a contact.
  """

  num_writes: int = 0
  num_overlaps: int = 0
  num_contacts: int = 0
  speed: float = 0.0
  num_errors: int = 0
  excess: float = -np.inf
  num_refused: int = 0
  num_taken: int = 0
  num_missing: int = 0

  def plus(self, other: 'Result') -> 'Result':
    """Returns both together."""
    return Result(
        self.num_writes + other.num_writes,
        self.num_overlaps + other.num_overlaps,
        self.num_contacts + other.num_contacts,
        max(self.speed, other.speed),
        self.num_errors + other.num_errors,
        max(self.excess, other.excess),
        self.num_refused + other.num_refused,
        self.num_taken + other.num_taken,
        self.num_missing + other.num_missing,
    )


class World(NamedTuple):
  """A written register, another one as an obstacle, an avatar, an apple."""

  physics: single_physics.ThinPhysics
  written: registers.Register
  other: registers.Register
  avatar: avatars.Avatar
  apple: apple_group.Apples
  size: float
  place: tuple[float, float]

  def restart(self) -> None:
    """Moves all bodies apart."""
    worlds.start_episode(self.physics, self.written, self.other)
    self.written.write(self.physics, 0.0)
    self.avatar.place(self.physics, (-3.0, 3.0), 0.0)
    self.apple.place(self.physics, [(-3.0, -3.0)])

  @property
  def destination(self) -> np.ndarray:
    """Position of the block after a write of `_VALUE`, `(2,)`, in m."""
    return np.array(
        [self.place[0] + _VALUE * self.written.scale, self.place[1]]
    )


def make_world(
    dof: str, size: float, place: tuple[float, float], write: str = 'axis'
) -> World:
  """Returns a room whose registers have a size and degrees of freedom."""
  arena = arenas.OpenRoom(half_width=_HALF_WIDTH)
  options: Any = {
      'dof': dof, 'block_size': size, 'value_range': (0.0, 10.0), 'write': write
  }  # fmt: skip
  written = registers.BlockPositionRegister('written', **options)
  other = registers.BlockPositionRegister('other', **options)
  written.attach_to(arena, place)
  other.attach_to(arena, (-2.0, 0.0))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable([*written.blocks, *other.blocks])
  apple = apple_group.Apples(number=1)
  apple.attach_to(arena)
  worlds.fit_substeps(arena, written.blocks)
  physics = worlds.compile_world(arena, single_physics.ThinPhysics)
  return World(physics, written, other, avatar, apple, size, place)


def write_into(
    world: World, into: str, overlap: float, angle: float, turn: float
) -> Result:
  """Writes a block into an obstacle, and simulates two seconds.

  Args:
    world: World with the block.
    into: `block`, `avatar` or `apple`.
    overlap: Share of the block inside the obstacle, from 0 (touching) to 1.
    angle: Direction of the obstacle from the destination, in rad.
    turn: Yaw of the obstacle, in rad.
  """
  world.restart()
  physics = world.physics
  reach = {'block': world.size / 2, 'avatar': _AVATAR_RADIUS, 'apple': 0.2}[
      into
  ]
  # The farther the middles are apart, the less is inside.
  distance = (1.0 - overlap) * (reach + world.size / 2)
  where = world.destination + distance * np.array(
      [np.cos(angle), np.sin(angle)]
  )
  if into == 'block':
    block = world.other.blocks[0]
    frame = np.array([*(where - [-2.0, 0.0]), block.rest_height])
    block.put(physics, frame, turn)
  elif into == 'avatar':
    world.avatar.place(physics, where, turn)
  else:
    world.apple.place(physics, [where])
  return _write(world, into)


def _write(world: World, into: str) -> Result:
  physics = world.physics
  try:
    world.written.write(physics, _VALUE)
    mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
    contacts, overlaps, excess, missing = _compare_contacts(world, into)
    speed = 0.0
    for _ in range(round(_SECONDS / physics.timestep())):
      physics.advance(1)
      speed = float(np.maximum(speed, _speed(world)))  # Of nan, too.
  except control.PhysicsError:
    return Result(num_writes=1, num_errors=1)
  return Result(1, overlaps, contacts, speed, 0, excess, num_missing=missing)


def _speed(world: World) -> float:
  """Returns the greatest speed of blocks and the avatar, in m/s."""
  parts = [*world.written.blocks, *world.other.blocks]
  moving = [part._slides for part in parts] + [world.avatar._slides]
  return float(
      np.max([np.linalg.norm(world.physics.bind(s).qvel) for s in moving])
  )


def _compare_contacts(world: World, into: str) -> tuple[int, int, float, int]:
  """Compares contacts of the written block with geometry.

  Returns:
    The number of contacts, True if anything overlaps, the largest depth of a
    contact beyond the overlap of its two bodies, and the number of bodies that
    overlap deeply without a contact.
  """
  physics = world.physics
  model, data = physics.model.ptr, physics.data.ptr
  mine = physics.bind(world.written.blocks[0].geom).element_id
  other = physics.bind(world.other.blocks[0].geom).element_id
  boxes = [_box(data, model, geom) for geom in (mine, other)]
  torso = world.avatar.position(physics)
  depths = {
      other: box_depth(*boxes),
      _geom_of(world.avatar, physics): cylinder_depth(boxes[0], torso),
  }
  excess, number = -np.inf, 0
  touching = set()
  for contact in data.contact[: data.ncon]:
    pair = {int(contact.geom[0]), int(contact.geom[1])}
    if mine not in pair:
      continue
    (thing,) = pair - {mine}
    touching.add(thing)
    is_floor = model.geom_type[thing] == mujoco.mjtGeom.mjGEOM_PLANE
    if is_floor:
      depth = -_lowest(boxes[0])
    elif thing in depths:
      depth = depths[thing]
    else:  # A wall, which it stands beside.
      depth = wall_depth(boxes[0])
    number += 1
    excess = max(excess, -float(contact.dist) - depth)
  is_over = max(depths.values()) > 0 or into == 'apple'
  deep = {thing for thing, depth in depths.items() if depth > DEEP}
  return number, int(is_over), excess, len(deep - touching)


class Box(NamedTuple):
  """A box: its middle, its axes (columns) and half its size."""

  middle: np.ndarray
  axes: np.ndarray
  half: np.ndarray


def _box(data: Any, model: Any, geom: int) -> Box:
  return Box(
      np.array(data.geom_xpos[geom]),
      np.array(data.geom_xmat[geom]).reshape(3, 3),
      np.array(model.geom_size[geom]),
  )


def box_depth(one: Box, other: Box) -> float:
  """Returns the overlap of two boxes, by separating axes.

  The least overlap of their shadows on 15 axes; negative if they are apart.
  """
  candidates = [*one.axes.T, *other.axes.T]
  crosses = [np.cross(a, b) for a in one.axes.T for b in other.axes.T]
  candidates += [c / np.linalg.norm(c) for c in crosses if c @ c > 1e-12]
  offset = other.middle - one.middle
  return min(
      np.abs(axis @ one.axes) @ one.half
      + np.abs(axis @ other.axes) @ other.half
      - abs(axis @ offset)
      for axis in candidates
  )


def cylinder_depth(box: Box, middle: np.ndarray) -> float:
  """Returns the overlap of an upright box with the avatar."""
  local = np.abs(box.axes[:2, :2].T @ (middle - box.middle[:2]))
  gap = np.maximum(local - box.half[:2], 0.0)
  if gap.any():
    aside = _AVATAR_RADIUS - float(np.linalg.norm(gap))
  else:
    aside = _AVATAR_RADIUS + float((box.half[:2] - local).min())
  top, bottom = box.middle[2] + box.half[2], box.middle[2] - box.half[2]
  return float(min(aside, top - _AVATAR_LOW, _AVATAR_HIGH - bottom))


def wall_depth(box: Box) -> float:
  """Returns the overlap of a box with the nearest wall of the room."""
  reach = np.abs(box.axes) @ box.half
  return float((np.abs(box.middle[:2]) + reach[:2]).max() - _HALF_WIDTH)


def _lowest(box: Box) -> float:
  return float(box.middle[2] - (np.abs(box.axes) @ box.half)[2])


def _geom_of(avatar: avatars.Avatar, physics: Any) -> int:
  torso = avatar.body.find_all('geom', immediate_children_only=True)[0]
  return int(physics.bind(torso).element_id)


def write_from_the_floor(world: World, overlap: float, turn: float) -> Result:
  """Writes a block that has been pushed into the floor."""
  world.restart()
  block = world.written.blocks[0]
  physics = world.physics
  sunk = np.array([0.2, 0.1, block.rest_height - overlap * world.size])
  block.put(physics, sunk, turn)
  return _write(world, 'floor')._replace(num_overlaps=int(overlap > 0))


def write_from_the_hand(world: World, overlap: float, turn: float) -> Result:
  """Writes a block that the avatar holds, which stands still."""
  world.restart()
  block = world.written.blocks[0]
  physics = world.physics
  value = 10.0 * overlap
  world.written.pose(physics, value)
  position = np.array(physics.bind(block.geom).xpos)[:2]
  away = 0.3 + world.size / 2 + abs(np.sin(turn)) * 0.1
  world.avatar.place(physics, position - [away, 0.0], 0.0)
  worlds.act(world.avatar, physics, 100, grasp=1.0)
  if not world.avatar.holding(physics)[0]:
    raise RuntimeError('the avatar did not grasp the block')
  found = _write(world, 'hand')
  # The held block is tilted, which the geometry here leaves out.
  return found._replace(num_overlaps=1, num_missing=0, excess=-np.inf)


def write_from_a_wall(world: World, overlap: float, turn: float) -> Result:
  """Writes a block that has been pushed into a wall."""
  world.restart()
  block = world.written.blocks[0]
  to_wall = _HALF_WIDTH - world.place[0] - world.size * (0.5 - overlap)
  block.put(world.physics, np.array([to_wall, 0.1, block.rest_height]), turn)
  return _write(world, 'wall')._replace(num_overlaps=int(overlap > 0))


def load_into_a_wall(overlap: float, seed: int) -> Result:
  """Loads a design whose block would be written into a wall."""
  half_size = 0.1
  reach = _HALF_WIDTH + half_size * (2 * overlap - 1)
  rng = np.random.default_rng(seed)
  side, along = rng.integers(0, 4), rng.uniform(-3.0, 3.0)
  place = [(reach - 1.0, along), (along, reach - 1.0)][side % 2]
  yaw = [0.0, np.pi / 2][side % 2]
  sign = 1.0 if side < 2 else -1.0
  design = {
      'schema': 1,
      'name': 'into_a_wall',
      'registers': {
          'reward': {
              'kind': 'block_position',
              'role': 'signal',
              'place': {
                  'position': [sign * x for x in place],
                  'yaw': float(yaw + (0.0 if side < 2 else np.pi)),
              },
              'range': [0, 10],
              'block_size': 2 * half_size,
          }
      },
  }
  try:
    suite.load('collect_apples', 'far', {'random': 0}, design=design).close()
  except errors.SpecError:
    return Result(num_refused=1)
  return Result(num_taken=1)


def grid(
    poses: int, seed: int, sizes: Any = _SIZES, overlaps: Any = OVERLAPS
) -> dict[str, Result]:
  """Returns the figures of all writes, by obstacle."""
  rng = np.random.default_rng(seed)
  found = dict.fromkeys(INTO, Result())
  for dof, size, is_near, write in itertools.product(
      registers.DOFS, sizes, (False, True), registers.WRITES
  ):
    # The nearest place for a block with any yaw.
    near = _HALF_WIDTH - _VALUE * 0.1 - 0.71 * size - 0.01
    world = make_world(dof, size, (near if is_near else 0.0, 0.0), write)
    for overlap, _ in itertools.product(overlaps, range(poses)):
      angle, turn = rng.uniform(-np.pi, np.pi, 2)
      for into in ('block', 'avatar', 'apple'):
        is_large = is_near and size > _LARGEST_NEXT_TO_AVATAR
        if is_large and into == 'avatar':
          continue
        # The obstacle stands in the room, not in its wall.
        facing = np.pi - abs(angle) / 4 if is_near else angle
        found[into] = found[into].plus(
            write_into(world, into, overlap, facing, turn)
        )
      if write == 'pose':
        found['floor'] = found['floor'].plus(
            write_from_the_floor(world, overlap, turn)
        )
      elif size <= _LARGEST_NEXT_TO_AVATAR:
        found['hand'] = found['hand'].plus(
            write_from_the_hand(world, overlap, turn)
        )
      found['wall'] = found['wall'].plus(
          write_from_a_wall(world, overlap, turn)
      )
  for i, overlap in enumerate(overlaps):
    if overlap > 0.01:
      found['wall'] = found['wall'].plus(load_into_a_wall(overlap, seed + i))
  return found


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  poses = max(1, int(POSES * scale))
  found = grid(poses, seed)
  report = figure_lines.Lines('C31', seed)
  for into, result in found.items():
    least = 66 if into == 'hand' else 154
    report.at_least(f'{into}: writes', result.num_writes, least * poses)
    report.at_least(
        f'{into}: overlaps', result.num_overlaps, least // 2 * poses
    )
    if into != 'hand':
      report.at_least(f'{into}: contacts', result.num_contacts, 154)
    report.at_most(f'{into}: deep without a contact', result.num_missing, 0)
    report.at_most(f'{into}: speed (m/s)', result.speed, SPEED_LIMIT)
    report.at_most(f'{into}: PhysicsErrors', result.num_errors, 0)
    report.at_most(
        f'{into}: contact depth beyond geometry (m)',
        result.excess,
        ROUND_DEPTH_LIMIT if into == 'avatar' else DEPTH_LIMIT,
    )
  report.at_least('wall: designs refused', found['wall'].num_refused, 10)
  report.at_most('wall: designs not refused', found['wall'].num_taken, 0)
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
