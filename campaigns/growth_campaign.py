"""Campaign C34: neither memory nor anything else grows with steps and resets.

Run from the root of the repository, a quarter of an hour on two processors:

    python -m campaigns.growth_campaign

Prints `C34 figure target verdict seed`. An argument scales the lengths of runs.
Open files, threads, GL contexts and callbacks at exit are counted after warming
up and in the end, and no process may take more than a few GiB of addresses.
Frames are drawn where there is EGL, in runs that are a hundredth as long.
"""

import atexit
from collections.abc import Callable
from concurrent import futures
import gc
import multiprocessing
import os
import pathlib
import resource
from typing import Any, NamedTuple

from absl import logging
from dm_control._render import base as render_base
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import jumping_ball
import numpy as np

from campaigns import figure_lines
from campaigns import processes_campaign
from realab_suite import suite
from realab_suite.evaluation import ledgers
from tests.engine import helpers

NUM_ENVS = 4
POINTS = 12
_PROCESSES = 2
_TARGET = 1.0  # MiB per 1e5 steps and per 1,000 resets.
_MEBIBYTE = 2**20
_SPARE_ADDRESSES = 4 * 2**30  # Bytes, beyond what there is at first.
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
    world: `single`, `batch`, `camera` or `foreign`.
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
    Case('single', 'step', 1_000_000, 100_000),
    Case('batch', 'step', 250_000, 100_000),
    Case('single', 'reset', 6_000, 1_000),
    Case('batch', 'reset', 3_000, 1_000),
    Case('foreign', 'step', 20_000, 100_000),
    Case('foreign', 'reset', 500, 1_000, is_judged=False),
    # A ledger keeps every step: what it takes is for information.
    Case('single', 'step', 5_000, 100_000, has_ledger=True, is_judged=False),
    Case('batch', 'step', 2_000, 100_000, has_ledger=True, is_judged=False),
]


# Growth of memory is not judged: it is that of the renderer.
CAMERA_CASES = [
    Case('camera', 'step', 1_000, 100_000, is_judged=False),
    Case('camera', 'reset', 300, 1_000, is_judged=False),
]


class Held(NamedTuple):
  """What a process holds besides memory."""

  files: int
  threads: int
  contexts: int
  callbacks: int


def held() -> Held:
  """Counts what this process holds."""
  gc.collect()
  return Held(
      len(os.listdir('/proc/self/fd')),
      len(os.listdir('/proc/self/task')),
      sum(isinstance(o, render_base.ContextBase) for o in gc.get_objects()),
      atexit._ncallbacks(),
  )


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
  camera = {'camera_size': (32, 32)} if case.world == 'camera' else {}
  arguments = 'unlock_door', 'standard', {'random': seed, **camera}
  if case.world in ('single', 'camera'):
    return suite.load(*arguments, design=design)
  return suite.load_batch(*arguments, num_envs=NUM_ENVS, design=design)


def measure(case: Case) -> float:
  """Returns the growth of a case in this process, MiB."""
  return measure_all(case)[0]


def measure_all(case: Case) -> tuple[float, Held]:
  """Returns the growth of a case in this process, and of what it holds."""
  env = load(case)
  if case.has_ledger:
    env.add_sink(
        ledgers.BatchLedger() if case.world == 'batch' else ledgers.Ledger()
    )
  act = env.reset if case.what == 'reset' else _stepper(env, case)
  limit_addresses()
  for _ in range(max(2, case.number // 10)):
    act()
  before = held()
  grown = growth(act, case.number, case.per)
  more = Held(*(b - a for a, b in zip(before, held(), strict=True)))
  env.close()
  return grown, more


def limit_addresses() -> None:
  """Lets this process die, rather than the machine, if it takes too much."""
  pages = pathlib.Path('/proc/self/statm').read_text(encoding='ascii').split()
  limit = int(pages[0]) * os.sysconf('SC_PAGE_SIZE') + _SPARE_ADDRESSES
  _, hard = resource.getrlimit(resource.RLIMIT_AS)
  resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _stepper(env: Any, case: Case) -> Callable[[], Any]:
  """Returns what takes a random step."""
  shape = (NUM_ENVS,) if case.world == 'batch' else ()
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
  missed = _measure_and_report(CASES, scale)
  if 'egl' in processes_campaign.renderers():
    # Those that are started from here on render; nothing here does.
    os.environ['MUJOCO_GL'] = 'egl'
    missed += _measure_and_report(CAMERA_CASES, scale)
  else:
    print('# frames: not measured, there is no EGL')
  return missed


def _measure_and_report(cases: list[Case], scale: float) -> int:
  cases = [case._replace(number=int(case.number * scale)) for case in cases]
  missed = 0
  # Each in a process of its own, with a heap of its own.
  with futures.ProcessPoolExecutor(
      _PROCESSES,
      multiprocessing.get_context('spawn'),
      max_tasks_per_child=1,
  ) as pool:
    for case, (grown, more) in zip(
        cases, pool.map(measure_all, cases), strict=True
    ):
      met = grown <= _TARGET
      missed += case.is_judged and not met
      target, verdict = '-', '-'
      if case.is_judged:
        target, verdict = f'<={_TARGET:g}', 'met' if met else 'MISSED'
      print(f'C34 {case.name}={grown:.3f} {target} {verdict} 0', flush=True)
      for what, number in more._asdict().items():
        verdict = 'met' if number <= 0 else 'MISSED'
        missed += number > 0
        print(
            f'C34 {case.name}: more {what}={number} <=0 {verdict} 0', flush=True
        )
  return missed


if __name__ == '__main__':
  figure_lines.run(main)
