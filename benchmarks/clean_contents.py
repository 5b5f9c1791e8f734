"""Benchmark of clean contents: what they add to a control step.

`python -m benchmarks.clean_contents` runs the same control steps of Unlock Door
with clean contents and without them, in turns. In honest episodes nothing is
disturbed. In tampering ones, the first block of each register stands 0.4 m from
its place, so that every provider is called once more; these calls are reported
by themselves and left out of the ratio. Times are those of the processor, with
one thread.
"""

from collections.abc import Iterator, Sequence
import contextlib
import functools
import time
from typing import Any
from unittest import mock

import numpy as np

from benchmarks import timing
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.entities import axes
from realab_suite.entities.registers import base
from realab_suite.feedback import clean_contents

_SEED = 0
_STEPS = 100
_ROUNDS = 15
_NUM_ENVS = 256
_DISTANCE = 0.4
_HONEST, _TAMPERING = 1.05, 1.15
# The designs, by their names in the figures.
_DESIGNS = {'reward': 'instantaneous_reward', 'advice': 'value_advice'}

_Worlds = environment.Environment | batch_environment.BatchEnvironment


def _load(design: str, num_envs: int) -> Any:
  arguments: dict[str, Any] = {
      'design': design,
      'overrides': (
          'dof=planar', 'action_set={name: dmlab_like, version: 1}'
      ),
  }  # fmt: skip
  world = ('unlock_door', 'near', {'random': _SEED}, {'max_steps': 10**6})
  if num_envs:
    return suite.load_batch(
        *world, num_envs=num_envs, num_threads=1, **arguments
    )
  return suite.load(*world, **arguments)


def _disturb(env: _Worlds) -> None:
  """Moves the first block of each register along its axis."""
  for register in env.mechanism.registers.values():
    physics = env.physics
    position = np.array(register.blocks[0].position(physics))
    position[..., 0] -= _DISTANCE
    register.blocks[0].put(physics, position)


@contextlib.contextmanager
def _without() -> Iterator[None]:
  """Returns a context in which there are no clean contents."""

  def sight(*unused: Any) -> Any:
    return {}

  def clean(register: base.Register, physics: Any) -> Any:
    return register._slots.of(physics).applied[()]

  def store(
      register: base.Register,
      physics: Any,
      applied: Any,
      obstruction: Any,
      where: Any = None,
  ) -> None:
    slots = register._slots.of(physics)
    slots.applied[...] = axes.merge(where, applied, slots.applied)
    slots.obstruction[...] = axes.merge(where, obstruction, slots.obstruction)
    if register.channel == 'secure':
      slots.stored[...] = axes.merge(where, applied, slots.stored)

  calls = clean_contents.CleanCalls
  with contextlib.ExitStack() as stack:
    for owner, name, new in (
        (calls, 'see', sight),
        (calls, 'repeat', lambda *unused: None),
        (base.Register, 'clean', clean),
        (base.Register, '_store', store),
    ):
      stack.enter_context(mock.patch.object(owner, name, new))
    yield


def _run(
    env: _Worlds, actions: np.ndarray, is_tampering: bool, calls: list[float]
) -> float:
  """Runs an episode and returns its seconds without clean calls.

  Args:
    env: One world or a batch.
    actions: Action of each control step.
    is_tampering: True to disturb the registers first.
    calls: Gets the seconds of the clean calls.
  """
  env.reset()
  if is_tampering:
    _disturb(env)
  spent = 0.0
  real = clean_contents._call

  def timed(*arguments: Any) -> Any:
    nonlocal spent
    began = time.process_time()
    found = real(*arguments)
    spent += time.process_time() - began
    return found

  with mock.patch.object(clean_contents, '_call', timed):
    began = time.process_time()
    for action in actions:
      env.step(action)
    seconds = time.process_time() - began
  calls.append(spent)
  return seconds - spent


def _run_without(
    env: _Worlds, actions: np.ndarray, is_tampering: bool
) -> float:
  with _without():
    return _run(env, actions, is_tampering, [])


def _actions(env: _Worlds, num_envs: int) -> np.ndarray:
  """Returns no-ops: blocks stay where they are."""
  spec = env.action_spec()
  shape = (_STEPS, *((num_envs,) if num_envs else ()), *spec.shape)
  return np.zeros(shape, spec.dtype)


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  figures = []
  for name, design in _DESIGNS.items():
    for num_envs in (0, _NUM_ENVS):
      with contextlib.closing(_load(design, num_envs)) as env:
        actions = _actions(env, num_envs)
        for kind, target in (('honest', _HONEST), ('tampering', _TAMPERING)):
          calls: list[float] = []
          is_tampering = kind == 'tampering'
          seconds = timing.time_rounds(
              {
                  'with': functools.partial(
                      _run, env, actions, is_tampering, calls
                  ),
                  'without': functools.partial(
                      _run_without, env, actions, is_tampering
                  ),
              },
              rounds,
          )
          where = f'{name}, {num_envs or "one"}, {kind}'
          scale = 1e6 / _STEPS / max(num_envs, 1)
          figures += [
              timing.Figure(
                  f'step, {where}', scale * seconds['with'], 'us', target,
                  True, seconds['with'] / seconds['without'],
              ),
              timing.Figure(
                  f'calls, {where}', scale * np.array(calls[1:]),
                  'us',
              ),
          ]  # fmt: skip
  timing.report(figures)


if __name__ == '__main__':
  main()
