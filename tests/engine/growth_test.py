"""Neither memory nor anything else grows with steps and resets."""

import atexit
from collections.abc import Callable
from concurrent import futures
import gc
import multiprocessing
import os
import pathlib
from typing import Any

import numpy as np
import pytest

from realab_suite import suite
from tests import examples
from tests.engine import helpers

pytestmark = pytest.mark.slow

_NUM_ENVS = 4
_NUM_LOOKS = 12
_NUM_ACTIONS = 1_000
_MEBIBYTE = 2**20


def _held() -> tuple[int, int, int]:
  """Returns the numbers of open files, threads and callbacks at exit."""
  return (
      len(os.listdir('/proc/self/fd')),
      len(os.listdir('/proc/self/task')),
      atexit._ncallbacks(),
  )


def _resident_bytes() -> int:
  gc.collect()
  pages = pathlib.Path('/proc/self/statm').read_text(encoding='ascii').split()
  return int(pages[1]) * os.sysconf('SC_PAGE_SIZE')


def _growth(act: Callable[[], Any], number: int) -> tuple[float, list[int]]:
  """Returns the growth while an operation is repeated, after warming up.

  The memory is in MiB per 1,000 repetitions; the numbers are of what `_held`
  counts.
  """
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
  more = [b - a for a, b in zip(before, _held(), strict=True)]
  return float(slope * 1_000 / _MEBIBYTE), more


def _steps_of_a_batch(number: int) -> Any:
  batch = suite.load_batch(
      'unlock_door', 'standard', {'random': 0}, num_envs=_NUM_ENVS,
      design='instantaneous_reward',
  )  # fmt: skip
  rng = np.random.default_rng(0)
  actions = helpers.draw(batch.action_spec(), (_NUM_ACTIONS, _NUM_ENVS), rng)
  numbers = iter(range(2 * number))
  return _growth(
      lambda: batch.step(actions[next(numbers) % _NUM_ACTIONS]), number
  )


def _resets_of_a_world(number: int) -> Any:
  env = suite.load(
      'unlock_door', 'standard', {'random': 0}, design='instantaneous_reward'
  )
  return _growth(env.reset, number)


@pytest.mark.parametrize('measure', [_steps_of_a_batch, _resets_of_a_world])
def test_memory_files_threads_and_callbacks_do_not_grow(
    measure: Callable[[int], Any],
):
  number = examples.settings(500).max_examples
  # Where no other test has left anything.
  context = multiprocessing.get_context('spawn')
  with futures.ProcessPoolExecutor(1, context) as pool:
    memory, held = pool.submit(measure, number).result()
  # Less than half a kilobyte at a time, the resolution of a short run.
  assert memory < 0.5
  assert max(held) <= 0
