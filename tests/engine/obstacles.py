"""Rooms with random obstacles and registers, and how deep these overlap."""

import dataclasses
import itertools
from typing import Any

from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import placement
from realab_suite.entities import moving
from realab_suite.tasks import collect_apples

_SHAPES = ('box', 'cylinder', 'sphere', 'capsule', 'ellipsoid')
_NUM_SIZES = {'sphere': 1, 'cylinder': 2, 'capsule': 2}


@dataclasses.dataclass(frozen=True)
class Obstacle:
  """Something that nothing can push; it moves if it has a way to go."""

  shape: str
  size: tuple[float, float, float]
  position: tuple[float, float]
  yaw: float
  travel: tuple[float, float] | None


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
  return st.floats(low, high).map(lambda x: round(x, 3))


_yaws = st.sampled_from([0.0, np.pi / 2, np.pi / 4]) | _floats(-3.0, 3.0)
_obstacles = st.builds(
    Obstacle,
    st.sampled_from(_SHAPES),
    st.tuples(*[_floats(0.05, 0.6)] * 3),
    st.tuples(_floats(-3.3, 3.3), _floats(0.6, 3.3)),
    _yaws,
    st.none() | st.tuples(_floats(-1.5, 1.5), _floats(-1.5, 1.5)),
)


@st.composite
def _registers(draw: Any) -> dict[str, Any]:
  kind = draw(
      st.sampled_from(['two_block', 'block_position', 'block_orientation'])
  )
  low = draw(_floats(-1.0, 0.5))
  high = low + draw(_floats(0.1, 1.0))
  spreads = st.just(0.0) | _floats(0.0, 1.2)
  return {
      'kind': kind,
      'role': 'feedback',
      'place': {
          'position': [draw(_floats(-3.0, 3.0)), draw(_floats(0.6, 3.0))],
          'yaw': draw(_yaws),
          'spread': [draw(spreads), draw(spreads)],
      },
      'range': [low, high],
      'initial': low,
      'scale': draw(_floats(0.1, 1.9)),
      'channel': draw(st.sampled_from(['embedded', 'secure'])),
      'dof': draw(st.sampled_from(['free', 'planar'])),
      'block_size': draw(st.just(0.2) | _floats(0.06, 0.6)),
  }


@st.composite
def _rooms(draw: Any) -> tuple[list[Obstacle], list[dict[str, Any]]]:
  obstacles = draw(st.lists(_obstacles, min_size=1, max_size=3))
  registers = draw(st.lists(_registers(), min_size=1, max_size=2))
  table = obstacles[0]
  if draw(st.booleans()) and table.shape in ('box', 'cylinder'):
    # A register near the middle of the top of the first obstacle.
    x, y = table.position
    registers[0]['place'] |= {
        'position': [x, y, 2 * table.size[-1]],
        'spread': [draw(st.just(0.0) | _floats(0.0, 0.4)), 0.0],
    }
  return obstacles, registers


rooms = _rooms()


@dataclasses.dataclass(frozen=True)
class Room:
  """A room with its obstacles and registers, loaded."""

  env: environment.Environment
  parts: list[moving.MovingPart]

  def deepest(self, num_samples: int, seed: int = 0) -> float:
    """Returns the deepest overlap of a block that sampling finds, metres.

    Registers are put anywhere in their regions, extremes above all, and get
    any value, by their own methods; parts are put anywhere on their ways. What
    is outside the room counts as an overlap.
    """
    rng = np.random.default_rng(seed)
    physics, found = self.env.physics, 0.0
    named = self.env.mechanism.registers
    blocks = [self._ids(register.blocks) for register in named.values()]
    solid = self._obstacles()
    pairs = [(b, s) for ids in blocks for b in ids for s in solid]
    for one, other in itertools.combinations(blocks, 2):
      pairs += itertools.product(one, other)
    extent = self.env.task.root_entity.extent
    starts = [np.array(physics.bind(p.frame).mocap_pos) for p in self.parts]
    for sample in range(num_samples):
      if sample % 4 == 0:
        with physics.reset_context():
          for register in named.values():
            register.settle(physics, register.spread * _sides(rng, 2))
      for register in named.values():
        spec = register.value_spec
        share = (1.0 + _sides(rng, 1)[0]) / 2
        value = spec.minimum + share * (spec.maximum - spec.minimum)
        register.write(physics, np.clip(value, spec.minimum, spec.maximum))
      for part, start in zip(self.parts, starts, strict=True):
        share = (1.0 + _sides(rng, 1)[0]) / 2
        moving.move(physics, part.frame, start + share * part.travel)
      mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
      for ids in blocks:
        for x, y, _ in physics.data.geom_xpos[ids]:
          found = max(found, -min(
              x - extent.low[0], y - extent.low[1],
              extent.high[0] - x, extent.high[1] - y,
          ))  # fmt: skip
      found = max(found, self._unsupported(blocks))
      for one, other in pairs:
        distance = mujoco.mj_geomDistance(
            physics.model.ptr, physics.data.ptr, one, other, 0.1, None
        )
        found = max(found, -distance)
    return found

  def deepest_start(self, num_episodes: int) -> float:
    """Returns the deepest overlap that an episode begins with, metres."""
    physics, found = self.env.physics, 0.0
    for _ in range(num_episodes):
      self.env.reset()
      mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
      for register in self.env.mechanism.registers.values():
        for one in self._ids(register.blocks):
          for other in self._obstacles():
            distance = mujoco.mj_geomDistance(
                physics.model.ptr, physics.data.ptr, one, other, 0.1, None
            )
            found = max(found, -distance)
    return found

  def _unsupported(self, blocks: list[list[int]]) -> float:
    """Returns 1 if a block above the floor has nothing under its centre."""
    model, data = self.env.physics.model, self.env.physics.data
    for geom in itertools.chain(*blocks):
      half, centre = model.geom_size[geom][2], np.array(data.geom_xpos[geom])
      if centre[2] - half < 0.02:
        continue
      below, hit = np.array([0.0, 0.0, -1.0]), np.array([-1], np.int32)
      distance = mujoco.mj_ray(
          model.ptr, data.ptr, centre, below, None, 1,
          model.geom_bodyid[geom], hit, None,
      )  # fmt: skip
      if not half - 2e-3 < distance < half + 0.02:
        return 1.0
    return 0.0

  def _ids(self, blocks: Any) -> list[int]:
    return [int(self.env.physics.bind(b.geom).element_id) for b in blocks]

  def _obstacles(self) -> list[int]:
    model = self.env.physics.model
    names = [model.id2name(i, 'geom') for i in range(model.ngeom)]
    walls = [
        i
        for i, name in enumerate(names)
        if name.startswith(('wall_', 'obstacle_'))
    ]
    geoms = [geom for part in self.parts for geom in part.geoms]
    return walls + [self.env.physics.bind(g).element_id for g in geoms]


def _sides(rng: np.random.Generator, number: int) -> np.ndarray:
  """Draws from -1 to 1, the ends more often than anything else."""
  return np.clip(rng.uniform(-1.5, 1.5, number), -1.0, 1.0)


def build(obstacles: list[Obstacle], registers: list[dict[str, Any]]) -> Room:
  """Loads a room.

  Raises:
    SpecError: If the registers do not fit.
  """
  # For blocks of any size.
  task = collect_apples.CollectApples(physics_timestep=0.01)
  root = task.root_entity
  parts = []
  for i, obstacle in enumerate(obstacles):
    half_height = obstacle.size[-1]
    geom = {
        'type': obstacle.shape,
        'size': obstacle.size[: _NUM_SIZES.get(obstacle.shape, 3)],
        'quat': (np.cos(obstacle.yaw / 2), 0, 0, np.sin(obstacle.yaw / 2)),
    }
    place = (*obstacle.position, half_height)
    if obstacle.travel is None:
      root.mjcf_model.worldbody.add(
          'geom', name=f'obstacle_{i}', pos=place, **geom
      )
    else:
      parts.append(moving.MovingPart(f'part_{i}', [geom]))
      parts[-1].attach_to(root, place, (*obstacle.travel, 0.0))
  named = {f'r{i}': register for i, register in enumerate(registers)}
  design = {'schema': 1, 'name': 'placed', 'registers': named}
  return Room(suite.embed(task, design, random=0), parts)


def build_anyway(
    patch: pytest.MonkeyPatch,
    obstacles: list[Obstacle],
    registers: list[dict[str, Any]],
) -> Room:
  """Loads a room, whether the registers fit or not."""
  with patch.context() as unchecked:
    for name in ('check', 'check_start'):
      unchecked.setattr(placement, name, lambda *args: None)
    return build(obstacles, registers)
