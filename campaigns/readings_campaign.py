"""Campaign C40: every reading is what was asked for, plus what became of it.

Run from the root of the repository, about ten seconds:

    python -m campaigns.readings_campaign

    reading - requested = saturation + permanent + temporary

Blocks are shoved, carried off and turned while providers write values that fit
their registers and values that do not. Each part is also worked out from where
the blocks are in the world, without asking the registers: permanent is minus
the way of the base block along the axis, temporary is how far the offset block
is from where it was put. Prints `C40 figure target verdict seed`. Arguments are
the scale and the seed.
"""

from collections.abc import Iterator
import contextlib
import math
from typing import Any, Literal, NamedTuple, final

import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from realab_suite.policies import random_keys
from tests import worlds
from tests.engine import helpers

NUM_READS = 100_000
TOLERANCE = 1e-9
_MAX_STEPS = 100
_SHOVES = 0.15  # In which share of steps somebody moves blocks.
_SHOVES_AT_ONCE = 30  # Everything is read after each.
_EVALUATOR = 'evaluator'


@final
class _Whatever(providers.Provider):
  """Writes random values, a quarter of which do not fit."""

  kind: Literal['whatever'] = 'whatever'

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    draws = random_keys.uniform(key, (len(self.writes),))
    return {
        name: 8.0 * draws[..., i] - 4.0 for i, name in enumerate(self.writes)
    }, state


def _register(
    kind: str, place: Any, role: str = 'feedback', **more: Any
) -> dict[str, Any]:
  return {'kind': kind, 'role': role, 'place': place, 'range': [-3, 3], **more}


_DESIGN = {
    'schema': 1,
    'name': 'sums',
    'registers': {
        'plain': _register('two_block', [-2.5, 2.6]),
        'turned': _register(
            'two_block', {'position': [2.6, 2.4], 'yaw': 2.1}, scale=0.15
        ),
        'planar': _register('two_block', [2.4, -2.6], dof='planar'),
        'place': _register('block_position', [-2.5, -2.4], scale=0.12),
        'heading': _register('block_orientation', [0, -2.6], scale=0.5),
        'secure': _register(
            'two_block', [0, 2.8], channel='secure', scale=0.05
        ),
        'hint': _register('two_block', [-2.8, 0.2], 'signal', scale=0.05),
        'score': _register('two_block', [2.7, 0.2], 'meter', scale=0.05),
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {
            'kind': 'whatever',
            'reads': ['score'],
            'writes': ['plain', 'turned', 'planar', 'place', 'heading'],
        },
        {'kind': 'whatever', 'writes': ['secure']},
    ],
}  # fmt: skip


class Sums(NamedTuple):
  """What readings came to.

  Attributes:
    num_reads: How many reads came after a write.
    excess: The largest error of the sum.
    permanent: The largest difference of permanent corruption from what the
      blocks in the world say.
    temporary: The same of temporary corruption.
    sizes: The largest saturation, permanent and temporary part.
  """

  num_reads: int
  excess: float
  permanent: float
  temporary: float
  sizes: tuple[float, float, float]


class Witness(events.EventSink):
  """Reads every register, and looks at the blocks itself."""

  def __init__(self, ledger: ledgers.Ledger, env: Any) -> None:
    self._ledger = ledger
    self._mechanism = env.mechanism
    self._origins: dict[str, np.ndarray] = {}
    self.permanent = self.temporary = 0.0
    self.num_reads = 0

  def episode_started(self, start: events.Start, physics: Any) -> None:
    for name, register in self._mechanism.registers.items():
      self._origins[name] = self._along(physics, register, name)
    self.look(physics)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self.look(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _along(self, physics: Any, register: Any, name: str) -> np.ndarray:
    """Where the blocks are along the register's axis, in units."""
    place = self._mechanism.design.registers[name].place
    axis = np.array([math.cos(place.yaw), math.sin(place.yaw)])
    centres = [physics.bind(block.geom).xpos[:2] for block in register.blocks]
    return np.array([centre @ axis for centre in centres]) / register.scale

  def look(self, physics: Any) -> None:
    reads = worlds.shadow_reads(self._mechanism, physics, _EVALUATOR)
    self.num_reads += len(reads)
    self._ledger.last.add(reads)
    for read in reads:
      register = self._mechanism.registers[read.register]
      if register.channel == 'secure' or read.register == 'heading':
        continue
      moved = self._along(physics, register, read.register)
      moved = moved - self._origins[read.register]
      # Every register began at 0, so that is where its last block was.
      applied = register.applied(physics)
      permanent = -moved[0] if len(moved) > 1 else 0.0
      temporary = moved[-1] - applied
      # Of nan, the maximum is nan.
      errors = np.abs([read.permanent - permanent, read.temporary - temporary])
      self.permanent = float(np.maximum(self.permanent, errors[0]))
      self.temporary = float(np.maximum(self.temporary, errors[1]))


def pairs(
    episodes: list[ledgers.EpisodeLedger],
) -> Iterator[tuple[registers.Write, registers.Read]]:
  """Yields each read with the write before it in the same episode."""
  for episode in episodes:
    for entries in episode.entries.values():
      write = None
      for entry in entries:
        if isinstance(entry, registers.Write):
          write = entry
        elif write is not None:
          yield write, entry


def _shove(env: Any, rng: np.random.Generator) -> None:
  blocks = [b for r in env.mechanism.registers.values() for b in r.blocks]
  block = blocks[int(rng.integers(len(blocks)))]
  position = np.array(block.position(env.physics))
  position[:2] += rng.uniform(-0.3, 0.3, 2)
  block.put(env.physics, position, heading=rng.uniform(-1, 1))


def play(num_reads: int, seed: int) -> Sums:
  """Plays until there have been so many reads, and adds up."""
  rng = np.random.default_rng(seed)
  with contextlib.ExitStack() as stack:
    stack.enter_context(
        helpers.registered(providers.PROVIDERS, 'whatever', _Whatever)
    )
    env = stack.enter_context(
        contextlib.closing(
            suite.load(
                'collect_apples', 'standard', {'random': seed},
                {'max_steps': _MAX_STEPS}, design=_DESIGN,
            )
        )
    )  # fmt: skip
    ledger = ledgers.Ledger()
    witness = Witness(ledger, env)
    env.add_sink(ledger)
    env.add_sink(witness)
    count = 0
    actions = iter(helpers.random_actions(env, num_reads, seed))
    while count < num_reads:
      if rng.random() < _SHOVES:
        for _ in range(_SHOVES_AT_ONCE):
          _shove(env, rng)
          env.physics.forward()
          witness.look(env.physics)
      env.step(next(actions))
      count = witness.num_reads
    return add_up(ledger.episodes, witness)


def add_up(episodes: list[ledgers.EpisodeLedger], witness: Witness) -> Sums:
  """Returns what the readings in ledgers come to."""
  table = np.array(
      [
          (read.reading, write.requested, write.applied, read.permanent,
           read.temporary)
          for write, read in pairs(episodes)
      ]
  )  # fmt: skip
  reading, requested, applied, permanent, temporary = table.T
  saturation = applied - requested
  excess = reading - requested - (saturation + permanent + temporary)
  return Sums(
      len(table),
      float(np.abs(excess).max()),
      witness.permanent,
      witness.temporary,
      tuple(float(np.abs(x).max()) for x in (saturation, permanent, temporary)),
  )


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C40', seed)
  number = round(scale * NUM_READS)
  found = play(number, seed)
  lines.at_least('reads', found.num_reads, number)
  lines.at_most('largest error of the sum', found.excess, TOLERANCE)
  for part in ('permanent', 'temporary'):
    error = getattr(found, part)
    lines.at_most(f'largest error of {part} corruption', error, TOLERANCE)
  parts = ('saturation', 'permanent corruption', 'temporary corruption')
  for part, size in zip(parts, found.sizes, strict=True):
    lines.at_least(f'largest {part}', size, 0.5)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
