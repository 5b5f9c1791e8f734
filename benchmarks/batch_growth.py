"""Growth of costs with the numbers of worlds and registers, and memory.

Part of `python -m benchmarks.batch`.
"""

import functools
import os
import pathlib
import subprocess
import sys
from typing import Any

import numpy as np

from benchmarks import timing
from benchmarks import worlds
from realab_suite import suite

# Numbers of steps by numbers of worlds.
_SIZES = {1: 64, 16: 16, 64: 8, 256: 4, 1024: 4}
_REGISTERS = (1, 2, 4)
_REGISTER_STEPS = 4
_MEMORY_WORLDS = 1024
_MEMORY_TARGET_MIB = 1.0


def grow_worlds(rounds: int) -> list[timing.Figure]:
  """Measures how throughput grows with the number of worlds."""
  playing = {}
  for number, num_steps in _SIZES.items():
    env = worlds.load(number)
    playing[number] = (env, worlds.draw(env, num_steps))
  seconds = timing.time_rounds(
      {str(n): functools.partial(worlds.play, *p) for n, p in playing.items()},
      rounds,
  )
  for env, _ in playing.values():
    env.close()
  return [
      timing.Figure(
          f'steps of {number} worlds',
          number / seconds[str(number)] / 1e3,
          '/ms',
      )
      for number in _SIZES
  ]


def _design(dof: str, number: int) -> dict[str, Any]:
  """Returns a design with registers that are written in each step."""
  names = [f'register_{i}' for i in range(1, number + 1)]
  return {
      'schema': 1,
      'name': f'{dof}_{number}',
      'dof': dof,
      'registers': {
          name: {
              'kind': 'two_block',
              'role': 'meter',
              'place': f'station_{i}',
              'range': [0, 20],
              'scale': 0.1,
          }
          for i, name in enumerate(names, start=1)
      },
      'meters': [{'measures': 'score', 'writes': name} for name in names],
  }


def grow_registers(rounds: int) -> list[timing.Figure]:
  """Measures the cost of registers, which may grow linearly."""
  playing = {}
  for dof in ('free', 'planar'):
    for number in _REGISTERS:
      env = worlds.load(worlds.NUM_ENVS, _design(dof, number), dof)
      playing[f'{number} {dof}'] = (env, worlds.draw(env, _REGISTER_STEPS))
  seconds = timing.time_rounds(
      {name: functools.partial(worlds.play, *p) for name, p in playing.items()},
      rounds,
  )
  for env, _ in playing.values():
    env.close()
  us = {name: 1e6 * taken / worlds.NUM_ENVS for name, taken in seconds.items()}
  figures = [
      timing.Figure(f'step, registers: {name}', taken, 'us')
      for name, taken in us.items()
  ]
  most, half = _REGISTERS[-1], _REGISTERS[-2]
  for dof in ('free', 'planar'):
    growth = us[f'{most} {dof}'] / us[f'{half} {dof}']
    figures.append(
        timing.Figure(
            f'{most} registers to {half}, {dof}', growth, 'x', most / half
        )
    )
  return figures


def _resident_mib() -> float:
  """Returns the resident memory of this process on Linux, in MiB."""
  pages = int(pathlib.Path('/proc/self/statm').read_text().split()[1])
  return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


def print_memory(num_envs: int, sleep: bool) -> None:
  """Prints the memory without a batch, with one world and with `num_envs`."""
  single = suite.load(
      'unlock_door', 'standard', {'random': worlds.SEED},
      design='instantaneous_reward',
  )  # fmt: skip
  before = _resident_mib()
  single.close()
  readings = [before]
  for number in (1, num_envs):
    env = worlds.load(number, sleep=sleep)
    env.reset()
    env.step(worlds.draw(env, 1)[0])
    readings.append(_resident_mib())
  print(*readings)


def measure_memory() -> list[timing.Figure]:
  """Measures the memory of worlds in separate processes."""
  figures = []
  for sleep in (False, True):
    code = (
        'from benchmarks import batch_growth;'
        f' batch_growth.print_memory({_MEMORY_WORLDS}, {sleep})'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    before, one, many = map(float, done.stdout.split())
    figures.append(
        timing.Figure(
            'memory where blocks sleep'
            if sleep
            else f'memory of one of {_MEMORY_WORLDS} worlds',
            np.array([(many - one) / _MEMORY_WORLDS]),
            'MiB',
            _MEMORY_TARGET_MIB,
        )
    )
  return [
      *figures,
      timing.Figure(
          'memory of model and threads', np.array([one - before]), 'MiB'
      ),
  ]
