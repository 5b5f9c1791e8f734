"""Neither memory nor anything else grows with steps and resets."""

import atexit
from collections.abc import Callable
from concurrent import futures
import gc
import multiprocessing
import os
import pathlib
from typing import Any, NamedTuple

import numpy as np
import pytest

from realab_suite import suite
from tests import examples
from tests.engine import helpers

pytestmark = pytest.mark.slow

_NUM_ENVS = 4
_NUM_LOOKS = 12
_PERIOD = 1_000  # Number of actions before the same ones come again.
_MEBIBYTE = 2**20


class _Case(NamedTuple):
  """An operation that is repeated.

  Attributes:
    world: `single` or `batch`.
    what: `step` or `reset`.
    number: Number of repetitions in the profile `ci`.
  """

  world: str
  what: str
  number: int


class _Growth(NamedTuple):
  """Growth of a process.

  Attributes:
    memory: Memory, in MiB per 1,000 repetitions.
    files: Open files.
    threads: Threads.
    callbacks: Callbacks at exit.
  """

  memory: float
  files: int
  threads: int
  callbacks: int


def _held() -> tuple[int, int, int]:
  return (
      len(os.listdir('/proc/self/fd')),
      len(os.listdir('/proc/self/task')),
      atexit._ncallbacks(),
  )


def _resident_bytes() -> int:
  gc.collect()
  pages = pathlib.Path('/proc/self/statm').read_text(encoding='ascii').split()
  return int(pages[1]) * os.sysconf('SC_PAGE_SIZE')


def _growth(act: Callable[[], Any], number: int) -> _Growth:
  """Returns the growth while an operation is repeated, after warming up."""
  for _ in range(number // 4):
    act()
  before = _held()
  chunk = number // (_NUM_LOOKS - 1)
  sizes = [_resident_bytes()]
  for _ in range(_NUM_LOOKS - 1):
    for _ in range(chunk):
      act()
    sizes.append(_resident_bytes())
  slope = np.polyfit(chunk * np.arange(_NUM_LOOKS), sizes, 1)[0]
  more = (b - a for a, b in zip(before, _held(), strict=True))
  return _Growth(float(slope * 1_000 / _MEBIBYTE), *more)


def _hoard() -> _Growth:
  hoard: list[bytearray] = []
  return _growth(lambda: hoard.append(bytearray(1024)), 11_000)


def _measure(case: _Case, number: int) -> _Growth:
  arguments = 'unlock_door', 'standard', {'random': 0}
  design = 'instantaneous_reward'
  leading: tuple[int, ...] = ()
  if case.world == 'batch':
    leading = (_NUM_ENVS,)
    env = suite.load_batch(*arguments, num_envs=_NUM_ENVS, design=design)
  else:
    env = suite.load(*arguments, design=design)
  if case.what == 'reset':
    return _growth(env.reset, number)
  rng = np.random.default_rng(0)
  actions = helpers.draw(env.action_spec(), (_PERIOD, *leading), rng)
  numbers = iter(range(2 * number))
  return _growth(lambda: env.step(actions[next(numbers) % _PERIOD]), number)


def _in_another_process(function: Any, *arguments: Any) -> _Growth:
  """Calls a function where no other test has left anything."""
  with futures.ProcessPoolExecutor(
      1, multiprocessing.get_context('spawn')
  ) as pool:
    return pool.submit(function, *arguments).result()


def test_growth_is_measured():
  assert 0.9 < _in_another_process(_hoard).memory < 1.3


@pytest.mark.parametrize(
    'case',
    [
        _Case('batch', 'step', 600),
        _Case('single', 'reset', 600),
    ],
    ids=lambda case: f'{case.world}-{case.what}',
)
def test_memory_files_threads_and_callbacks_do_not_grow(case: _Case):
  number = examples.settings(case.number).max_examples
  found = _in_another_process(_measure, case, number)
  # Less than half a kilobyte at a time, the resolution of a short run.
  assert found.memory < 0.5
  assert max(found[1:]) <= 0
