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


class _Mute:
  """Has nothing that a message could show."""

  def __repr__(self) -> str:
    raise RuntimeError

  def __bool__(self) -> bool:
    raise RuntimeError


_NO_NUMBERS = {
    'true': True, 'numpy true': np.True_, 'float': 3.0, 'nan': float('nan'),
    'infinity': float('inf'), 'numpy float': np.float64(3), 'text': 'x',
    'bytes': b'x', 'list': [1], 'array': np.array([1, 2]),
    'scalar array': np.array(3), 'mapping': {'a': 1}, 'class': int,
    'mute': _Mute(), 'long text': 'y' * 5000, 'lines': 'a\nb',
}  # fmt: skip
_TOO_SMALL = {'-1': -1, 'numpy -1': np.int8(-1), 'huge, below': -(10**5000)}
_TOO_LARGE = {'2**63': 2**63, '10**400': 10**400, '10**5000': 10**5000}
_NO_INTEGERS = _NO_NUMBERS | _TOO_SMALL | _TOO_LARGE


@pytest.fixture(scope='module', name='env')
def fixture_env():
  env = suite.load(*_WORLD, {'random': 1}, design=_DESIGN)
  env.reset()
  return env


@pytest.fixture(scope='module', name='batch')
def fixture_batch():
  batch = suite.load_batch(*_WORLD, {'random': 1}, num_envs=2, design=_DESIGN)
  batch.reset()
  return batch


_TASK = collect_apples.CollectApples()


def _embed(**kwargs: Any) -> Any:
  return suite.embed(_TASK, 'none', **kwargs)


def _load_batch(**kwargs: Any) -> Any:
  return suite.load_batch(*_WORLD, **{'num_envs': 2, **kwargs})


_NO_INTEGERS_OR_NONE = _NO_INTEGERS | {'none': None}
_NO_COUNTS = _NO_INTEGERS | {'0': 0}
_NO_SEEDS = _NO_NUMBERS | _TOO_SMALL
_NO_TEXTS = {k: v for k, v in _NO_INTEGERS.items() if not isinstance(v, str)}
_NO_THREADS = _NO_INTEGERS_OR_NONE | {'2**31': 2**31}
# Of calls that make a task first; `embed` is given all the others.
_FEW = {
    k: _NO_INTEGERS[k]
    for k in ('true', 'nan', 'mapping', 'mute', '-1', '10**5000')
}
_NO_BATCHES = _NO_INTEGERS_OR_NONE | {'0': 0, '2**40': 2**40}

# By argument: a call, the beginning of its message, and values that are wrong.
_LOADED = {
    'max_steps': (
        lambda v: suite.load(*_WORLD, None, {'max_steps': v}),
        'max_steps: ', _FEW,
    ),
    'world': (
        lambda v: suite.load(*_WORLD, None, {'world': v}), 'world: ', _FEW,
    ),
    'random': (
        lambda v: suite.load(*_WORLD, {'random': v}), 'random: ',
        {k: v for k, v in _FEW.items() if k in _NO_SEEDS},
    ),
    'camera_size': (
        lambda v: suite.load(*_WORLD, {'camera_size': v}), '',
        _NO_INTEGERS | {
            'one': (64,), 'zero': (0, 64), 'below': (-1, 64),
            'float': (1.5, 64), 'text': 'ab',
        },
    ),
    'task_kwargs': (
        lambda v: suite.load(*_WORLD, v), 'task_kwargs',
        _NO_INTEGERS | {'keys': {1: 2}, 'self': {'self': 1},
                        'unknown': {'colour': 1}, 'given': {'variation': 'x'}},
    ),
    'environment_kwargs': (
        lambda v: suite.load(*_WORLD, None, v), 'environment_kwargs: ',
        _NO_INTEGERS | {'keys': {1: 2}, 'others': {'x': 1, 'design': 2}},
    ),
    'environment_kwargs of a batch': (
        lambda v: suite.load_batch(*_WORLD, None, v, num_envs=2),
        'environment_kwargs: ',
        _NO_INTEGERS | {'keys': {1: 2}, 'world': {'world': 1}},
    ),
    'visualize_reward': (
        lambda v: suite.load(*_WORLD, None, None, v), 'visualize_reward=',
        _NO_INTEGERS_OR_NONE | {'0': 0, '1': 1},
    ),
    'domain_name': (
        lambda v: suite.load(v, 'standard'), 'task ', _NO_INTEGERS_OR_NONE,
    ),
    'task_name': (
        lambda v: suite.load('collect_apples', v),
        'task collect_apples', _NO_INTEGERS_OR_NONE,
    ),
    'design': (lambda v: suite.load(*_WORLD, design=v), 'design', _FEW),
    'design of embed': (lambda v: suite.embed(_TASK, v), 'design', _NO_TEXTS),
    'num_envs': (
        lambda v: _load_batch(num_envs=v), 'num_envs: ',
        _NO_BATCHES | {'2**16 + 1': 2**16 + 1},
    ),
    'num_threads': (
        lambda v: _load_batch(num_threads=v), 'num_threads: ', _NO_THREADS,
    ),
    'sleep': (
        lambda v: _load_batch(sleep=v), 'sleep: ',
        {k: v for k, v in _NO_INTEGERS.items() if 'true' not in k}
        | {'1': 1, 'none': None},
    ),
    'task of embed': (
        lambda v: suite.embed(v, 'none'), 'task: ',
        _NO_INTEGERS_OR_NONE | {'its class': type(_TASK)},
    ),
    'max_steps of embed': (
        lambda v: _embed(max_steps=v), 'max_steps: ', _NO_COUNTS,
    ),
    'world of embed': (
        lambda v: _embed(world=v), 'world: ', _NO_INTEGERS_OR_NONE,
    ),
    'random of embed': (lambda v: _embed(random=v), 'random: ', _NO_SEEDS),
    'measurements': (
        lambda v: _embed(measurements=v), 'measurements: ',
        _NO_INTEGERS | {'keys': {1: lambda physics: 0.0}},
    ),
    'a measurement': (
        lambda v: _embed(measurements={'clock': v}), "measurements: 'clock': ",
        {k: v for k, v in _NO_INTEGERS.items() if k != 'class'},
    ),
}  # fmt: skip
_FORKED = {
    'num_envs': (
        lambda env, batch, v: suite.fork(env, v), 'num_envs: ', _NO_BATCHES,
    ),
    'num_threads': (
        lambda env, batch, v: suite.fork(env, 2, num_threads=v),
        'num_threads: ', _NO_THREADS,
    ),
    'env': (
        lambda env, batch, v: suite.fork(v, 2), 'env: ', _NO_INTEGERS_OR_NONE,
    ),
    'world': (
        lambda env, batch, v: suite.fork(env, 2, world=v),
        'world: ', _NO_COUNTS,
    ),
    'world of a batch': (
        lambda env, batch, v: suite.fork(batch, 2, world=v),
        'world', _NO_INTEGERS_OR_NONE | {'2': 2},
    ),
    'sinks': (
        lambda env, batch, v: suite.fork(env, 2, sinks=v),
        'sinks: ', _NO_INTEGERS_OR_NONE | {'no sinks': [None, 3]},
    ),
}  # fmt: skip


def _refuse(call: Any, name: str, *args: Any) -> None:
  with pytest.raises(errors.SpecError) as caught:
    call(*args)
  text = str(caught.value)
  assert text.startswith(name)
  # An exception of a task may come without a message.
  raised = re.search(r': \w+Error(: |$)', text)
  assert 'allowed' in text or 'known are' in text or raised
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
  for value in values.values():
    _refuse(call, name, value)


@pytest.mark.parametrize(
    ('call', 'name', 'values'), _FORKED.values(), ids=_FORKED
)
def test_a_wrong_argument_of_a_fork_is_refused(
    env: Any, batch: Any, call: Any, name: str, values: Any
):
  for value in values.values():
    _refuse(call, name, env, batch, value)


def test_numbers_of_numpy_are_numbers():
  kind = np.int64
  kwargs = {'random': kind(3)}
  options = {'max_steps': kind(2), 'world': kind(1)}
  alone = suite.load(*_WORLD, kwargs, options, design=_DESIGN)
  batch = suite.load_batch(
      *_WORLD, kwargs, {'max_steps': kind(2)}, num_envs=kind(2),
      num_threads=kind(1), sleep=np.False_, design=_DESIGN,
  )  # fmt: skip
  assert type(alone.max_steps) is type(alone.world) is int
  assert type(batch.num_envs) is int
  here, there = alone.reset().observation, batch.reset().observation
  for key, value in here.items():
    np.testing.assert_array_equal(there[key][1], value)
  fork = suite.fork(alone, kind(2), num_threads=kind(1))
  assert fork.num_envs == 2


def test_the_largest_numbers_work():
  largest = 2**63 - 1
  options = {'max_steps': largest, 'world': largest}
  env = suite.load(*_WORLD, {'random': largest}, options, design=_DESIGN)
  time_step = env.reset()
  assert time_step.observation['senses/time_left'] == 1.0
  env.step(np.zeros(env.action_spec().shape))


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
  assert isinstance(caught.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize('name', [None, 3, b'x', ['x'], _Mute()])
def test_tasks_are_registered_by_texts(name: Any):
  for names in ((name, 'task'), ('domain', name)):
    with pytest.raises(errors.SpecError, match='allowed are strings'):
      suite.register_task(*names)
