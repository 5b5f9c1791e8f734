"""Arguments of worlds are numbers, or are refused in one line that says so."""

import re
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.tasks import collect_apples
from realab_suite.tasks import registry

_WORLD = 'collect_apples', 'standard'
_DESIGN = 'instantaneous_reward'
_TASK = collect_apples.CollectApples()


class _Mute:
  """Has nothing that a message could show."""

  def __repr__(self) -> str:
    raise RuntimeError


_NO_INTEGERS = [True, float('nan'), 'a\nb', [1], _Mute(), -1, 10**5000]
_NO_COUNTS = [*_NO_INTEGERS, 0]


def _embed(**kwargs: Any) -> Any:
  return suite.embed(_TASK, 'none', **kwargs)


def _load_batch(**kwargs: Any) -> Any:
  return suite.load_batch(*_WORLD, **{'num_envs': 2, **kwargs})


# By argument: a call, the beginning of its message, and values that are wrong.
_LOADED: dict[str, tuple[Any, str, list[Any]]] = {
    'max_steps': (
        lambda v: suite.load(*_WORLD, None, {'max_steps': v}),
        'max_steps: ', _NO_COUNTS,
    ),
    'world': (
        lambda v: suite.load(*_WORLD, None, {'world': v}), 'world: ', [-1],
    ),
    'random': (
        lambda v: suite.load(*_WORLD, {'random': v}), 'random: ',
        [-1, 1.5, True, 'x'],
    ),
    'camera_size': (
        lambda v: suite.load(*_WORLD, {'camera_size': v}), '',
        [3, 'ab', (64,), (0, 64), (1.5, 64)],
    ),
    'task_kwargs': (
        lambda v: suite.load(*_WORLD, v), 'task_kwargs',
        [3, {1: 2}, {'colour': 1}],
    ),
    'environment_kwargs': (
        lambda v: suite.load(*_WORLD, None, v), 'environment_kwargs: ',
        [3, {1: 2}, {'x': 1, 'design': 2}],
    ),
    'environment_kwargs of a batch': (
        lambda v: _load_batch(environment_kwargs=v), 'environment_kwargs: ',
        [{'world': 1}],
    ),
    'visualize_reward': (
        lambda v: suite.load(*_WORLD, None, None, v), 'visualize_reward=',
        [None, 1],
    ),
    'domain_name': (lambda v: suite.load(v, 'standard'), 'task ', [None, 3]),
    'task_name': (
        lambda v: suite.load('collect_apples', v), 'task collect_apples',
        [None, _Mute()],
    ),
    'design': (lambda v: suite.load(*_WORLD, design=v), 'design', [True, -1]),
    'num_envs': (
        lambda v: _load_batch(num_envs=v), 'num_envs: ',
        [*_NO_COUNTS, None, 2**16 + 1],
    ),
    'num_threads': (
        lambda v: _load_batch(num_threads=v), 'num_threads: ', [None, 2**31],
    ),
    'sleep': (lambda v: _load_batch(sleep=v), 'sleep: ', [1, None]),
    'task of embed': (
        lambda v: suite.embed(v, 'none'), 'task: ', [None, type(_TASK)],
    ),
    'max_steps of embed': (
        lambda v: _embed(max_steps=v), 'max_steps: ', [True, 0],
    ),
    'measurements': (
        lambda v: _embed(measurements=v), 'measurements: ',
        [3, {1: lambda physics: 0.0}, {'clock': 3}],
    ),
}  # fmt: skip


def _refuse(call: Any, name: str, *args: Any) -> None:
  with pytest.raises(errors.SpecError) as caught:
    call(*args)
  text = str(caught.value)
  assert text.startswith(name)
  assert re.search('must be|must have|known are|contains all', text)
  assert '\n' not in text
  assert len(text) < 1000


@pytest.mark.parametrize(
    ('call', 'name', 'values'), _LOADED.values(), ids=_LOADED
)
def test_a_wrong_argument_is_refused_before_a_world_is_made(
    call: Any, name: str, values: Any, monkeypatch: pytest.MonkeyPatch
):
  def make(*args: Any, **kwargs: Any) -> None:
    raise AssertionError('a world was made')

  monkeypatch.setattr(environment.Environment, '__init__', make)
  for value in values:
    _refuse(call, name, value)


def test_numbers_of_numpy_and_large_ones_are_numbers():
  largest = 2**63 - 1
  options = {'max_steps': np.int64(largest), 'world': largest}
  env = suite.load(*_WORLD, {'random': np.int64(3)}, options, design=_DESIGN)
  assert type(env.max_steps) is type(env.world) is int
  assert env.reset().observation['senses/time_left'] == 1.0
  batch = _load_batch(num_envs=np.int64(2), sleep=np.False_)
  assert type(batch.num_envs) is int


def test_a_task_that_fails_to_be_made_is_an_argument_that_is_wrong(monkeypatch):
  def make(**kwargs: Any) -> None:
    raise ZeroDivisionError('no room\nat all')

  tasks = {('broken', 'task'): (make, frozenset())}
  monkeypatch.setattr(registry, '_TASKS', tasks)
  with pytest.raises(errors.SpecError) as caught:
    suite.load('broken', 'task', {'size': 3})
  assert str(caught.value) == (
      'task_kwargs of broken.task: ZeroDivisionError: no room at all'
  )
