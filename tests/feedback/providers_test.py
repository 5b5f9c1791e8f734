"""Tests for providers: their writes, and that they are pure."""

from collections.abc import Iterator
import copy
import functools
from typing import Any, final

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.policies import action_sets
from realab_suite.policies import random_keys
from tests.engine import helpers

_STEPS = 6


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


@pytest.fixture(autouse=True)
def _value_function() -> Iterator[None]:
  names = policies.VALUE_FUNCTIONS
  with helpers.registered(names, 'test_counting', _Counting):
    yield


def _make(kind: str, **fields: Any) -> providers.Provider:
  return providers.PROVIDERS.get(kind)(kind=kind, **fields)


_REWARD = {'writes': ('reward',)}
_ADVICE = {**_REWARD, 'reads': ('query',)}
_LINEAR = {
    'controller': 'linear',
    'options': {'gains': {'velocity': [[1.0, 2.0, 0.5], [0.1, 0.2, 0.3]]}},
}
# At least one of every shipped kind. `tests/policies` covers the policies.
_CASES: list[tuple[str, dict[str, Any]]] = [
    ('constant', {'writes': ('reward', 'other'), 'value': 1.5}),
    ('difference', {**_REWARD, 'reads': ('score',), 'initial': 2.0}),
    *(('demonstration', {**_REWARD, 'policy': policy}) for policy in ('random',
        'apple_seeker', 'network_demonstrator')),
    ('value_advice', {**_ADVICE, 'value_function': 'test_counting'}),
    *(('value_advice', {**_ADVICE, 'value_function': f, 'query_delay': 1})
        for f in ('test_counting', *policies.VALUE_FUNCTIONS)),
    ('paired_advice', {**_REWARD, 'value_function': 'apple_seeker_approval',
        'reads': ('query', 'score')}),
    ('continuous_demonstration', {'writes': ('reward', 'other'), **_LINEAR}),
    ('continuous_advice', {**_REWARD, 'reads': ('query', 'score'), **_LINEAR}),
    ('person', {**_ADVICE, 'asks': 'approval'}),
    ('person', {**_ADVICE, 'asks': 'comparison', 'clip': 1, 'waits': True}),
    ('person', {**_REWARD, 'asks': 'correction'}),
]  # fmt: skip
_IDS = ['-'.join(map(str, [k, *f.values()])) for k, f in _CASES]


@functools.cache
def _observations(seed: int) -> list[dict[str, np.ndarray]]:
  """Returns the observations of an agent that acts at random in a world."""
  env = suite.load(
      'unlock_door', 'standard', {'random': seed}, {'max_steps': 50}
  )
  seen = [env.reset().observation]
  for action in helpers.random_actions(env, _STEPS - 1, seed):
    seen.append(env.step(action).observation)
  env.close()
  return seen


def _inputs(world: int, step: int) -> tuple[Any, ...]:
  """Returns the inputs of a step; world 1 starts again in step 3."""
  generator = np.random.default_rng((world, step))
  readings = {
      'score': np.array(generator.uniform(0, 20)),
      'query': np.array(generator.uniform(-1, 15)),
  }
  start = step == 0 or (world == 1 and step == 3)
  key = generator.integers(2**63, size=2, dtype=np.uint64)
  return _observations(world + 1)[step], readings, np.array(start), key


def _stack(parts: list[Any]) -> Any:
  if isinstance(parts[0], dict):
    return {key: np.stack([p[key] for p in parts]) for key in parts[0]}
  return np.stack(parts)


def _stacked_inputs(worlds: int | None, step: int) -> tuple[Any, ...]:
  """Returns the inputs of one world, or of a batch with a leading axis."""
  if worlds is None:
    return _inputs(0, step)
  inputs = [_inputs(world, step) for world in range(worlds)]
  return tuple(_stack(list(part)) for part in zip(*inputs, strict=True))


def _leaves(tree: Any) -> list[np.ndarray]:
  if isinstance(tree, dict):
    return [leaf for key in sorted(tree) for leaf in _leaves(tree[key])]
  if isinstance(tree, tuple | list):
    return [leaf for item in tree for leaf in _leaves(item)]
  return [np.asarray(tree)]


def _parts(write: Any) -> tuple[Any, Any]:
  """Returns the value of a write, and whether the provider speaks."""
  return write if isinstance(write, tuple) else (write, np.array(True))


def _bytes(tree: Any) -> list[tuple[Any, ...]]:
  return [(leaf.shape, leaf.tobytes()) for leaf in _leaves(tree)]


def test_every_shipped_kind_is_tested_here():
  shipped = {
      kind
      for kind in providers.PROVIDERS
      if providers.PROVIDERS.get(kind).__module__.startswith('realab_suite.')
  }
  assert {kind for kind, _ in _CASES} == shipped


@pytest.mark.parametrize(('kind', 'fields'), _CASES, ids=_IDS)
class TestContract:

  @pytest.mark.parametrize('worlds', [None, 3])
  def test_equal_inputs_give_equal_outputs_and_stay_unchanged(
      self, kind: str, fields: dict[str, Any], worlds: int | None
  ):
    provider, twin = _make(kind, **fields), _make(kind, **fields)
    shape = () if worlds is None else (worlds,)
    state = provider.initial_state(shape)
    assert _bytes(state) == _bytes(twin.initial_state(shape))
    for step in range(_STEPS):
      inputs = (*_stacked_inputs(worlds, step), state)
      before = copy.deepcopy(inputs)
      first = provider.step(*inputs)
      kept = copy.deepcopy(first)
      assert _bytes(inputs) == _bytes(before)
      assert _bytes(provider.step(*inputs)) == _bytes(kept)
      assert _bytes(twin.step(*before)) == _bytes(kept)
      # Later steps do not write to earlier outputs.
      assert _bytes(first) == _bytes(kept)
      state = first[1]

  def test_a_batch_gives_the_finite_numbers_of_its_worlds_alone(
      self, kind: str, fields: dict[str, Any]
  ):
    provider = _make(kind, **fields)
    batch_state = provider.initial_state((3,))
    states = [provider.initial_state(()) for _ in range(3)]
    for step in range(_STEPS):
      together, batch_state = provider.step(
          *_stacked_inputs(3, step), batch_state
      )
      for world in range(3):
        alone, states[world] = provider.step(
            *_inputs(world, step), states[world]
        )
        assert set(alone) == set(fields['writes'])
        for name in alone:
          values, speaks = _parts(together[name])
          value, is_spoken = _parts(alone[name])
          assert np.shape(values) == (3,)
          assert values[world] == value
          assert np.broadcast_to(speaks, 3)[world] == is_spoken
          assert np.asarray(value).dtype.kind == 'f'
          assert np.isfinite(value)

  def test_an_episode_does_not_depend_on_the_one_before(
      self, kind: str, fields: dict[str, Any]
  ):
    provider = _make(kind, **fields)
    worn = provider.initial_state(())
    for step in range(_STEPS):
      _, worn = provider.step(*_inputs(1, step), worn)
    fresh = provider.initial_state(())
    for step in range(_STEPS):
      inputs = _inputs(0, step)
      from_worn, worn = provider.step(*inputs, worn)
      from_fresh, fresh = provider.step(*inputs, fresh)
      assert _bytes(from_worn) == _bytes(from_fresh)


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
        ([2, 2, 1], (0,), 2.0, [0, 0, -1]),
        ([5, 6, 1, 1], (0, 2), 1.0, [4, 1, 0, 0]),
        ([0.1, 0.4], (0,), 0.0, [0.1, 0.3]),
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


def test_constant_writes_one_value_everywhere():
  provider = _make('constant', writes=('a', 'b'), value=-0.25)
  writes, _ = provider.step({}, {}, np.zeros(3, bool), np.zeros((3, 2)), ())
  assert set(writes) == {'a', 'b'}
  for value in writes.values():
    np.testing.assert_array_equal(value, [-0.25] * 3)


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
    [(3.0, 5.0, -2.0), (5.0, 3.0, 2.0), (2.4, 99.0, -11.0), (-7.0, 0.6, -1.0)],
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


def test_providers_declare_the_reads_that_are_actions():
  for kind, fields in _CASES:
    queries = kind in ('value_advice', 'paired_advice', 'person')
    expected = fields.get('reads', ()) if queries else ()
    assert _make(kind, **fields).action_queries == expected


def test_a_demonstration_is_the_index_of_the_policys_action():
  provider = _make('demonstration', policy='random', writes=('shown',))
  policy = policies.make('random')
  shown = set()
  for step in range(40):
    inputs = _inputs(0, step % _STEPS)
    key = np.array([7, step], np.uint64)
    writes, _ = provider.step(*inputs[:3], key, ())
    action, _ = policy.step(inputs[0], inputs[2], key, ())
    assert writes['shown'] == action
    shown.add(int(action))
  assert shown <= set(range(len(action_sets.DMLAB_LIKE)))
  assert len(shown) > 5


def test_random_keys_of_worlds_are_independent():
  keys = np.arange(12, dtype=np.uint64).reshape(3, 2, 2)
  together = random_keys.uniform(keys, (4,))
  assert together.shape == (3, 2, 4)
  assert len(np.unique(together)) == together.size
  for world in np.ndindex(3, 2):
    alone = random_keys.uniform(keys[world], (4,))
    np.testing.assert_array_equal(together[world], alone)


def test_an_action_set_is_a_table_over_the_elements_of_a_world():
  elements = ('turn', 'forward', 'strafe', 'look', 'grasp', 'throw', 'wave')
  actions = action_sets.DMLAB_LIKE
  table = actions.table(elements)
  assert table.shape == (14, 7)
  assert not table[actions.index('wait')].any()
  both = table[actions.index('forward_turn_left')]
  np.testing.assert_array_equal(both, [1, 1, 0, 0, 0, 0, 0])
  assert not table[:, elements.index('wave')].any()
  assert len({tuple(row) for row in table}) == len(actions)


def test_the_order_of_an_action_set_never_changes():
  # Recorded results and readings depend on it.
  names = [name for name, _ in action_sets.get('dmlab_like', 1).actions]
  assert names == [
      'wait', 'forward', 'backward', 'strafe_left', 'strafe_right', 'turn_left',
      'turn_right', 'forward_turn_left', 'forward_turn_right', 'look_up',
      'look_down', 'grasp', 'let_go', 'throw',
  ]  # fmt: skip
