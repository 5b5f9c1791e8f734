"""Campaign C02: the same seed and actions give the same bytes, others do not.

Run from the root of the repository, about two minutes on two processors:

    python -m campaigns.determinism_campaign

Every task is played twice for 1,000 steps from each of three seeds; what the
agent gets is compared byte for byte, and so are its worlds. Arguments: a scale
for the number of steps, and the first seed.
"""

from collections.abc import Sequence
from concurrent import futures
import itertools
import multiprocessing
from typing import NamedTuple

from campaigns import figure_lines
from realab_suite import suite
from tests import worlds
from tests.engine import helpers

SEEDS = 3
STEPS = 1_000
_PROCESSES = 2
_MAX_STEPS = 150  # So that a run goes through the ends of several episodes.


class Case(NamedTuple):
  """A task, its feedback and a seed."""

  domain: str
  task: str
  design: str
  seed: int


class Result(NamedTuple):
  """What was found in a case.

  Attributes:
    num_steps: How many time steps were compared.
    num_episodes: How many episodes began in them.
    num_different_bytes: How many bytes differ between two runs alike.
    num_alike: How much of the beginning another seed has in common: what the
      agent gets, and the world.
  """

  num_steps: int
  num_episodes: int
  num_different_bytes: int
  num_alike: int


def cases(seeds: Sequence[int]) -> list[Case]:
  """Returns every task with every seed; the designs take turns."""
  tasks = itertools.product(suite.ALL_TASKS, seeds)
  return [
      Case(domain, task, suite.DESIGNS[i % len(suite.DESIGNS)], seed)
      for i, ((domain, task), seed) in enumerate(tasks)
  ]


def play(
    case: Case, steps: int, planted_step: int | None = None
) -> list[tuple[bytes, bytes]]:
  """Returns what the agent gets in each step, and the state of the world.

  Args:
    case: The case.
    steps: How many steps.
    planted_step: When something that nobody asked for happens, for a control.
  """
  env = suite.load(
      case.domain,
      case.task,
      {'random': case.seed},
      {'max_steps': _MAX_STEPS},
      design=case.design,
  )
  # The actions are those of the first seed: the seed is all that differs.
  transcript = []
  for i, action in enumerate(helpers.random_actions(env, steps)):
    time_step = env.step(action)
    if i == planted_step:
      env.physics.data.qvel[0] += 1e-12
    transcript.append(
        (helpers.to_bytes(time_step), worlds.state_bytes(env.physics))
    )
  env.close()
  return transcript


def num_different(
    one: Sequence[tuple[bytes, bytes]], other: Sequence[tuple[bytes, bytes]]
) -> int:
  """Counts the bytes that differ."""
  total = 0
  for here, there in zip(one, other, strict=True):
    for a, b in zip(here, there, strict=True):
      if a != b:
        total += abs(len(a) - len(b))
        total += sum(x != y for x, y in zip(a, b, strict=False))
  return total


def check(case: Case, steps: int) -> Result:
  """Plays a case twice, and once with another seed."""
  first, second = play(case, steps), play(case, steps)
  # Another seed begins elsewhere; nothing is learnt from going on.
  other = play(case._replace(seed=case.seed + 1_000), 1)
  firsts = sum(here.startswith(b'(0, ') for here, _ in first)
  alike = sum(a == b for a, b in zip(first[0], other[0], strict=True))
  return Result(len(first), firsts, num_different(first, second), alike)


def _check(arguments: tuple[Case, int]) -> Result:
  return check(*arguments)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  steps = max(2, int(STEPS * scale))
  todo = cases(range(seed, seed + SEEDS))
  with futures.ProcessPoolExecutor(
      _PROCESSES, multiprocessing.get_context('spawn')
  ) as pool:
    results = list(pool.map(_check, [(case, steps) for case in todo]))
  report = figure_lines.Lines('C02', seed)
  report.at_least('runs', len(results), len(suite.ALL_TASKS) * SEEDS)
  report.at_least(
      'time steps compared',
      sum(result.num_steps for result in results),
      len(todo) * steps,
  )
  report.at_least(
      'episodes', sum(result.num_episodes for result in results), len(todo)
  )
  report.at_most(
      'mismatching bytes', sum(r.num_different_bytes for r in results), 0
  )
  report.at_most(
      'seeds that failed to differ', sum(r.num_alike > 0 for r in results), 0
  )
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
