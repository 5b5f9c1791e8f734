"""Campaign: blocks that are written in every step can be carried and thrown.

Run from the root of the repository, about a minute on one processor:

    python -m campaigns.carrying_campaign

A scripted avatar grasps the block that a provider writes in every control step,
and holds it for 20 steps: standing, walking away and sideways at full speed,
and turning. Then it stops and lets go. It does so with two-block and position
registers, free and planar blocks, both schedules, writes along the axis and of
the pose. A second script throws the block. Figures: temporary corruption in
each step, its difference from the displacement of the block since its last
write, the distance of block and hand, the block's greatest speed relative to
the hand, and what the avatar feels of it. Arguments: a scale for the number of
seeds, and a seed.
"""

import itertools
from typing import Any, Literal, NamedTuple, final
from unittest import mock

import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers

SEEDS = 5
STEPS = 20
KINDS = ('two_block', 'block_position')
SCHEDULES = (None, 'cfmdp')
MOTIONS: dict[str, dict[str, float]] = {
    'stand': {},
    'walk': {'forward': -1.0},
    'strafe': {'strafe': 0.6},
    'turn': {'turn': 1.0},
}
SPEED_LIMIT = 2.0  # Of the block relative to the hand, in m/s.
_VALUE = 8.0
_REST_STEPS = 20  # A free block falls and rocks before it rests.


@providers.PROVIDERS.add('steady')
@final
class Steady(providers.Provider):
  """Writes the same value in every control step."""

  kind: Literal['steady'] = 'steady'
  value: float = _VALUE

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> Any:
    return {self.writes[0]: np.full(np.shape(episode_start), self.value)}, state


class Figures(NamedTuple):
  """Figures of an episode.

  Attributes:
    num_held: Steps in which the hand held the block after the step.
    least: Least temporary corruption of a step, in units.
    most: Greatest temporary corruption of a step, in units.
    error: Greatest difference of temporary corruption from the displacement of
      the block since its last write, in units.
    distance: Greatest distance of block and hand, in m.
    speed: Greatest speed of the block relative to the hand, in m/s.
    slowed: Greatest loss of the avatar's speed because of the block, in m/s.
    left: Temporary corruption in the first step after letting go, in units.
    rest: Temporary corruption at the end, in units.
  """

  num_held: int
  least: float
  most: float
  error: float
  distance: float
  speed: float
  slowed: float
  left: float
  rest: float


@final
class Carrier:
  """A world with one register, and an avatar that holds its block."""

  def __init__(
      self, kind: str, dof: str, write: str, schedule: str | None, seed: int
  ) -> None:
    # The avatar stands clear of where the block is written.
    position = np.array([-1.0, -1.0]) + 0.1 * np.random.default_rng(
        seed
    ).uniform(-1, 1, 2)
    design = {
        'schema': 1,
        'name': 'carried',
        'dof': dof,
        'schedule': schedule,
        'registers': {
            'reward': {
                'kind': kind,
                'role': 'feedback',
                'range': [0, 12],
                'place': position.tolist(),
                'write': write,
            }
        },
        'providers': [{'kind': 'steady', 'writes': ['reward']}],
    }
    self.env: environment.Environment = suite.load(
        'collect_apples', 'far', {'random': seed}, design=design
    )
    self.ledger = ledgers.Ledger()
    self.env.add_sink(self.ledger)
    self.register = self.env.mechanism.registers['reward']
    self.block: Any = self.register.blocks[-1]
    self.fastest = 0.0
    self._elements = self.env.action_spec().name.split('\t')
    self.env.reset()

  def act(self, **commands: float) -> registers.Read:
    """Runs a control step and returns what the agent read."""
    action = np.zeros(len(self._elements))
    for name, value in commands.items():
      action[self._elements.index(name)] = value
    physics = self.env.thin_physics
    advance = physics.advance

    def watch(num_substeps: int) -> None:
      for _ in range(num_substeps):
        advance(1)
        relative = physics.bind(self.block._slides).qvel[:2] - self.hand()[1]
        self.fastest = max(self.fastest, float(np.linalg.norm(relative)))

    with mock.patch.object(physics, 'advance', watch):
      self.env.step(action)
    reads = self.ledger.last.entries['reward']
    return [read for read in reads if isinstance(read, registers.Read)][-1]

  def hand(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns position and velocity of the hand, each `(2,)`."""
    avatar, physics = self.env.task.avatar, self.env.thin_physics
    return (
        avatar._hand_position(physics), avatar._hand_velocity(physics)[:2]
    )  # fmt: skip

  def grasp(self) -> None:
    """Places the avatar behind the block, and grasps it."""
    self.act()
    physics = self.env.thin_physics
    x, y, _ = physics.bind(self.block.geom).xpos
    self.env.task.avatar.place(physics, (x - 0.75, y), 0.0)
    self.act(grasp=1.0)


def carry(carrier: Carrier, motion: dict[str, float]) -> Figures:
  """Carries the block with a motion, stops, and lets go."""
  avatar, physics = carrier.env.task.avatar, carrier.env.thin_physics
  carrier.grasp()
  held, temporary, errors, distances, speeds = 0, [], [], [], []
  carrier.fastest = 0.0
  written: list[float] = []
  write = carrier.register.write

  def note(*args: Any, **kwargs: Any) -> Any:
    result = write(*args, **kwargs)
    written.append(float(carrier.block.along(physics)))
    return result

  with mock.patch.object(carrier.register, 'write', note):
    for _ in range(STEPS):
      read = carrier.act(**motion)
      held += int(avatar.holding(physics)[0])
      moved = float(carrier.block.along(physics)) - written[-1]
      temporary.append(abs(float(read.temporary)))
      errors.append(abs(read.temporary - moved / carrier.register.scale))
      place = physics.bind(carrier.block.geom).xpos[:2]
      distances.append(float(np.linalg.norm(place - carrier.hand()[0])))
      speeds.append(float(np.linalg.norm(avatar.velocity(physics)[:2])))
  fastest = carrier.fastest
  for _ in range(_REST_STEPS):
    carrier.act()
  left = float(carrier.act(grasp=-1.0).temporary)
  for _ in range(_REST_STEPS):
    rest = float(carrier.act().temporary)
  wanted = 2.0 * np.linalg.norm(
      [motion.get('forward', 0.0), motion.get('strafe', 0.0)]
  )
  return Figures(
      held, min(temporary), max(temporary), max(errors), max(distances),
      fastest, float(max(0.0, wanted - min(speeds[3:8]))), abs(left), abs(rest),
  )  # fmt: skip


def throw(carrier: Carrier) -> tuple[int, float, float]:
  """Throws the block.

  Returns:
    Steps with temporary corruption of more than 0.05 units, the greatest one,
    and the one at the end.
  """
  carrier.grasp()
  for _ in range(3):
    carrier.act()
  sizes = [abs(float(carrier.act(throw=1.0).temporary))]
  sizes += [abs(float(carrier.act().temporary)) for _ in range(3 * STEPS)]
  return int(np.sum(np.array(sizes) > 0.05)), max(sizes), sizes[-1]


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  report = figure_lines.Lines('carrying', seed)
  seeds = range(seed, seed + max(1, int(SEEDS * scale)))
  for dof, schedule, write in itertools.product(
      registers.DOFS, SCHEDULES, registers.WRITES
  ):
    for name, motion in MOTIONS.items():
      found = [
          carry(Carrier(kind, dof, write, schedule, number), motion)
          for kind, number in itertools.product(KINDS, seeds)
      ]
      worst = Figures(
          *(
              min(values) if label in ('num_held', 'least') else max(values)
              for label, values in zip(
                  Figures._fields, zip(*found, strict=True), strict=True
              )
          )
      )
      label = f'{dof} {schedule} {write} {name}'
      print(f'# {label}: {worst}', flush=True)
      report.at_most(f'{label}: error (units)', worst.error, 1e-9)
      if write == 'axis':
        report.at_least(f'{label}: steps held', worst.num_held, STEPS)
        report.at_least(f'{label}: least corruption', worst.least, 1e-6)
        report.at_most(f'{label}: speed (m/s)', worst.speed, SPEED_LIMIT)
        report.at_most(f'{label}: at the end (units)', worst.rest, 1e-2)
      else:
        report.at_most(f'{label}: steps held', worst.num_held, 0)
    thrown = [
        throw(Carrier('two_block', dof, write, schedule, n)) for n in seeds
    ]
    print(f'# {dof} {schedule} {write} throw: {thrown}', flush=True)
    if write == 'axis':
      report.at_least(f'{dof} {schedule} thrown: steps', min(thrown)[0], 2)
      report.at_most(
          f'{dof} {schedule} thrown: at the end',
          max(t[2] for t in thrown),
          1e-3,
      )
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
