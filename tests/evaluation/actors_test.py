"""Tests of actors: indices become actions, and queries are added."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import actors
from realab_suite.policies import action_sets
from tests import kept

_NUM_ACTIONS = 14
# The world's control elements, in the order of its action spec.
_ELEMENTS = ('forward', 'strafe', 'turn', 'look', 'grasp', 'throw')
# The table of dmlab_like v1, written down once more.
_VECTORS = [
    [0, 0, 0, 0, 0, 0],
    [1, 0, 0, 0, 0, 0],
    [-1, 0, 0, 0, 0, 0],
    [0, 1, 0, 0, 0, 0],
    [0, -1, 0, 0, 0, 0],
    [0, 0, 1, 0, 0, 0],
    [0, 0, -1, 0, 0, 0],
    [1, 0, 1, 0, 0, 0],
    [1, 0, -1, 0, 0, 0],
    [0, 0, 0, 1, 0, 0],
    [0, 0, 0, -1, 0, 0],
    [0, 0, 0, 0, 1, 0],
    [0, 0, 0, 0, -1, 0],
    [0, 0, 0, 0, 0, 1],
]
_ACTION_SET = {'name': 'dmlab_like', 'version': 1}


class _Always(policies.Policy):
  """A policy of one action; records its inputs."""

  def __init__(
      self, index: int, action_set: action_sets.ActionSet | None = None
  ) -> None:
    self._index = index
    self._action_set = action_set or action_sets.DMLAB_LIKE
    self.told: list[tuple[Any, bool, tuple[int, ...], Any]] = []

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._action_set

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    assert batch_shape == ()
    return 0

  def step(
      self,
      observation: policies.base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    assert key.shape == (2,)
    assert key.dtype == np.uint64
    assert episode_start.shape == ()
    self.told.append((observation, bool(episode_start), tuple(key), state))
    return np.asarray(self._index), state + 1


def _query(place: Any, high: float = 13) -> dict[str, Any]:
  return {'kind': 'two_block', 'role': 'query', 'place': place,
          'range': [0, high]}  # fmt: skip


def _design(
    query_policy: Any = None,
    action_set: Any = _ACTION_SET,
    queries: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
  design = {
      'schema': 1,
      'name': 'asking',
      'action_set': action_set,
      'registers': {'query': _query('station_2')}
      if queries is None
      else queries,
  }
  if query_policy is not None:
    design['learner'] = {'kind': 'any', 'query_policy': query_policy}
  return design


def _load(design: Any, seed: int = 7) -> environment.Environment:
  return kept.load(
      (design, seed),
      lambda: suite.load(
          'collect_apples', 'standard', {'random': seed}, design=design
      ),
  )


@pytest.fixture(scope='module')
def continuous() -> Iterator[environment.Environment]:
  env = _load('none')
  yield env
  env.close()


@pytest.fixture(scope='module')
def taken() -> Iterator[environment.Environment]:
  env = _load(_design(actors.TAKEN_ACTION))
  yield env
  env.close()


@pytest.fixture(scope='module')
def independent() -> Iterator[environment.Environment]:
  env = _load(_design(actors.INDEPENDENT_ACTION))
  yield env
  env.close()


_SEEN = dm_env.restart({'senses/any': np.zeros(1)})


def _actions(
    policy: Any, env: environment.Environment, number: int = 1, episode: int = 0
) -> list[Any]:
  actor = actors.make(policy, env)
  actor.begin(episode)
  return [actor.act(_SEEN) for _ in range(number)]


def test_an_index_becomes_the_vector_of_its_action(continuous):
  assert continuous.action_spec().name == '\t'.join(_ELEMENTS)
  for index, vector in enumerate(_VECTORS):
    [action] = _actions(_Always(index), continuous)
    continuous.action_spec().validate(action)
    assert action.tolist() == vector


def test_an_index_outside_a_query_register_is_not_written():
  queries = {
      'small': _query('station_2', high=3),
      'large': _query('station_3'),
      'positive': _query('station_4') | {'range': [4.5, 9], 'initial': 5},
  }
  env = _load(_design(actors.TAKEN_ACTION, queries=queries))
  for index, expected in (
      (0, [0, 0, 4.5]),
      (3, [0, 3, 4.5]),
      (7, [0, 7, 4.5]),
      (13, [0, 13, 4.5]),
  ):
    [action] = _actions(_Always(index), env)
    env.action_spec().validate(action)
    assert action.tolist() == [*expected, index]
  env.close()


@pytest.mark.parametrize('query_policy', [actors.TAKEN_ACTION, None])
def test_the_default_query_is_the_action_taken(query_policy):
  env = _load(_design(query_policy))
  actions = np.array(_actions(policies.make('random'), env, 60))
  assert (actions[:, 0] == actions[:, 1]).all()
  assert len(set(actions[:, 1])) > 10
  env.close()


def test_an_independent_query_carries_no_information_on_the_action(independent):
  actions = np.array(_actions(policies.make('random'), independent, 7_000))
  asked, done = actions.T
  pairs = Counter(zip(asked, done, strict=True))
  # Every pair of 14 by 14 is as likely as any other: 35.7 of each are expected.
  expected = len(actions) / _NUM_ACTIONS**2
  pairs_of_all = [
      pairs[i, j] for i in range(_NUM_ACTIONS) for j in range(_NUM_ACTIONS)
  ]
  chi_squared = sum((n - expected) ** 2 / expected for n in pairs_of_all)
  assert sum(pairs_of_all) == len(actions)
  assert chi_squared < 275  # 195 degrees of freedom; p = 0.0001.
  assert abs(np.corrcoef(asked, done)[0, 1]) < 0.05


def test_an_unknown_query_policy_is_refused():
  query_policy = ['taken_action']
  env = _load(_design(query_policy))
  with pytest.raises(errors.SpecError) as raised:
    actors.make(_Always(0), env)
  message = str(raised.value)
  assert message == (
      f"design 'asking': learner.query_policy: {query_policy!r}; must be"
      " one of ['taken_action', 'independent_action']"
  )
  env.close()


def test_a_policy_with_an_action_that_the_design_lacks_is_refused(taken):
  own = action_sets.DMLAB_LIKE.actions
  other = action_sets.ActionSet('crawl', 2, (*own, ('creep', {'forward': 0.5})))
  with pytest.raises(errors.SpecError) as raised:
    actors.make(_Always(0, other), taken)
  assert str(raised.value) == (
      "action set dmlab_like v1 lacks actions of crawl v2: ['creep']"
  )


def test_a_policy_with_another_action_set_takes_the_same_actions(taken):
  own = action_sets.DMLAB_LIKE.actions
  other = action_sets.ActionSet(
      'crawl',
      1,
      tuple((f'to_{name}', settings) for name, settings in own[::-1]),
  )
  for index in (0, 3, len(own) - 1):
    query, action = actors.make(_Always(index, other), taken).act(
        dm_env.restart({})
    )
    assert query == action == len(own) - 1 - index


def test_a_policy_is_notified_of_the_start_of_an_episode(continuous):
  policy = _Always(0)
  actor = actors.make(policy, continuous)
  for episode, number in ((4, 3), (5, 2), (4, 2)):
    actor.begin(episode)
    for _ in range(number):
      actor.act(_SEEN)
  assert [starts for _, starts, _, _ in policy.told] == [
      True, False, False, True, False, True, False,
  ]  # fmt: skip
  # Its memory begins anew as well.
  assert [state for *_, state in policy.told] == [0, 1, 2, 0, 1, 0, 1]
  # Keys follow from the numbers of the episode and of the step.
  keys = [key for _, _, key, _ in policy.told]
  assert keys[5:] == keys[:2]
  assert len(set(keys)) == 5
  assert all(seen is _SEEN.observation for seen, *_ in policy.told)
