"""Campaign C04: worlds saved at random steps go on bit for bit.

Run from the root of the repository, about five minutes:

    python -m tests.campaigns.snapshot_campaign

Prints `C04 figure target verdict seed`. An argument is the number of points.
"""

import itertools
import sys
from typing import Any, NamedTuple

import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import snapshot as snapshots
from realab_suite.evaluation import ledger as ledgers
from tests import worlds
from tests.engine import helpers

POINTS = 500
STEPS = 200
_MAX_STEPS = 90  # So that most runs go through the end of an episode.
_LATEST_POINT = 120
_STEPS_AFTER_PUSH = 3
_PUSH = 4.0  # Metres or radians per second.


class Case(NamedTuple):
  """A world and its feedback."""

  domain: str
  design: str
  overrides: tuple[str, ...]
  seed: int

  def load(self, seed: int | None = None) -> environment.Environment:
    """Returns a new environment of this kind, with a ledger."""
    env = suite.load(
        self.domain,
        'standard',
        {'random': self.seed if seed is None else seed},
        {'max_steps': _MAX_STEPS},
        design=self.design,
        overrides=self.overrides,
    )
    env.add_sink(ledgers.Ledger())
    return env


CASES = [
    Case(domain, design, overrides, 0)
    for domain, design, overrides in itertools.product(
        ('unlock_door', 'collect_apples'),
        ('instantaneous_reward', 'online_imitation', 'value_advice'),
        ((), ('dof=planar',), ('channel=secure',)),
    )
]


def ledger_of(env: environment.Environment) -> ledgers.Ledger:
  """Returns the ledger that `Case.load` added."""
  (ledger,) = env._sinks
  return ledger


def play(env: environment.Environment, steps: int, seed: int) -> list[bytes]:
  """Acts at random; returns all that is seen and all that there is, by step.

  The last entry is the episode in the ledger.
  """
  transcript = []
  for action in helpers.random_actions(env, steps, seed):
    if action.ndim:
      action[0] = abs(action[0])  # Who walks forwards meets more things.
    seen = helpers.to_bytes(env.step(action))
    transcript.append(seen + worlds.state_bytes(env.physics))
  transcript.append(repr(ledger_of(env).last).encode())
  return transcript


def saved(case: Case, point: int) -> tuple[Any, snapshots.Snapshot]:
  """Returns an environment after some steps, and a snapshot of it.

  Shortly before, everything gets a push, so that registers are corrupted.
  """
  env = case.load()
  env.reset()
  play(env, max(0, point - _STEPS_AFTER_PUSH), seed=1)
  velocities = env.physics.data.qvel
  rng = np.random.default_rng(point)
  velocities += rng.normal(scale=_PUSH, size=velocities.shape)
  play(env, min(point, _STEPS_AFTER_PUSH), seed=1)
  return env, env.save()


def num_differences(case: Case, point: int, steps: int) -> int:
  """Returns in how many of two environments a snapshot goes on differently.

  Bytes that change on their way through a file count as a third one.
  """
  env, snapshot = saved(case, point)
  data = snapshot.to_bytes()
  expected = play(env, steps, seed=2)
  copy = snapshots.Snapshot.from_bytes(data)
  differences = int(copy.to_bytes() != data)
  env.restore(copy)
  differences += play(env, steps, seed=2) != expected
  env.close()
  other = case.load(seed=case.seed + 1)
  other.reset()
  play(other, 3, seed=3)
  other.restore(copy)
  differences += other.save().to_bytes() != data
  differences += play(other, steps, seed=2) != expected
  other.close()
  return differences


def main(points: int = POINTS, seed: int = 0) -> int:
  """Prints the figure and returns the number of targets missed."""
  rng = np.random.default_rng(seed)
  differing = 0
  for i in range(points):
    case = CASES[i % len(CASES)]._replace(seed=int(rng.integers(2**31)))
    point = int(rng.integers(_LATEST_POINT))
    differing += num_differences(case, point, STEPS) > 0
  verdict = 'MISSED' if differing else 'met'
  print(f'C04 differing of {points}={differing} 0 {verdict} {seed}')
  return int(differing > 0)


if __name__ == '__main__':
  sys.exit(main(*map(int, sys.argv[1:])))
