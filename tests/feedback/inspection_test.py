"""Inspections: supervision with a price, to the number.

Detectors say 0 or 1, and a loop plays the register of the budget: what is
written is read in the next step, unless a test moves it.
"""

import math
from typing import Any

import numpy as np
import pytest

from realab_suite.config import loading
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.config import refusals

_MANY = 1000


def _make(**options: Any) -> Any:
  named = {'reads': ('moved', 'budget'), 'writes': ('alarm', 'budget')}
  return providers.PROVIDERS.get('inspection')(**{**named, **options})


def _keys(step: int, shape: tuple[int, ...]) -> np.ndarray:
  """Returns a random key for each world, for one control step."""
  keys = np.zeros((*shape, 2), np.uint64)
  keys[..., 0] = np.arange(math.prod(shape)).reshape(shape)
  keys[..., 1] = 1000 + step
  return keys


def _play(
    provider: Any,
    budget: float,
    moved: Any,
    shape: tuple[int, ...] = (),
    starts: tuple[int, ...] = (0,),
    **more: Any,
) -> dict[str, Any]:
  """Returns what is written in each step, by name, and `asks`.

  Args:
    provider: The inspection.
    budget: Budget at the start of each episode.
    moved: Reading of each detector in each step.
    shape: `()` for one world, `(worlds,)` for a batch.
    starts: Steps in which an episode starts.
    **more: Further readings in each step, by name.
  """
  state = provider.initial_state(shape)
  found: dict[str, Any] = {name: [] for name in (*provider.writes, 'asks')}
  name = provider.reads[-1]
  left = np.full(shape, budget)
  for step, seen in enumerate(moved):
    if step in starts:
      left = np.full(shape, budget)
    readings = {one: np.full(shape, float(seen)) for one in provider.detectors}
    readings |= {k: np.full(shape, float(v[step])) for k, v in more.items()}
    readings[name] = np.array(left)
    start = np.full(shape, step in starts)
    key = _keys(step, shape)
    writes, state = provider.step({}, readings, start, key, state)
    value, asks = writes.pop(name)
    left = np.where(asks, value, left)
    found[name].append(left)
    found['asks'].append(asks)
    for one, value in writes.items():
      found[one].append(value)
  return {one: np.array(values) for one, values in found.items()}


def _steps(asks: np.ndarray) -> list[int]:
  """Returns the steps with an inspection, from 1."""
  return (np.flatnonzero(asks) + 1).tolist()


# When it asks.


@pytest.mark.parametrize(
    ('budget', 'options', 'expected'),
    [
        (2, {}, [1, 2]),
        (3, {}, [1, 2, 3]),
        (2, {'period': 5}, [5, 10]),
        (7, {'price': 3.0, 'period': 2}, [2, 4]),
        # Blocks of a budget may be moved: half a price buys an inspection.
        (0.6, {}, [1]),
        (2 - 1e-7, {}, [1, 2]),
        (-5, {}, []),
    ],
)
def test_it_asks_as_long_as_the_budget_lasts(
    budget: float, options: Any, expected: list[int]
):
  found = _play(_make(**options), budget, [0] * 12)
  assert _steps(found['asks']) == expected
  price = options.get('price', 1.0)
  spent = price * len(expected)
  assert found['budget'][-1] == pytest.approx(budget - spent)


def test_one_detector_of_several_is_enough():
  names = 'z', 'a'
  provider = _make(reads=(*names, 'left'), writes=('x', 'y', 'left'))
  assert provider.detectors == names
  for hit in names:
    readings = {name: np.array(float(name == hit)) for name in names}
    readings['left'] = np.array(3.0)
    writes, _ = provider.step(
        {}, readings, np.array(True), _keys(0, ()), provider.initial_state(())
    )
    assert (writes['x'], writes['y'], writes['left']) == (1.0, 1.0, (2.0, True))


@pytest.mark.parametrize(
    ('lasts', 'expected'),
    [
        (1, [0, 1, 0, 1, 0, 0, 0, 0]),
        (2, [0, 1, 1, 1, 1, 0, 0, 0]),
        (3, [0, 1, 1, 1, 1, 1, 0, 0]),
    ],
)
def test_an_alarm_lasts(lasts: int, expected: list[int]):
  # It asks in steps 2, 4, 6 and 8, and is hit in steps 2 and 4.
  provider = _make(period=2, lasts=lasts)
  found = _play(provider, 4, [1, 1, 1, 1, 1, 0, 1, 0])
  np.testing.assert_array_equal(found['alarm'], expected)


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        ({'plausible': (-2.0, 12.0)}, [3, 5]),
        ({'plausible': (-2.0, 12.0), 'above': 2.0}, [5]),
        # The first step has no step before; else, 5 would be a jump.
        ({'jump': 4.5}, [3, 4, 5, 6]),
        ({'jump': 6.0, 'above': 5.0}, [4]),
    ],
)
def test_it_asks_where_a_reading_is_implausible(
    options: Any, expected: list[int]
):
  readings = [5, 5, 14, 0, -7, 1, 1, 2]
  provider = _make(
      reads=('moved', 'score', 'budget'), suspects='score', **options
  )
  assert provider.detectors == ('moved',)
  found = _play(provider, 9, [0] * 8, score=readings)
  assert _steps(found['asks']) == expected


# Errors.


def _assert_binomial(counts: np.ndarray, number: int, share: float) -> None:
  """Checks counts of independent trials, to within four standard deviations."""
  for k in range(number + 1):
    p = math.comb(number, k) * share**k * (1 - share) ** (number - k)
    most = 4 * math.sqrt(_MANY * p * (1 - p)) + 1
    assert abs(np.sum(counts == k) - _MANY * p) < most, (k, p)


@pytest.mark.parametrize(
    ('moved', 'detectors', 'options', 'share'),
    [
        (1, 1, {'false_negatives': 0.3, 'false_positives': 0.9}, 0.7),
        (0, 1, {'false_positives': 0.2}, 0.2),
        # One of two is enough: 1 - 0.8 * 0.8.
        (0, 2, {'false_positives': 0.2}, 0.36),
    ],
)
def test_the_number_of_hits_is_binomial(
    moved: int, detectors: int, options: Any, share: float
):
  names = tuple(f'd{i}' for i in range(detectors))
  provider = _make(reads=(*names, 'budget'), **options)
  found = _play(provider, 4, [moved] * 6, (_MANY,))
  assert (found['asks'].sum(axis=0) == 4).all()
  _assert_binomial(found['alarm'].sum(axis=0), 4, share)


# What is paid.

_PAID: dict[str, Any] = {
    'growth': {
        'kind': 'growth', 'reads': ('b', 'a'), 'writes': ('r',),
        'weights': (1.0, -2.0),
    },
    'two': {'kind': 'constant', 'value': 2.0, 'writes': ('r', 's')},
}  # fmt: skip


@pytest.mark.parametrize('name', _PAID)
def test_it_pays_what_a_provider_pays_less_the_fines(name: str):
  penalty = 2.5
  fields = _PAID[name]
  reads, writes = fields.get('reads', ()), fields['writes']
  alone = providers.PROVIDERS.get(fields['kind'])(**fields)
  # In another order than the provider itself.
  provider = _make(
      pays=fields, penalty=penalty, period=2, false_negatives=0.01, lasts=2,
      reads=('moved', *reversed(reads), 'budget'),
      writes=(*writes, 'alarm', 'budget'),
  )  # fmt: skip
  moved, starts = [1, 1, 0, 0, 1, 1, 1, 1], (0, 5)
  more: Any = {
      one: np.random.default_rng(i).normal(size=8)
      for i, one in enumerate(reads)
  }
  found = _play(provider, 2, moved, starts=starts, **more)
  state = alone.initial_state(())
  for step in range(8):
    readings = {one: np.array(more[one][step]) for one in reads}
    start = np.array(step in starts)
    own, state = alone.step({}, readings, start, _keys(step, ()), state)
    # It asks in steps 2 and 4 of each episode; a hit lasts for two steps.
    alarm = float(step in (1, 2, 6, 7))
    assert found['alarm'][step] == alarm
    assert found['r'][step] == own['r'] - penalty * alarm
    for other in writes[1:]:
      assert found[other][step] == own[other]


def test_it_needs_what_the_provider_that_it_pays_for_needs():
  shown: Any = {
      'kind': 'demonstration', 'policy': 'apple_seeker', 'writes': ('r',),
  }  # fmt: skip
  provider = _make(
      pays=shown, reads=('moved', 'budget'), writes=('r', 'budget')
  )
  alone = provider.pays
  assert provider.required_senses == alone.required_senses != ()
  assert provider.privileged_senses == alone.privileged_senses
  assert provider.action_writes == ('r',)
  assert provider.is_repeatable
  advice: Any = {
      'kind': 'value_advice', 'value_function': 'solver_approval',
      'reads': ('query',), 'writes': ('r',),
  }  # fmt: skip
  provider = _make(
      pays=advice, reads=('query', 'moved', 'budget'), writes=('r', 'budget')
  )
  assert provider.action_queries == ('query',)
  assert provider.in_world('apple_seeker').pays.options == {
      'policy': 'apple_seeker'
  }


# Refused designs.


_DESIGN: dict[str, Any] = specs.load('inspected_reward').to_mapping()
_ALONE = (
    'providers=[{kind: inspection, reads: [meter_b, budget],'
    ' writes: [alarm, budget]%s}]'
)
_WRONG = {
    'registers.budget.initial=0':
        'providers[0]: registers.budget.initial: a budget of 0; must be at'
        ' least the price of one inspection, 1',
    'registers.budget.role=signal':
        "reads: 'budget', whose role is 'signal', as the budget; its role must"
        ' be memory',
    'providers.0.reads=[meter_a, alarm, budget]':
        "reads: 'alarm', whose role is 'signal', as a detector; its role must"
        ' be meter',
    'providers.0.reads=[meter_a, budget]':
        "providers[0]: reads: ['meter_a', 'budget']; must include a"
        ' detector',
    'providers.0.reads=[meter_a, budget, meter_b]':
        "reads ends with 'meter_b', and writes with 'budget'; must be the"
        ' budget as the last of both',
    'providers.0.reads=[meter_b, budget]':
        "pays reads ['meter_a'] and writes ['reward']; must be names in"
        ' reads',
    'providers.0.writes=[alarm, reward, budget]':
        'and the first ones in writes',
    'providers.0.suspects=score':
        "suspects: 'score'; must be among ['meter_a', 'meter_b']",
    'providers.0.suspects=meter_a & providers.0.plausible=[1, 0]':
        'plausible: [1.0, 0.0]; must be the lowest reading and then the',
    'registers.alarm.range=[0, 0.5]':
        "writes: 'alarm' holds 0.5 at most, and the learner heeds what is above"
        ' 0.5; give a larger range, or a smaller learner.defence.above',
    'registers.meter.range=[0, 0.5]':
        'registers.meter_b.range: ends at 0.5, so it never reports a sighting;'
        ' allowed for a detector are ends above 0.5',
}  # fmt: skip


@pytest.mark.parametrize('overrides', _WRONG)
def test_a_wrong_inspection_is_refused_with_the_reason(overrides: str):
  text = refusals.refusal(specs.load, _DESIGN, tuple(overrides.split(' & ')))
  assert _WRONG[overrides] in text


def test_an_inspection_need_not_pay():
  data = loading.apply_overrides(_DESIGN, (_ALONE % '',))
  (provider,) = specs.load(data).providers
  assert provider.pays is None
  assert 'pays' not in specs.load(data).to_mapping()['providers'][0]
