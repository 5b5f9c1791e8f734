"""Tests for providers: their writes, and that they are pure."""

from collections.abc import Iterator
import copy
import functools
import itertools
from typing import Any, final

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite import testing
from realab_suite.feedback import providers
from realab_suite.policies import action_sets
from realab_suite.testing import providers as contract
from tests import kept
from tests.engine import helpers


@final
class _Counting(policies.ValueFunction):
  """Values action a in step s of an episode at 100 * s + a."""

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape)

  def step(
      self,
      observation: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del observation, key
    steps = np.where(episode_start, 0.0, state) + 1.0
    actions = np.arange(len(self.action_set))
    return 100.0 * steps[..., np.newaxis] + actions, steps


@pytest.fixture(scope='module', autouse=True)
def _inputs() -> Iterator[None]:
  """Makes the inputs of the contract once; loading worlds takes its time."""
  make, load = contract._inputs, suite.load
  made: dict[str, Any] = {}

  def inputs(provider: Any, *rest: Any) -> Any:
    key = repr((provider.required_senses, provider.reads, rest))
    if key not in made:
      made[key] = make(provider, *rest)
    return copy.deepcopy(made[key])

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(contract, '_inputs', inputs)
    patch.setattr(
        suite,
        'load',
        lambda *names, design: kept.load(
            names, functools.partial(load, *names, design=design)
        ),
    )
    yield


@pytest.fixture(autouse=True)
def _value_function() -> Iterator[None]:
  names = policies.VALUE_FUNCTIONS
  with helpers.registered(names, 'test_counting', _Counting):
    yield


def _make(kind: str, **fields: Any) -> providers.Provider:
  return providers.PROVIDERS.get(kind)(kind=kind, **fields)


_REWARD = {'writes': ('reward',)}
_ADVICE = {**_REWARD, 'reads': ('query',)}
# At least one of every shipped kind. `tests/policies` covers the policies.
_CASES: list[tuple[str, dict[str, Any]]] = [
    ('constant', {'writes': ('reward', 'other'), 'value': 1.5}),
    ('difference', {**_REWARD, 'reads': ('score',), 'initial': 2.0}),
    ('growth', {**_REWARD, 'reads': ('score', 'fine'), 'weights': (1.0, -3.0)}),
    ('comparison', {**_REWARD, 'reads': ('score', 'fine'), 'clip': 1,
        'weights': (1.0, -3.0)}),
    ('appraisal', {**_REWARD, 'reads': ('count', 'value')}),
    ('appraisal', {'reads': ('a', 'b', 'likes_a', 'likes_b'), 'drift': 0.2,
        'writes': ('reward', 'likes_a', 'likes_b')}),
    ('relay', {**_REWARD, 'reads': ('call',)}),
    *(('demonstration', {**_REWARD, 'policy': policy}) for policy in ('random',
        'apple_seeker', 'network_demonstrator')),
    ('value_advice', {**_ADVICE, 'value_function': 'test_counting'}),
    *(('value_advice', {**_ADVICE, 'value_function': f, 'query_delay': 1})
        for f in ('test_counting', *policies.VALUE_FUNCTIONS)),
    ('paired_advice', {**_REWARD, 'value_function': 'apple_seeker_approval',
        'reads': ('query', 'score')}),
    ('paired_advice', {**_REWARD, 'value_function': 'apple_seeker_approval',
        'reads': ('query', 'score'), 'tolerance': 0.0}),
    ('inspection', {'reads': ('moved', 'budget'), 'period': 2, 'lasts': 2,
        'writes': ('alarm', 'budget'), 'false_negatives': 0.3}),
    ('inspection', {'reads': ('score', 'a', 'b', 'budget'), 'penalty': 2.0,
        'writes': ('reward', 'budget'), 'probability': 0.7, 'jump': 1.0,
        'suspects': 'score', 'pays': {'kind': 'difference',
        'reads': ('score',), 'writes': ('reward',)}}),
]  # fmt: skip
_IDS = ['-'.join(map(str, [k, *f.values()])) for k, f in _CASES]


def test_every_shipped_kind_is_tested_here():
  shipped = {
      kind
      for kind in providers.PROVIDERS
      if providers.PROVIDERS.get(kind).__module__.startswith(
          'realab_suite.feedback.'
      )
  }
  assert {kind for kind, _ in _CASES} == shipped


@pytest.mark.parametrize(('kind', 'fields'), _CASES, ids=_IDS)
def test_shipped_providers_keep_the_contract(kind: str, fields: dict[str, Any]):
  testing.check_provider(_make(kind, **fields))


@final
class _Plain(providers.Provider):
  """Writes the sum of its readings in an episode."""

  kind: str = 'plain'
  reads: Any = ('score',)
  writes: Any = ('reward',)

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {'sum': np.zeros(batch_shape)}

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> Any:
    total = np.where(episode_start, 0.0, state['sum']) + readings['score']
    return {'reward': total}, {'sum': total}


_NUMBERS = itertools.count()


def _with(change: Any) -> Any:
  """Returns a `step` that changes the arguments or the result of `_Plain`."""

  def step(self: Any, *inputs: Any) -> Any:
    return change(self, _Plain.step, *inputs)

  return step


def _draw(self: Any, step: Any, *inputs: Any) -> Any:
  writes, state = step(self, *inputs)
  return {'reward': writes['reward'] + next(_NUMBERS)}, state


def _scribble(self: Any, step: Any, *inputs: Any) -> Any:
  inputs[1]['score'][...] = 0.0
  return step(self, *inputs)


def _reuse(self: Any, step: Any, *inputs: Any) -> Any:
  writes, state = step(self, *inputs)
  state['sum'] = inputs[-1]['sum']
  state['sum'][...] = writes['reward']
  return writes, state


def _forget(self: Any, step: Any, *inputs: Any) -> Any:
  observation, readings, start, key, state = inputs
  return step(self, observation, readings, start & False, key, state)


def _average(self: Any, step: Any, *inputs: Any) -> Any:
  writes, state = step(self, *inputs)
  mean = np.full(np.shape(writes['reward']), np.mean(writes['reward']))
  return {'reward': mean}, state


def _elsewhere(self: Any, step: Any, *inputs: Any) -> Any:
  writes, state = step(self, *inputs)
  return {'bonus': writes['reward']}, state


def _divide(self: Any, step: Any, *inputs: Any) -> Any:
  writes, state = step(self, *inputs)
  return {'reward': writes['reward'] * np.inf}, state


def _divide_by_change(self: Any, step: Any, *inputs: Any) -> Any:
  start, previous = inputs[2], inputs[-1]['sum']
  change = inputs[1]['score'] - np.where(start, -3.0, previous)
  with np.errstate(invalid='ignore', divide='ignore'):
    return {'reward': change / change}, {'sum': inputs[1]['score'] + 0.0}


def _divide_by_reading(self: Any, step: Any, *inputs: Any) -> Any:
  score = inputs[1]['score']
  with np.errstate(invalid='ignore'):
    return {'reward': score / score}, {'sum': score + 0.0}


_BREACHES = {
    'a reading that stands still': (
        _divide_by_change,
        'values have to be finite',
    ),
    'a reading of 0': (_divide_by_reading, 'values have to be finite'),
    'chance': (_draw, 'equal arguments gave other results'),
    'changed readings': (_scribble, 'step changed its arguments'),
    'a state in place': (_reuse, 'step changed its arguments'),
    'no new episodes': (_forget, 'an episode depends on the one before'),
    'worlds mixed up': (_average, 'in that world alone'),
    'another register': (_elsewhere, "returned writes ['bonus']"),
    'infinite values': (_divide, 'values have to be finite'),
}


def test_a_provider_without_a_breach_keeps_the_contract():
  testing.check_provider(_Plain())


@pytest.mark.parametrize('breach', _BREACHES)
def test_a_breach_of_the_contract_is_named(breach: str):
  change, message = _BREACHES[breach]
  broken: Any = type('Broken', (_Plain,), {'step': _with(change)})
  with pytest.raises(testing.ContractError) as raised:
    testing.check_provider(broken())
  assert message in str(raised.value)


def _play(
    provider: providers.Provider,
    name: str,
    readings: list[float],
    starts: tuple[int, ...] = (0,),
) -> list[float]:
  """Returns the value that a provider writes in each step."""
  state = provider.initial_state(())
  written = []
  for step, reading in enumerate(readings):
    writes, state = provider.step(
        {},
        {name: np.array(reading)},
        np.array(step in starts),
        np.zeros(2, np.uint64),
        state,
    )
    (value,) = writes.values()
    written.append(float(value))
  return written


@pytest.mark.parametrize(
    ('readings', 'starts', 'initial', 'expected'),
    [
        ([0, 0, 1, 1, 3], (0,), 0.0, [0, 0, 1, 0, 2]),
        ([5, 6, 1, 1], (0, 2), 1.0, [4, 1, 0, 0]),
    ],
)
def test_difference_writes_the_growth_of_a_reading(
    readings: list[float],
    starts: tuple[int, ...],
    initial: float,
    expected: list[float],
):
  provider = _make(
      'difference', reads=('score',), writes=('reward',), initial=initial
  )
  written = _play(provider, 'score', readings, starts)
  np.testing.assert_allclose(written, expected, atol=1e-12)


@pytest.mark.parametrize(
    ('delay', 'queries', 'starts', 'expected'),
    [
        # 100 * step + action, of this step or of the step before.
        (0, [3, 4, 5, 6], (0, 2), [103, 204, 105, 206]),
        (1, [3, 4, 5, 6], (0, 2), [0, 103, 0, 105]),
        # Readings of a query are rounded and clipped to the action set.
        (1, [2.4, 2.6, 99.0, 0.0], (0,), [0, 102, 203, 313]),
    ],
)
def test_value_advice_values_the_query_of_this_or_the_last_step(
    delay: int,
    queries: list[float],
    starts: tuple[int, ...],
    expected: list[float],
):
  provider = _make(
      'value_advice',
      value_function='test_counting',
      reads=('query',),
      writes=('advice',),
      query_delay=delay,
  )
  assert _play(provider, 'query', queries, starts) == expected


@pytest.mark.parametrize(
    ('query', 'other', 'expected'),
    [(5.0, 3.0, 2.0), (2.4, 99.0, -11.0)],
)
def test_paired_advice_writes_the_difference_of_two_values(
    query, other, expected
):
  provider = _make(
      'paired_advice',
      value_function='test_counting',
      reads=('query', 'other'),
      writes=('advice',),
  )
  readings = {'query': np.array(query), 'other': np.array(other)}
  key, start = np.zeros(2, np.uint64), np.array(True)
  state = provider.initial_state(())
  writes, _ = provider.step({}, readings, start, key, state)
  assert writes == {'advice': expected}


def test_the_order_of_an_action_set_never_changes():
  # Recorded results and readings depend on it.
  names = [name for name, _ in action_sets.get('dmlab_like', 1).actions]
  assert names == [
      'wait', 'forward', 'backward', 'strafe_left', 'strafe_right', 'turn_left',
      'turn_right', 'forward_turn_left', 'forward_turn_right', 'look_up',
      'look_down', 'grasp', 'let_go', 'throw',
  ]  # fmt: skip
