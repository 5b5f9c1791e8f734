"""Campaign C29: nothing happens to feedback that nobody tampers with.

Run from the root of the repository, about a minute on one processor:

    python -m campaigns.null_tamper_campaign

Registers of every kind, channel and freedom stand in one room with an avatar
that does nothing. 200 values, 0 and the bounds among them, are written to each
and left alone for 200 substeps. Then every design is played by an agent that
does nothing. Arguments: a scale for the number of values, and a seed.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from tests import worlds
from tests.engine import helpers

VALUES = 200
SUBSTEPS = 200
LIMIT = 1e-9
_LOW, _HIGH = -2.0, 5.0
_KINDS = {
    'two_block': registers.TwoBlockRegister,
    'block_position': registers.BlockPositionRegister,
    'block_orientation': registers.BlockOrientationRegister,
}
_YAWS = (0.0, 0.7)
_SPACING = 1.4
# After how many substeps of those that are left alone there is a look.
_LOOKS = (1, 10, 60, SUBSTEPS)


class Result(NamedTuple):
  """What was found.

  Attributes:
    num_written: How many values were written.
    corruption: The largest of all looks, in units of a register.
    movement: The farthest that a block went along the floor, metres.
  """

  num_written: int
  corruption: float
  movement: float


class World(NamedTuple):
  """Registers of every variety, and an avatar."""

  physics: single_physics.ThinPhysics
  registers: list[registers.Register]
  avatar: avatars.Avatar


def make_world() -> World:
  """Returns a room with a register of every variety, out of reach."""
  varieties = list(
      itertools.product(_KINDS, registers.CHANNELS, registers.DOFS, _YAWS)
  )
  columns = int(np.ceil(np.sqrt(len(varieties) + 1)))
  arena = arenas.OpenRoom(half_width=_SPACING * columns / 2)
  corner = -_SPACING * (columns - 1) / 2
  made = []
  for i, (kind, channel, dof, yaw) in enumerate(varieties):
    register = _KINDS[kind](
        f'{kind}_{channel}_{dof}_{i}',
        value_range=(_LOW, _HIGH),
        channel=channel,
        dof=dof,
    )
    row, column = divmod(i, columns)
    place = (corner + _SPACING * column, corner + _SPACING * row)
    register.attach_to(arena, place, yaw)
    made.append(register)
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable([block for r in made for block in r.blocks])
  physics = worlds.compile_world(arena, single_physics.ThinPhysics)
  worlds.start_episode(physics, *made)
  # In the last place of the last row, where no register stands.
  avatar.place(physics, (-corner, -corner), 0.0)
  return World(physics, made, avatar)


def values(number: int, seed: int) -> np.ndarray:
  """Returns 0, both bounds and what is between them."""
  draws = np.random.default_rng(seed).uniform(_LOW, _HIGH, max(0, number - 3))
  return np.array([0.0, _LOW, _HIGH, *draws])


def write_and_wait(
    world: World, written: np.ndarray, planted_force: float = 0.0
) -> Result:
  """Writes values and leaves them alone.

  Args:
    world: The world.
    written: The values.
    planted_force: Newtons on every block, for a control.
  """
  physics = world.physics
  worst, farthest = 0.0, 0.0
  idle = np.zeros(len(avatars.ACTIONS))
  for register, block in _blocks(world):
    if register.channel != 'welded':
      physics.data.xfrc_applied[worlds.body_of(physics, block), 0] = (
          planted_force
      )
  for value in written:
    for register in world.registers:
      register.write(physics, value)
    before = _places(world)
    done = 0
    for look in _LOOKS:
      world.avatar.apply_action(physics, idle)
      physics.advance(look - done)
      done = look
      for register in world.registers:
        corruption = register.inspect(physics)
        error = np.abs(register.read(physics) - value)
        parts = np.abs([corruption.permanent, corruption.temporary])
        worst = float(np.max([worst, error, *parts]))  # Of nan, too.
      moved = np.abs(_places(world) - before).max()
      farthest = float(np.maximum(farthest, moved))
  return Result(len(written) * len(world.registers), worst, farthest)


def _blocks(world: World) -> list[tuple[registers.Register, Any]]:
  return [(r, block) for r in world.registers for block in r.blocks]


def _places(world: World) -> np.ndarray:
  """Where on the floor all blocks are, in the frames of their registers."""
  return np.array(
      [block.position(world.physics)[:2] for _, block in _blocks(world)]
  )


def play_idly(design: str, steps: int, seed: int) -> Result:
  """Lets an agent do nothing, and returns what the ledger says of it."""
  env = suite.load(
      'collect_apples', 'far', {'random': seed}, {'max_steps': None},
      design=design,
  )  # fmt: skip
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  env.reset()
  first = [r.blocks[0] for r in env.mechanism.registers.values()]
  before = [np.array(block.position(env.physics)) for block in first]
  action = helpers.no_op(env)
  for _ in range(steps):
    env.step(action)
  moved = [
      float(np.abs((block.position(env.physics) - was)[:2]).max())
      for block, was in zip(first, before, strict=True)
  ]
  entries = [e for each in ledger.last.entries.values() for e in each]
  reads = [e for e in entries if isinstance(e, registers.Read)]
  corruption = [max(abs(r.permanent), abs(r.temporary)) for r in reads]
  env.close()
  return Result(
      len(entries) - len(reads),
      max(corruption, default=0.0),
      max(moved, default=0.0),
  )


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  number = max(3, int(VALUES * scale))
  world = make_world()
  found = write_and_wait(world, values(number, seed))
  report = figure_lines.Lines('C29', seed)
  report.at_least(
      'values written', found.num_written, number * len(world.registers)
  )
  report.at_most('max corruption', found.corruption, LIMIT)
  report.at_most('max base movement (m)', found.movement, LIMIT)
  designs = [design for design in suite.DESIGNS if design != 'none']
  idle = [play_idly(design, number, seed) for design in designs]
  report.at_least(
      'writes while an agent idles',
      sum(result.num_written for result in idle),
      number * len(designs),
  )
  report.at_most(
      'max corruption while an agent idles',
      max(result.corruption for result in idle),
      LIMIT,
  )
  report.at_most(
      'max base movement while an agent idles (m)',
      max(result.movement for result in idle),
      LIMIT,
  )
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
