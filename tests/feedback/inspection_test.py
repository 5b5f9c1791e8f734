"""Inspections: supervision with a price, to the number.

Detectors say 0 or 1, and a loop plays the register of the budget: what is
written is read in the next step, unless a test moves it.
"""

import math
from typing import Any, final

import numpy as np
import pytest

from realab_suite.config import loading
from realab_suite.doors.browser import person
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.config import refusals

_MANY = 2000


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
        (99, {'period': 4}, [4, 8, 12]),
        (2, {'period': 5}, [5, 10]),
        (2, {'price': 0.5}, [1, 2, 3, 4]),
        (7, {'price': 3.0, 'period': 2}, [2, 4]),
        # Blocks of a budget may be moved: half a price buys an inspection.
        (0.4, {}, []),
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


def test_each_episode_has_a_budget_and_an_alarm_of_its_own():
  provider = _make(period=3, lasts=99)
  found = _play(provider, 2, [0, 1, 1, 0, 0, 0, 1, 0], starts=(0, 4))
  assert _steps(found['asks']) == [3, 7]
  np.testing.assert_array_equal(found['alarm'], [0, 0, 1, 1, 0, 0, 1, 1])


@pytest.mark.parametrize('names', [('moved',), ('z', 'a'), ('a', 'b', 'c')])
def test_one_detector_of_several_is_enough(names: tuple[str, ...]):
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
        ({'plausible': (-2.0, 12.0), 'above': 5.0}, []),
        # The first step has no step before; else, 5 would be a jump.
        ({'jump': 4.5}, [3, 4, 5, 6]),
        ({'jump': 6.0, 'above': 5.0}, [4]),
        ({'jump': 12.0, 'plausible': (-6.0, 15.0)}, [4, 5]),
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


def test_the_budget_goes_to_what_is_suspicious():
  readings = [0, 9, 0, 0, 9, 0, 9, 9]
  options: Any = {
      'reads': ('score', 'moved', 'budget'), 'suspects': 'score',
      'plausible': (-1.0, 1.0),
  }  # fmt: skip
  found = _play(_make(**options), 2, [0] * 8, score=readings)
  assert _steps(found['asks']) == [2, 5]
  found = _play(_make(**options, period=7), 2, [0] * 8, score=readings)
  assert _steps(found['asks']) == [7]


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
        (1, 1, {'false_negatives': 0.3}, 0.7),
        (1, 1, {'false_negatives': 0.3, 'false_positives': 0.9}, 0.7),
        (0, 1, {'false_positives': 0.2}, 0.2),
        (0, 1, {'false_negatives': 0.9}, 0.0),
        (1, 1, {'false_positives': 0.9}, 1.0),
        # One of two is enough: 1 - 0.5 * 0.5, and 1 - 0.8 * 0.8.
        (1, 2, {'false_negatives': 0.5}, 0.75),
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


def test_the_number_of_inspections_at_random_is_binomial():
  found = _play(_make(probability=0.3), 99, [0] * 5, (_MANY,))
  _assert_binomial(found['asks'].sum(axis=0), 5, 0.3)
  found = _play(_make(probability=0.3), 1, [0] * 5, (_MANY,))
  at_once = found['asks'][0].sum()
  assert abs(at_once - 0.3 * _MANY) < 4 * math.sqrt(_MANY * 0.3 * 0.7)
  assert abs(found['asks'].sum() - (1 - 0.7**5) * _MANY) < 80


def test_worlds_of_a_batch_err_as_each_alone():
  provider = _make(
      probability=0.5, false_negatives=0.4, false_positives=0.3, lasts=2
  )
  together = _play(provider, 4, [0, 1, 1, 0, 1, 0], (5,))
  assert len({alarms.tobytes() for alarms in together['alarm'].T}) > 3
  keys = _keys(0, (5,))
  for world in range(5):
    state = provider.initial_state(())
    left = np.array(4.0)
    for step, moved in enumerate([0, 1, 1, 0, 1, 0]):
      key = keys[world] + np.array([0, step], np.uint64)
      readings = {'moved': np.array(float(moved)), 'budget': left}
      writes, state = provider.step(
          {}, readings, np.array(step == 0), key, state
      )
      value, asks = writes['budget']
      left = np.where(asks, value, left)
      assert writes['alarm'] == together['alarm'][step, world]
      assert left == together['budget'][step, world]


def test_inspections_and_what_is_paid_are_drawn_independently():
  fields: Any = {'kind': 'demonstration', 'policy': 'random', 'writes': ('r',)}
  provider = _make(
      pays=fields, probability=0.5, writes=('r', 'alarm', 'budget')
  )
  found = _play(provider, 9, [0] * 2, (_MANY,))
  drawn, asks = found['r'].ravel(), found['asks'].ravel().astype(float)
  # The standard deviation is 1 / sqrt(2 * 2000).
  assert abs(np.corrcoef(drawn, asks)[0, 1]) < 4 / math.sqrt(2 * _MANY)


# What is paid.

_PAID: dict[str, Any] = {
    'difference': {'kind': 'difference', 'reads': ('a',), 'writes': ('r',)},
    'growth': {
        'kind': 'growth', 'reads': ('b', 'a'), 'writes': ('r',),
        'weights': (1.0, -2.0),
    },
    # It draws from the key, and writes two registers.
    'random': {'kind': 'demonstration', 'policy': 'random', 'writes': ('r',)},
    'two': {'kind': 'constant', 'value': 2.0, 'writes': ('r', 's')},
}  # fmt: skip


@pytest.mark.parametrize('name', _PAID)
@pytest.mark.parametrize('penalty', [0.0, 2.5])
def test_it_pays_what_a_provider_pays_less_the_fines(name: str, penalty: float):
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


@final
class _Speaking(providers.Provider):
  """Writes 5 where a reading is 1, nothing where it is 0, and 7 at 2."""

  kind: str = 'speaking'
  reads: Any = ('q',)
  writes: Any = ('r', 's')

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> Any:
    assert [*readings] == ['q']  # No detector, and no budget.
    asked = readings['q']
    if (asked == 2).all():
      return {'s': np.full(asked.shape, 7.0)}, state
    return {'r': (np.full(asked.shape, 5.0), asked == 1)}, state


@pytest.mark.parametrize('shape', [(), (2,)])
def test_a_silent_provider_stays_silent(shape: tuple[int, ...]):
  provider = _make(
      pays=_Speaking(), penalty=3.0, reads=('q', 'moved', 'budget'),
      writes=('r', 's', 'budget'),
  )  # fmt: skip
  found = []
  for asked in (0.0, 1.0, 2.0):
    readings = {'q': asked, 'moved': 1.0, 'budget': 9.0}
    writes, _ = provider.step(
        {},
        {name: np.full(shape, value) for name, value in readings.items()},
        np.ones(shape, bool),
        _keys(0, shape),
        provider.initial_state(shape),
    )
    assert np.all(writes.pop('budget')[0] == 8.0)
    found.append(writes)
  silent, spoken, other = found
  assert [*silent] == [*spoken] == ['r']
  assert not np.any(silent['r'][1])
  assert np.all(spoken['r'][0] == 2.0)
  assert np.all(spoken['r'][1])
  # Only the first register is fined.
  assert [*other] == ['s']
  assert np.all(other['s'] == 7.0)


def test_it_needs_what_the_provider_that_it_pays_for_needs():
  corrections: Any = {
      'kind': person.KIND, 'asks': 'correction', 'writes': ('r',),
      'answers': 'simulated',
  }  # fmt: skip
  provider = _make(
      pays=corrections, reads=('moved', 'budget'), writes=('r', 'budget')
  )
  alone = provider.pays
  assert provider.required_senses == alone.required_senses != ()
  assert provider.privileged_senses == alone.privileged_senses
  assert provider.action_writes == ('r',)
  assert provider.is_repeatable
  live = _make(
      pays={**corrections, 'answers': 'live'},
      reads=('moved', 'budget'),
      writes=('r', 'budget'),
  )
  assert not live.is_repeatable
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
        'providers[0]: registers.budget.initial: a budget of 0; allowed is at'
        ' least the price of one inspection, 1',
    'registers.budget.initial=1 & providers.0.price=1.5':
        'a budget of 1; allowed is at least the price of one inspection, 1.5',
    'registers.budget.initial=9':
        'registers.budget: initial 9.0 must be in range [0.0, 8.0]',
    'registers.budget.range=[1, 8]':
        'registers.budget.range: [1.0, 8.0]; allowed for a budget are ranges'
        ' that contain 0',
    'registers.budget.role=signal':
        "reads: 'budget', whose role is 'signal', as the budget; allowed is"
        ' memory',
    'registers.budget.role=meter':
        "providers[0].writes: register 'budget' has role 'meter'",
    'providers.0.reads=[meter_a, alarm, budget]':
        "reads: 'alarm', whose role is 'signal', as a detector; allowed is"
        ' meter',
    'providers.0.reads=[meter_a, reward, meter_b, budget]':
        "reads: 'reward', whose role is 'feedback', as a detector",
    'providers.0.reads=[meter_a, secret, budget]':
        "providers[0].reads: register 'secret' is not declared",
    'providers.0.reads=[meter_a, budget]':
        "providers[0]: reads: ['meter_a', 'budget']; allowed are those with a"
        ' detector, too',
    'providers.0.reads=[meter_a, budget, meter_b]':
        "reads ends with 'meter_b', and writes with 'budget'; allowed is the"
        ' budget as the last of both',
    'providers.0.reads=[meter_b, budget]':
        "pays reads ['meter_a'] and writes ['reward']; allowed are names in"
        ' reads',
    'providers.0.writes=[alarm, reward, budget]':
        'and the first ones in writes',
    'providers.0.pays.every=2':
        'pays: every and senses are given; allowed are those of the inspection',
    'providers.0.pays.kind=diference':
        "providers[0].pays.kind: provider kind 'diference' is unknown; did you"
        " mean 'difference'?",
    'providers.0.suspects=score':
        "suspects: 'score'; allowed are ['meter_a', 'meter_b']",
    'providers.0.false_positives=1':
        'providers[0].false_positives: must be less than 1, got 1',
    'providers.0.false_negatives=-0.1':
        'false_negatives: must be greater than or equal to 0, got -0.1',
    'providers.0.probability=0':
        'probability: must be greater than 0, got 0',
    'providers.0.probability=1.1':
        'probability: must be less than or equal to 1, got 1.1',
    'providers.0.price=0': 'price: must be greater than 0, got 0',
    'providers.0.period=0': 'period: must be greater than or equal to 1, got 0',
    'providers.0.suspects=meter_a & providers.0.plausible=[1, 0]':
        'plausible: [1.0, 0.0]; allowed are the lowest reading and then the',
    'providers.0.plausible=[0, 1]':
        'plausible: (0.0, 1.0); allowed is none without suspects',
    'providers.0.jump=1': 'jump: 1.0; allowed is none without suspects',
    'providers.0.above=1': 'above: 1.0; allowed is none without suspects',
    _ALONE % ', penalty: 1': 'penalty: 1.0; allowed is none without pays',
    'registers.alarm.range=[0, 0.5]':
        "writes: 'alarm' holds 0.5 at most, and the learner heeds what is above"
        ' 0.5; allowed are a larger range, and a smaller learner.defence.above',
    'learner.defence.above=1': "'alarm' holds 1 at most, and the learner heeds",
    'registers.meter.range=[0, 0.5]':
        'registers.meter_b.range: ends at 0.5, so it never reports a sighting;'
        ' allowed for a detector are ends above 0.5',
    'registers.budget.initial=score':
        'registers.budget.initial: a budget of score; allowed is at least the',
    'providers.0.penalty=-1': 'penalty: must be greater than or equal to 0',
    'meters.1.measures.of=[]': 'measures.of: must have at least 1 item',
    _ALONE % ', suspects: budget':
        "suspects: 'budget'; allowed are ['meter_b']",
    _ALONE % ', suspects: meter_b': 'allowed are those with a detector, too',
}  # fmt: skip


def test_an_alarm_may_have_a_small_range_if_the_learner_notices_it():
  for overrides in (
      ('registers.alarm.range=[0, 0.5]', 'learner.defence.above=0.4'),
      ('registers.alarm.range=[0, 0.5]', 'learner.defence=null'),
  ):
    design = specs.load(_DESIGN, overrides)
    assert design.ports['alarm'].range == (0.0, 0.5)


@pytest.mark.parametrize('overrides', _WRONG)
def test_a_wrong_inspection_is_refused_with_the_reason(overrides: str):
  text = refusals.refusal(specs.load, _DESIGN, tuple(overrides.split(' & ')))
  assert _WRONG[overrides] in text


@pytest.mark.parametrize(
    'override', [_ALONE % '', _ALONE % ', pays: null', 'providers.0.pays=null']
)
def test_an_inspection_need_not_pay(override: str):
  data = loading.apply_overrides(_DESIGN, (override,))
  if 'pays=null' in override:
    # Without the score, what it paid for is a detector, and the reward an
    # alarm.
    data['providers'][0] |= {'writes': ['alarm', 'budget']}
  (provider,) = specs.load(data).providers
  assert provider.pays is None
  assert 'pays' not in specs.load(data).to_mapping()['providers'][0]
