"""Campaign C30: pushed blocks stay in the room, and above the floor.

Run from the root of the repository, about fifteen minutes on two processors:

    python -m campaigns.bulldozers_campaign

50 scripted pushers at full force shove blocks at walls and into corners and
doorways, carry and throw them, and stack them, for 2,000 control steps each, in
ten rounds with other seeds: 1e6 control steps. In one half, all blocks have
usual sizes and a control step has 4 substeps; in the other half, the blocks
measure from 6 cm to 1 m, the limits of designs, and a control step has the 10
substeps that they need. They weigh from 10 g to 100 kg. In half of the rounds
the registers are written in every control step, which a hand that holds a block
outlasts.
Arguments: a scale for the number of rounds and of steps, and a seed.
"""

from typing import Any, NamedTuple, final

import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds

PUSHERS = 50
STEPS = 2_000
ROUNDS = 10
# Distance from the inner face of a wall that counts as outside, in m.
MARGIN = 0.05
_STEPS_PER_ERRAND = 60
_BEHIND = 0.75  # Distance between a pusher and the block that it runs at, in m.
_PUSH, _CARRY, _THROW, _RAM = range(4)


def _register(place: Any, **keys: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block',
      'role': 'signal',
      'place': place,
      'range': [0, 10],
      **keys,
  }


DESIGN: dict[str, Any] = {
    'schema': 1,
    'name': 'bulldozed',
    'registers': {
        'usual': _register([1.8, -0.6]),
        'planar': _register([1.8, 0.6], dof='planar'),
        'large': _register([-3.0, 1.6], block_size=0.4, mass=5.0),
        'huge': _register(
            [-2.9, -2.9], kind='block_position', block_size=1.0, mass=100.0
        ),
        'small': _register([-2.8, 0.4], block_size=0.1, mass=0.2),
        'tiny': _register([1.8, -2.0], block_size=0.06, mass=0.01),
        'tiny_planar': _register(
            [1.8, -2.6], block_size=0.06, mass=0.01, dof='planar'
        ),
        'dense': _register([1.8, 3.0], block_size=0.1, mass=100.0),
        'turned': _register(
            {'position': [-1.0, -3.3], 'yaw': 0.5},
            kind='block_orientation',
            block_size=0.3,
            mass=20.0,
            range=[-1, 1],
            scale=1.0,
        ),
        'fixed': _register([0.3, -3.3], channel='welded', range=[0, 5]),
    },
}  # fmt: skip
# Blocks of 0.15 to 0.4 m, which long substeps suit.
_USUAL = ('usual', 'planar', 'large', 'turned', 'fixed')
USUAL_DESIGN = DESIGN | {
    'registers': {
        **{name: DESIGN['registers'][name] for name in _USUAL},
        'light': _register([1.8, -2.0], block_size=0.15, mass=0.1),
        'light_planar': _register(
            [1.8, -2.8], block_size=0.15, mass=0.1, dof='planar'
        ),
        'dense': _register([1.8, 2.6], block_size=0.15, mass=100.0),
    }
}


class Result(NamedTuple):
  """Counts of blocks, over all worlds and control steps.

  Attributes:
    num_steps: Control steps of all worlds.
    num_outside: Blocks outside the walls, in worlds without a warning.
    num_under: Blocks with the middle under the floor, without a warning.
    num_not_finite: Positions that are not finite, without a warning.
    num_flagged: Worlds in which MuJoCo warned of a failure.
    num_moving: Blocks faster than 0.1 m/s.
    num_at_walls: Blocks that touch a wall.
    num_lifted: Blocks that are off the floor.
    num_held: Hands that hold a block.
    num_through: Blocks in the doorway or beyond it.
    worst: Descriptions of the first violations.
  """

  num_steps: int = 0
  num_outside: int = 0
  num_under: int = 0
  num_not_finite: int = 0
  num_flagged: int = 0
  num_moving: int = 0
  num_at_walls: int = 0
  num_lifted: int = 0
  num_held: int = 0
  num_through: int = 0
  worst: tuple[str, ...] = ()

  def plus(self, other: 'Result') -> 'Result':
    """Returns both together."""
    return Result(*(a + b for a, b in zip(self, other, strict=True)))


def is_outside(
    arena: arenas.RoomArena, points: np.ndarray, margin: Any = MARGIN
) -> np.ndarray:
  """Returns True for points `(..., 2)` outside the walls of an arena."""
  low, high = np.array(arena.room.low), np.array(arena.room.high)
  margin = np.asarray(margin)
  reach = margin[..., np.newaxis]
  inside = ((points >= low - reach) & (points <= high + reach)).all(-1)
  if isinstance(arena, arenas.TwoRooms):
    # The small room and the doorway to it, north of the large room.
    north = arena.extent.high[1]
    half = (north - high[1]) / 2
    is_north = (points[..., 1] > high[1]) & (points[..., 1] <= north + margin)
    inside |= is_north & (np.abs(points[..., 0]) <= half + margin)
  return ~inside


@final
class Bulldozers:
  """Scripted pushers, one in each world of a batch."""

  def __init__(
      self, env: batch_environment.BatchEnvironment, seed: int
  ) -> None:
    self._env = env
    self._rng = np.random.default_rng(seed)
    self.registers = [
        r for r in env.mechanism.registers.values() if r.channel != 'welded'
    ]
    self.blocks = [b for r in self.registers for b in r.blocks]
    self.geoms = [block.geom for block in self.blocks]
    self.half_sizes = np.array([block.half_size for block in self.blocks])
    self._everyone = np.arange(env.num_envs)
    self._new_errands()

  def _new_errands(self) -> None:
    """Gives every pusher another goal."""
    number, rng = self._env.num_envs, self._rng
    arena = self._env.task.root_entity
    self._mode = rng.integers(0, 4, number)
    self._block = rng.integers(0, len(self.blocks), number)
    low, high = np.array(arena.room.low), np.array(arena.room.high)
    goals = rng.uniform(low - 1.0, high + 1.0, (number, 2))
    # Half of them go to a corner, or through the doorway.
    corners = np.where(rng.random((number, 2)) < 0.5, low - 1.0, high + 1.0)
    goals = np.where(rng.random((number, 1)) < 0.4, corners, goals)
    doorway = np.array([0.0, arena.extent.high[1]])
    self._goal = np.where(rng.random((number, 1)) < 0.2, doorway, goals)
    # Every other carrier builds a tower.
    self._tower = np.where(
        rng.random(number) < 0.5, rng.integers(0, len(self.blocks), number), -1
    )

  def act(self, step: int) -> np.ndarray:
    """Returns the actions of all pushers, `(worlds, 6)`."""
    late = step % _STEPS_PER_ERRAND
    if late == 0:
      self._new_errands()
    avatar, physics = self._env.task.avatar, self._env.physics
    here = avatar.position(physics)
    places = np.array(physics.bind(self.geoms).xpos)[..., :2]
    block = places[self._everyone, self._block]
    tower = places[self._everyone, self._tower]
    goal = np.where((self._tower >= 0)[:, np.newaxis], tower, self._goal)
    goal = np.where((self._mode == _CARRY)[:, np.newaxis], goal, self._goal)
    is_held = avatar.holding(physics)[:, 0] > 0
    # Behind the block, as seen from the goal; from there, through it.
    along = _unit(self._goal - block)
    offset = block - here
    ahead = (offset * along).sum(-1)
    aside = np.abs(offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0])
    runs = (ahead > 0.1) & (aside < 0.15)
    push = np.where(
        runs[:, np.newaxis], along, _unit(block - _BEHIND * along - here)
    )
    carry = np.where(
        is_held[:, np.newaxis], _unit(goal - here), _unit(block - here)
    )
    carries = (self._mode == _CARRY) | (self._mode == _THROW)
    wish = np.where(carries[:, np.newaxis], carry, push)
    ram = _unit(self._goal - here)
    wish = np.where((self._mode == _RAM)[:, np.newaxis], ram, wish)
    heading = avatar.direction(physics)
    left = np.stack([-heading[:, 1], heading[:, 0]], -1)
    forward, strafe = (wish * heading).sum(-1), (wish * left).sum(-1)
    # At full force in any direction.
    full = np.maximum(np.abs(forward), np.abs(strafe)).clip(1e-9)
    actions = np.zeros((len(here), 6))
    actions[:, 0], actions[:, 1] = forward / full, strafe / full
    actions[:, 2] = np.clip(4.0 * np.arctan2(strafe, forward), -1.0, 1.0)
    actions[:, 4] = np.where(carries & ~is_held, 1.0, 0.0)
    if late == _STEPS_PER_ERRAND - 1:
      actions[:, 4] = np.where(self._mode == _CARRY, -1.0, 0.0)
      actions[:, 5] = np.where(self._mode == _THROW, 1.0, 0.0)
    return np.clip(actions, -1.0, 1.0)


def _unit(vectors: np.ndarray) -> np.ndarray:
  return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-9)


def bulldoze(
    domain: str,
    steps: int,
    seed: int,
    *,
    num_pushers: int = PUSHERS,
    design: dict[str, Any] = DESIGN,
    timestep: float = block_kinds.SHORT_SUBSTEP,
    is_written: bool = False,
    planted_speed: float = 0.0,
) -> Result:
  """Runs pushers, and counts blocks after each control step.

  Args:
    domain: Domain of the world.
    steps: Number of control steps of each pusher.
    seed: Seed of the world and of the pushers.
    num_pushers: Number of pushers.
    design: Design with the registers.
    timestep: Duration of a substep of the physics, in s.
    is_written: True if registers are written in each control step.
    planted_speed: Speed of all blocks in m/s, for a control.
  """
  env = suite.load_batch(
      domain, 'standard', {'random': seed, 'physics_timestep': timestep},
      {'max_steps': None}, num_envs=num_pushers, design=design,
  )  # fmt: skip
  env.reset()
  physics, task = env.physics, env.task
  n = round(task.control_timestep / task.physics_timestep)
  pushers = Bulldozers(env, seed)
  slides = [j for b in pushers.blocks for j in b._slides]
  rng = np.random.default_rng(seed)
  total = Result(num_steps=num_pushers * steps)
  if planted_speed:
    physics.bind(slides).qvel = np.full(len(slides), planted_speed)
  for step in range(steps):
    task.before_step(physics, pushers.act(step), None)
    physics.advance(2 * n // 3)
    task.latch_events(physics)
    if is_written:
      for register in pushers.registers:
        spec = register.value_spec
        values = rng.uniform(spec.minimum, spec.maximum, num_pushers)
        register.write(physics, values)
    physics.advance(n - 2 * n // 3)
    task.after_step(physics, None)
    physics.refresh()
    total = total.plus(_look(env, pushers, slides, step))
    if physics.has_diverged().any():
      # An episode of the environment would end here, as invalid.
      env.reset()
  env.close()
  return total


def _look(
    env: batch_environment.BatchEnvironment,
    pushers: Bulldozers,
    slides: list[Any],
    step: int,
) -> Result:
  """Counts misplaced blocks, and what happens to the others."""
  physics, arena = env.physics, env.task.root_entity
  flagged = physics.has_diverged()
  places = np.array(physics.bind(pushers.geoms).xpos)
  speeds = np.abs(np.array(physics.bind(slides).qvel))
  # Every part of the state is finite.
  good = np.isfinite(physics.state).all(-1)
  not_finite = ~good & ~flagged
  places, speeds = np.nan_to_num(places), np.nan_to_num(speeds)
  sound = (good & ~flagged)[:, np.newaxis]
  outside = is_outside(arena, places[..., :2]) & sound
  under = (places[..., 2] < 0.0) & sound
  touching = is_outside(arena, places[..., :2], -pushers.half_sizes - 0.01)
  words = tuple(
      f'step {step} world {world} {pushers.geoms[block].full_identifier}'
      f' at {np.round(places[world, block], 3).tolist()}'
      for world, block in np.argwhere(outside | under)[:2]
  )
  north = arena.room.high[1]
  return Result(
      0,
      int(outside.sum()),
      int(under.sum()),
      int(not_finite.sum()),
      int(flagged.sum()),
      int((speeds > 0.1).sum()),
      int(touching.sum()),
      int((places[..., 2] > pushers.half_sizes + 0.05).sum()),
      int(env.task.avatar.holding(physics).sum()),
      int((places[..., 1] > north).sum()),
      words[:2],
  )


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  rounds = max(2, int(ROUNDS * scale))
  steps = STEPS if scale >= 0.2 else max(1, int(STEPS * scale * 5))
  total = Result()
  for i in range(rounds):
    # Two domains, each with and without writes.
    domain = ('unlock_door', 'collect_apples')[i % 2]
    for design, timestep in (
        (USUAL_DESIGN, block_kinds.LONG_SUBSTEP),
        (DESIGN, block_kinds.SHORT_SUBSTEP),
    ):
      found = bulldoze(
          domain,
          max(1, steps // 2),
          seed + i,
          design=design,
          timestep=timestep,
          is_written=i % 4 >= 2,
      )
      total = total.plus(found)
      for words in found.worst[:4]:
        print(f'# {domain} seed {seed + i}: {words}', flush=True)
  report = figure_lines.Lines('C30', seed)
  report.at_least(
      'control steps', total.num_steps, rounds * (steps // 2) * 2 * PUSHERS
  )
  for reached in ('moving', 'at_walls', 'lifted', 'held', 'through'):
    report.at_least(
        f'reached: {reached}', getattr(total, f'num_{reached}'), rounds
    )
  report.at_most('blocks outside, not flagged', total.num_outside, 0)
  report.at_most('blocks under the floor, not flagged', total.num_under, 0)
  report.at_most('NaN, not flagged', total.num_not_finite, 0)
  report.at_most('worlds flagged as diverged', total.num_flagged, 0)
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
