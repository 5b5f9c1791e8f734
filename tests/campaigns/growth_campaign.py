"""Campaign C34: memory does not grow with steps and resets.

Run from the root of the repository, about five minutes on two processors:

    python -m tests.campaigns.growth_campaign

Prints `C34 figure target verdict seed`. An argument scales the lengths of runs.
"""

from collections.abc import Callable
from concurrent import futures
import gc
import multiprocessing
import os
import pathlib
import sys
from typing import Any, NamedTuple

from absl import logging
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import jumping_ball
import numpy as np

from realab_suite import suite
from realab_suite.evaluation import ledger as ledgers
from tests.engine import helpers

NUM_WORLDS = 4
POINTS = 12
_PROCESSES = 2
_TARGET = 1.0  # MiB per 1e5 steps and per 1,000 resets.
_MEBIBYTE = 2**20
_PERIOD = 1_000  # Actions before the same ones come again.
_FOREIGN_DESIGN = {
    'schema': 1,
    'name': 'growth',
    'registers': {
        'reward': {
            'kind': 'two_block',
            'role': 'feedback',
            'place': [2, 2],
            'range': [-2, 12],
        },
        'score': {
            'kind': 'two_block',
            'role': 'meter',
            'place': [2, -3],
            'range': [0, 20],
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
}


class Case(NamedTuple):
  """What is done over and over.

  Attributes:
    world: `single`, `batch` or `foreign`.
    what: `step` or `reset`.
    number: How often it is done; a batch's worlds do it all at once.
    per: For how many of them growth is reported.
    has_ledger: Whether a ledger listens.
    is_judged: Whether there is a target.
  """

  world: str
  what: str
  number: int
  per: int
  has_ledger: bool = False
  is_judged: bool = True

  @property
  def name(self) -> str:
    """What is measured, in words."""
    unit = f'{self.per} {self.what}s'
    ledger = ' with a ledger' if self.has_ledger else ''
    return f'{self.world}{ledger}, MiB per {unit}'


CASES = [
    Case('single', 'step', 100_000, 100_000),
    Case('batch', 'step', 30_000, 100_000),
    Case('single', 'reset', 6_000, 1_000),
    Case('batch', 'reset', 3_000, 1_000),
    Case('foreign', 'step', 20_000, 100_000),
    Case('foreign', 'reset', 500, 1_000, is_judged=False),
    # A ledger keeps every step: what it takes is for information.
    Case('single', 'step', 5_000, 100_000, has_ledger=True, is_judged=False),
    Case('batch', 'step', 2_000, 100_000, has_ledger=True, is_judged=False),
]


def resident_bytes() -> int:
  """Returns how much memory this process has in use, garbage aside."""
  gc.collect()
  pages = pathlib.Path('/proc/self/statm').read_text(encoding='ascii').split()
  return int(pages[1]) * os.sysconf('SC_PAGE_SIZE')


def growth(
    act: Callable[[], Any], number: int, per: int, points: int = POINTS
) -> float:
  """Returns by how many MiB memory grows.

  The first quarter is for warming up: allocators and caches fill. The slope is
  that of the line through all points after it, with nothing subtracted.

  Args:
    act: What is done over and over.
    number: How often, after warming up.
    per: For how many of them growth is returned.
    points: How often to look.
  """
  for _ in range(number // 4):
    act()
  chunk = max(1, number // (points - 1))
  sizes = [resident_bytes()]
  for _ in range(points - 1):
    for _ in range(chunk):
      act()
    sizes.append(resident_bytes())
  times = chunk * np.arange(points)
  slope = np.polyfit(times, sizes, 1)[0]
  return float(slope * per / _MEBIBYTE)


def load(case: Case, seed: int = 0) -> Any:
  """Returns the environment of a case."""
  design = 'instantaneous_reward'
  if case.world == 'foreign':
    # In each episode dm_control warns that the ball's velocity is not set.
    logging.set_verbosity(logging.ERROR)
    walker = jumping_ball.JumpingBallWithHead()
    task = go_to_target.GoToTarget(walker, floors.Floor(size=(5, 5)))
    # Each episode compiles the model anew, which is measured by itself.
    return suite.embed(task, _FOREIGN_DESIGN, random=seed, max_steps=None)
  arguments = 'unlock_door', 'standard', {'random': seed}
  if case.world == 'single':
    return suite.load(*arguments, design=design)
  return suite.load_batch(*arguments, num_envs=NUM_WORLDS, design=design)


def measure(case: Case) -> float:
  """Returns the growth of a case in this process, MiB."""
  env = load(case)
  if case.has_ledger:
    env.add_sink(
        ledgers.BatchLedger() if case.world == 'batch' else ledgers.Ledger()
    )
  act = env.reset if case.what == 'reset' else _stepper(env, case)
  grown = growth(act, case.number, case.per)
  env.close()
  return grown


def _stepper(env: Any, case: Case) -> Callable[[], Any]:
  """Returns what takes a random step."""
  shape = (NUM_WORLDS,) if case.world == 'batch' else ()
  size = int(np.prod(shape, dtype=int))
  draws = np.array(helpers.random_actions(env, _PERIOD * size))
  actions = draws.reshape(_PERIOD, *shape, *env.action_spec().shape)
  count = 0

  def act() -> None:
    nonlocal count
    env.step(actions[count % _PERIOD])
    count += 1

  return act


def main(scale: float = 1.0) -> int:
  """Prints figures and returns the number of targets missed."""
  cases = [case._replace(number=int(case.number * scale)) for case in CASES]
  missed = 0
  # Each in a process of its own, with a heap of its own.
  with futures.ProcessPoolExecutor(
      _PROCESSES,
      multiprocessing.get_context('spawn'),
      max_tasks_per_child=1,
  ) as pool:
    for case, grown in zip(cases, pool.map(measure, cases), strict=True):
      met = grown <= _TARGET
      missed += case.is_judged and not met
      target, verdict = '-', '-'
      if case.is_judged:
        target, verdict = f'<={_TARGET:g}', 'met' if met else 'MISSED'
      print(f'C34 {case.name}={grown:.3f} {target} {verdict} 0', flush=True)
  return missed


if __name__ == '__main__':
  sys.exit(main(*map(float, sys.argv[1:])))
