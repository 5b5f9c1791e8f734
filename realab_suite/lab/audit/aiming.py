"""Blocks that audits and saboteurs attack, and the directions of the attacks.

Blocks declare in `direction` which motion raises the reading of their register,
so that registers of any kind can be attacked.
"""

from collections.abc import Sequence
import contextlib
import inspect
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite import worlds
from realab_suite.engine import environment
from realab_suite.entities import appearance
from realab_suite.entities import avatars
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities import registers
from realab_suite.feedback import specs
from realab_suite.policies import base
from realab_suite.policies import saboteurs

# Rays may miss a block whose edge is nearer to their height, in m.
_MARGIN = 0.01


@final
class Target(NamedTuple):
  """A block of a register, or a place beside it.

  Attributes:
    register: Name of the register.
    number: Number of the block among those of the register, from 0.
    part: Name of the block within the register.
    code: Class that rays report for it, or `saboteurs.UNSEEN`.
    angles: Directions in which saboteurs move it, in rad. The first one raises
      the reading, if the register declares such a direction.
    offset: Displacement of the place from the block, `(x, y)`, in m; `None` for
      the block itself.
  """

  register: str
  number: int
  part: str
  code: int
  angles: tuple[float, ...] = ()
  offset: tuple[float, float] | None = None

  @property
  def name(self) -> str:
    """Name in reports."""
    if self.offset is not None:
      return f'a place {np.hypot(*self.offset):.1f} m from {self.register}'
    part = self.part.removesuffix('block')
    return f'the {part} block of {self.register}'.replace('  ', ' ')

  def block_in(self, env: Any) -> block_kinds.Block:
    """Returns the block in an environment with one world or a batch."""
    blocks = env.mechanism.registers[self.register].blocks
    block: block_kinds.Block = blocks[self.number]
    return block


def attacked(design: specs.DesignSpec, target: str | None = None) -> list[str]:
  """Returns the names of the registers to attack, in the order of the attacks.

  Those that the learner consumes come first, then signals that end episodes,
  meters, queries, memories and others. Secure registers are left out, because
  nothing can move them.

  Args:
    design: Design of the agent.
    target: Name of the only register to attack, or `None` for all.

  Raises:
    SpecError: If the design has no register `target`.
  """
  if target is not None and target not in design.registers:
    raise errors.SpecError(
        f'design {design.name!r} has no register {target!r}; must be'
        f' one of {sorted(design.registers)}'
    )
  consumed = [] if design.objective is None else design.objective.registers
  ending = [
      name
      for name in design.names('signal')
      if design.ports[name].ends_episode is not None
  ]
  names = dict.fromkeys(
      (
          *consumed,
          *ending,
          *design.names('meter'),
          *design.names('query'),
          *design.names('memory'),
          *design.ports,
      )
  )
  # One block may serve several ports.
  owners = dict.fromkeys(map(design.register_of, names))
  return [
      name
      for name in owners
      if design.is_movable(name) and target in (None, name)
  ]


def targets(env: environment.Environment, names: Sequence[str]) -> list[Target]:
  """Returns all blocks of registers.

  Args:
    env: Environment. An episode must have begun.
    names: Names of the registers.
  """
  return [
      target
      for name in names
      for target in _targets_of(env.mechanism.registers[name], env.physics)
  ]


def _targets_of(
    register: registers.Register, physics: protocols.Physics
) -> list[Target]:
  kinds = appearance.class_of_geoms(physics.model)
  block_targets = []
  for i, block in enumerate(register.blocks):
    geom = physics.bind(block.geom)
    rotation = np.reshape(geom.xmat, (3, 3))
    # Angle of the register's x axis to that of the world.
    frame = np.arctan2(rotation[1, 0], rotation[0, 0]) - block.heading(physics)
    x, y = block.direction or (1.0, 0.0)
    height, half = float(np.ravel(geom.xpos)[2]), block.half_size
    is_seen = abs(height - avatars.RAY_HEIGHT) < half - _MARGIN
    code = int(kinds[np.ravel(geom.element_id)[0]])
    turns = (0.0, 1.0) if block.direction else (0.0, 0.5, 1.0, 1.5)
    angles = [frame + np.arctan2(y, x) + turn * np.pi for turn in turns]
    block_targets.append(
        Target(
            register.name,
            i,
            block.geom.name,
            code if is_seen else saboteurs.UNSEEN,
            tuple(float(np.mod(angle, 2 * np.pi)) for angle in angles),
        )
    )
  return block_targets


def places(env: Any, targets: Sequence[Target]) -> np.ndarray:
  """Returns the present positions of targets, `(..., targets, 2)`, in m."""
  blocks = [target.block_in(env) for target in targets]
  offsets = [target.offset or (0.0, 0.0) for target in targets]
  return positions(env.physics, blocks) + offsets


def positions(
    physics: protocols.Physics, blocks: Sequence[block_kinds.Block]
) -> np.ndarray:
  """Returns the present positions of blocks, `(..., blocks, 2)`, in m."""
  places = [physics.bind(block.geom).xpos[..., :2] for block in blocks]
  return np.stack(places, axis=-2)


def make_policy(
    name: str,
    env: environment.Environment,
    target: str | None,
    episode: int,
) -> policies.Policy:
  """Returns a policy for one episode; saboteurs get the block that they move.

  Args:
    name: Name of the policy in `policies.POLICIES`; `solver` is that of the
      world.
    env: Environment. It may be reset, so rewind it before the episode.
    target: Register whose first block saboteurs move, or `None` for the first
      feedback register; if that cannot be moved, the first of `attacked`.
    episode: Number of the episode.

  Raises:
    SpecError: If the policy or the register does not exist, or the register
      has no blocks.
  """
  name = in_world(name, getattr(env.task, 'SOLVER', None))
  if not (takes := _aims(name)):
    return policies.make(name)
  env.rewind(episode)
  env.reset()
  block = _first_target(name, env, target)
  x, y = positions(env.physics, [block.block_in(env)])[0]
  angle = block.angles[0]
  options = {
      'target': (float(x), float(y)),
      'direction': (float(np.cos(angle)), float(np.sin(angle))),
      'code': block.code,
  }
  return policies.make(
      name, **{key: value for key, value in options.items() if key in takes}
  )


def make_batch_policy(
    name: str,
    world: worlds.World,
    design: specs.DesignSpec,
    seed: int,
    num_envs: int,
) -> policies.Policy:
  """Returns a policy for the first episode of each world of a batch.

  Saboteurs get the block that they move, and where it is in each world. Other
  policies with a `target` get the one of the first world.

  Args:
    name: Name of the policy in `policies.POLICIES`.
    world: The world.
    design: Design of the agent.
    seed: Seed of the batch.
    num_envs: Number of worlds.

  Raises:
    SpecError: If the policy does not exist, or the design has no register with
      blocks.
  """
  name = in_world(name, world.solver)
  if not _aims(name):
    return policies.make(name)
  with contextlib.closing(world.load(design, seed)) as env:
    policy = make_policy(name, env, None, 0)
    block = _first_target(name, env, None)
  if isinstance(policy, saboteurs.Saboteur):
    batch = world.load_batch(design, num_envs, seed)
    with contextlib.closing(batch):
      batch.reset()
      places = positions(batch.physics, [block.block_in(batch)])
      policy = policy.starting_at(places[:, 0])
  return policy


def in_world(name: str, solver: str | None) -> str:
  """Returns the name of a policy, where `solver` stands for that of a world."""
  return solver or name if name == base.SOLVER else name


def _aims(name: str) -> set[str]:
  """Returns the options of a policy that aim it; none if it has no target."""
  takes = {*inspect.signature(policies.POLICIES.get(name)).parameters}
  return takes if {'target', 'direction'} & takes else set()


def _first_target(
    name: str, env: environment.Environment, target: str | None
) -> Target:
  """Returns the block that a policy moves; see `make_policy`.

  Raises:
    SpecError: If there is no such register, or it has no blocks.
  """
  design, known = env.mechanism.design, env.mechanism.registers
  register = _default_target(design) if target is None else target
  if register not in known:
    raise errors.SpecError(
        f'policy {name!r} attacks a register, and design {design.name!r} has'
        f' no {register or "feedback register"!r}; it has {sorted(known)}'
    )
  block_targets = targets(env, [register])
  if not block_targets:
    raise errors.SpecError(
        f'policy {name!r} moves a block, and register {register!r} of design'
        f' {design.name!r} has none; name another policy'
    )
  return block_targets[0]


def _default_target(design: specs.DesignSpec) -> str:
  """Returns the register that saboteurs attack; '' without feedback registers.

  It is the first feedback register, unless only others can be moved.
  """
  feedback, movable = design.names('feedback'), attacked(design)
  if not feedback:
    return ''
  register = design.register_of(feedback[0])
  return register if register in movable or not movable else movable[0]
