"""Tests for the environment: bad input, broken physics, failed resets, ends."""

import ast
import copy
import inspect
import pickle
import random
from typing import Any

from dm_control import composer
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import jumping_ball
import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from tests import worlds
from tests.engine import helpers

_NAN, _INF = float('nan'), float('inf')
_DESIGN = {
    'schema': 1,
    'name': 'd',
    'registers': {
        'reward': {
            'kind': 'two_block',
            'role': 'feedback',
            'place': [2, 2],
            'range': [-2, 12],
        },
        'score': {
            'kind': 'two_block',
            'role': 'meter',
            'place': [2, -3],
            'range': [-20, 20],
            'scale': 0.05,
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
}
_QUERY = {
    'kind': 'two_block',
    'role': 'query',
    'place': [-3, -3],
    'range': [0, 13],
}
_WITH_QUERY = {
    **_DESIGN,
    'registers': {**_DESIGN['registers'], 'query': _QUERY},
}
_ACTION_SET = {'name': 'dmlab_like', 'version': 1}


def _load(
    design: Any = _DESIGN, seed: int = 7, max_steps: int = 40, **kwargs: Any
) -> environment.Environment:
  return suite.load(
      'collect_apples',
      'standard',
      {'random': seed},
      {'max_steps': max_steps},
      design=design,
      **kwargs,
  )


def _embed(
    task: composer.Task, design: Any = 'none', **kwargs: Any
) -> tuple[environment.Environment, helpers.RecordingSink]:
  env = suite.embed(task, design, random=7, **kwargs)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  return env, sink


# Actions.


def _with(index: int, value: float) -> np.ndarray:
  action = np.zeros(6)
  action[index] = value
  return action


_BAD_ACTIONS: dict[str, tuple[Any, str]] = {
    'nan': (_with(0, _NAN), 'action[0] (forward) is nan'),
    'all nan': (np.full(6, _NAN), 'action[0] (forward) is nan'),
    'inf': (_with(2, _INF), 'action[2] (turn) = inf outside [-1, 1]'),
    '-inf': (_with(5, -_INF), 'action[5] (throw) = -inf outside [-1, 1]'),
    '5.0': (_with(1, 5.0), 'action[1] (strafe) = 5.0 outside [-1, 1]'),
    'barely': (_with(1, np.nextafter(1, 2)), 'action[1] (strafe) = 1.0000'),
    '1e12': (_with(4, 1e12), 'action[4] (grasp) ='),
    'int': (_with(4, -2).astype(int), 'action[4] (grasp) = -2.0 outside'),
    'unsigned': (np.full(6, 200, np.uint8), 'action[0] (forward) = 200.0'),
    'float16': (_with(3, _INF).astype(np.float16), 'action[3] (look) = inf'),
    'scalar': (0.5, 'shape (), expected (6,)'),
    'shape (1,)': (np.zeros(1), 'shape (1,), expected (6,)'),
    'shape (1, 6)': (np.zeros((1, 6)), 'shape (1, 6), expected (6,)'),
    'shape (6, 1)': (np.zeros((6, 1)), 'shape (6, 1), expected (6,)'),
    'shape (7,)': (np.zeros(7), 'shape (7,), expected (6,)'),
    'empty': (np.zeros(0), 'shape (0,), expected (6,)'),
    'empty list': ([], 'shape (0,), expected (6,)'),
    'bool': (np.zeros(6, bool), 'dtype bool'),
    'bools': (np.zeros((6, 6), bool), 'dtype bool'),
    'True': (True, 'dtype bool'),
    'None': (None, 'dtype object'),
    'Nones': ([None] * 6, 'dtype object'),
    'str': ('forward', 'dtype <U7'),
    'numbers as text': (['0'] * 6, 'dtype <U1'),
    'bytes': (b'000000', 'dtype |S6'),
    'object': (object(), 'dtype object'),
    'array of objects': (np.zeros(6, object), 'dtype object'),
    'complex': (np.zeros(6, complex), 'dtype complex128'),
    'dict': ({'forward': 1.0}, 'dtype object'),
    'date': (np.zeros(6, 'datetime64[s]'), 'dtype datetime64[s]'),
    'record': (np.zeros(6, [('a', float)]), 'action: dtype'),
    'ragged': ([[1.0], [1.0, 2.0]], 'action: '),
    'huge integers': ([10**400] * 6, 'dtype object'),
    'generator': ((0.0 for _ in range(6)), 'dtype object'),
}


@pytest.fixture(scope='module')
def running() -> Any:
  """One environment in the middle of an episode, for all bad actions."""
  env = _load(max_steps=10_000)
  env.reset()
  for action in helpers.random_actions(env, 3):
    env.step(action)
  yield env
  env.close()


@pytest.mark.parametrize(
    ('action', 'message'), _BAD_ACTIONS.values(), ids=_BAD_ACTIONS
)
def test_a_bad_action_is_refused_and_nothing_moves(
    running: environment.Environment, action: Any, message: str
):
  before = worlds.state_bytes(running.physics)
  with pytest.raises(errors.ActionError) as caught:
    running.step(action)
  assert worlds.state_bytes(running.physics) == before
  assert message in str(caught.value)
  assert '\n' not in str(caught.value)
  assert running.step(helpers.no_op(running)).mid()


class _Hostile:
  """Raises whatever a library could raise."""

  def __init__(self, error: type[Exception]) -> None:
    self._error = error

  def __array__(self, *args: Any, **kwargs: Any) -> Any:
    raise self._error('no')

  def __repr__(self) -> str:
    return 'two\nlines'


@pytest.mark.parametrize('error', [TypeError, ValueError, RuntimeError])
def test_an_object_that_cannot_be_made_an_array_is_an_action_error(
    running: environment.Environment, error: type[Exception]
):
  with pytest.raises(errors.ActionError) as caught:
    running.step(_Hostile(error))
  assert '\n' not in str(caught.value)


@hypothesis.settings(max_examples=300)
@hypothesis.given(
    action=st.one_of(
        st.lists(st.floats() | st.integers(), min_size=5, max_size=7),
        st.recursive(
            st.none() | st.booleans() | st.text() | st.binary() | st.floats(),
            lambda inner: st.lists(inner, max_size=3),
            max_leaves=6,
        ),
    )
)
def test_whatever_is_sent_is_taken_or_refused_without_a_trace(
    running: environment.Environment, action: Any
):
  before = worlds.state_bytes(running.physics)
  try:
    time_step = running.step(action)
  except errors.ActionError:
    assert worlds.state_bytes(running.physics) == before
  else:
    running.action_spec().validate(np.array(action, float))
    assert time_step.mid()


def test_hostile_actions_among_good_ones_change_nothing():
  env, clean = _load(), _load()
  bad = [action for action, _ in _BAD_ACTIONS.values()]
  good = helpers.random_actions(clean, 60)
  generator = random.Random(3)
  for action in good:
    for _ in range(3):
      with pytest.raises(errors.ActionError):
        env.step(generator.choice(bad))
    expected = helpers.to_bytes(clean.step(action))
    assert helpers.to_bytes(env.step(action)) == expected
  env.close()
  clean.close()


@pytest.mark.parametrize('dtype', [np.float16, np.float32, np.int8, np.uint64])
def test_numbers_of_another_type_are_cast(dtype: Any):
  env, twin = _load(), _load()
  env.reset()
  twin.reset()
  action = np.array([1, 0, 1, 0, 0, 0])
  expected = helpers.to_bytes(twin.step(action.astype(float)))
  assert helpers.to_bytes(env.step(action.astype(dtype))) == expected
  assert helpers.to_bytes(env.step(action.tolist())) == (
      helpers.to_bytes(twin.step(action.astype(float)))
  )
  env.close()
  twin.close()


def test_an_action_is_not_kept_or_changed():
  env, twin = _load(), _load()
  env.reset()
  twin.reset()
  action = np.array([0.5, 0, 0.3, 0, 0, 0])
  first = env.step(action)
  np.testing.assert_array_equal(action, [0.5, 0, 0.3, 0, 0, 0])
  assert helpers.to_bytes(first) == helpers.to_bytes(twin.step(action.copy()))
  action[:] = _NAN  # Whoever sent it may write to it.
  second = env.step(np.zeros(6))
  assert helpers.to_bytes(second) == helpers.to_bytes(twin.step(np.zeros(6)))
  env.close()
  twin.close()


@pytest.mark.parametrize(
    ('action', 'message'),
    [
        (14, 'action (dmlab_like/v1) = 14.0 outside [0, 13]'),
        (-1, 'action (dmlab_like/v1) = -1.0 outside [0, 13]'),
        (1.0, 'dtype float64'),
        (_NAN, 'dtype float64'),
        (True, 'dtype bool'),
        ([1], 'shape (1,), expected ()'),
        (None, 'dtype object'),
        ('forward', 'dtype <U7'),
    ],
)
def test_a_bad_index_is_refused(action: Any, message: str):
  env = _load({**_DESIGN, 'action_set': _ACTION_SET})
  env.reset()
  before = worlds.state_bytes(env.physics)
  with pytest.raises(errors.ActionError) as caught:
    env.step(action)
  assert message in str(caught.value)
  assert worlds.state_bytes(env.physics) == before
  for index in (0, np.int64(13), np.uint8(5), np.array(3)):
    assert env.step(index).mid()
  env.close()


@pytest.mark.parametrize(
    ('action', 'message'),
    [
        ([14.0, 0], 'action[0] (query/query) = 14.0 outside [0, 13]'),
        ([_NAN, 0], 'action[0] (query/query) is nan'),
        ([3.0, 14], 'action[1] (dmlab_like/v1) = 14.0 outside [0, 13]'),
        ([3.0, _NAN], 'action[1] (dmlab_like/v1) is nan'),
        ([3.0], 'shape (1,), expected (2,)'),
    ],
)
def test_a_bad_query_or_index_beside_it_is_refused(action: Any, message: str):
  env = _load({**_WITH_QUERY, 'action_set': _ACTION_SET})
  env.reset()
  before = worlds.state_bytes(env.physics)
  with pytest.raises(errors.ActionError) as caught:
    env.step(action)
  assert message in str(caught.value)
  assert worlds.state_bytes(env.physics) == before
  # No provider takes this query for an index, so it is a number like any other.
  assert env.action_spec().dtype == np.float64
  assert env.step([3.5, 13]).mid()
  env.close()


def test_an_index_does_what_its_row_of_the_action_set_says():
  env = _load({**_DESIGN, 'action_set': _ACTION_SET})
  twin = _load()
  env.reset()
  twin.reset()
  for index, controls in ((1, [1, 0, 0]), (8, [1, 0, -1]), (0, [0, 0, 0])):
    found = helpers.to_bytes(env.step(index))
    assert found == helpers.to_bytes(twin.step([*controls, 0, 0, 0]))
  env.close()
  twin.close()


# The beginning and the end of an episode.


def test_a_step_without_an_episode_begins_one():
  env = _load(max_steps=3)
  for _ in range(2):
    types = [env.step(helpers.no_op(env)).step_type for _ in range(4)]
    assert [int(step_type) for step_type in types] == [0, 1, 1, 2]
  env.close()


def test_the_action_of_a_first_step_is_ignored_but_not_unchecked():
  env, twin = _load(max_steps=2), _load(max_steps=2)
  for _ in range(2):  # On a fresh environment, and after LAST.
    with pytest.raises(errors.ActionError):
      env.step(np.full(6, _NAN))
    first = env.step(np.ones(6))
    assert first.first()
    assert helpers.to_bytes(first) == helpers.to_bytes(twin.reset())
    for _ in range(2):
      time_step = env.step(helpers.no_op(env))
      twin.step(helpers.no_op(env))
    assert time_step.last()
  env.close()
  twin.close()


def test_the_last_step_is_where_the_time_is_up():
  env = _load(max_steps=5)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  for step in range(1, 6):
    time_step = env.step(helpers.no_op(env))
    assert time_step.last() == (step == 5)
    assert time_step.discount == 1.0
  assert time_step.observation['senses/time_left'] == 0.0
  assert sink.ends == [events.End.TIMEOUT]
  env.close()
  assert sink.ends == [events.End.TIMEOUT]


def test_taking_the_large_apple_ends_the_episode_with_discount_0():
  env = suite.load('unlock_door', 'standard', {'random': 1})
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.task.avatar.place(env.physics, env.task.landmarks['side_room'], 0.0)
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert (time_step.reward, time_step.discount) == (0.0, 0.0)
  assert type(time_step.discount) is float
  assert sink.ends == [events.End.TERMINATED]
  assert sink.true_return() == 10.0
  assert env.step(helpers.no_op(env)).first()
  env.close()


def test_a_sink_hears_of_every_episode_and_why_it_ended():
  env = _load(max_steps=2)
  sink = helpers.RecordingSink()
  env.step(helpers.no_op(env))
  env.add_sink(sink)  # In the middle of an episode, which it does not hear of.
  for _ in range(4):
    env.step(helpers.no_op(env))
  env.reset()
  env.close()
  kinds = [
      heard.value if isinstance(heard, events.End) else type(heard).__name__
      for heard in sink.heard
  ]
  assert kinds == [
      *('Start', 'Step', 'Step', 'timeout'),
      *('Start', 'abandoned'),
      *('Start', 'abandoned'),
  ]
  assert [start.episode for start in sink.starts] == [1, 2, 3]
  assert {(start.seed, start.world) for start in sink.starts} == {(7, 0)}


def test_a_sink_that_was_removed_hears_nothing_more():
  env = _load(max_steps=2)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.remove_sink(sink)
  env.step(helpers.no_op(env))
  env.reset()
  env.close()
  assert len(sink.heard) == 1


def test_a_sink_changes_nothing_for_the_agent():
  env, twin = _load(max_steps=10), _load(max_steps=10)
  env.add_sink(helpers.RecordingSink())
  for action in helpers.random_actions(env, 25):
    expected = helpers.to_bytes(twin.step(action))
    assert helpers.to_bytes(env.step(action)) == expected
  env.close()
  twin.close()


# Broken physics.


def _break_now(env: environment.Environment, how: str) -> None:
  """Breaks the first degree of freedom, which is the avatar's or the bead's."""
  data = env.physics.data
  if how == 'qvel':
    data.qvel[0] = _NAN
  elif how == 'qpos':
    data.qpos[0] = _INF
  elif how == 'far':
    data.qpos[0] = 1e11
  else:
    data.qfrc_applied[0] = 1e30


def _assert_recovers(
    env: environment.Environment, clean: environment.Environment
) -> None:
  """After a broken episode, the next one is that of a clean environment."""
  actions = helpers.random_actions(env, 10, seed=4)
  for i, action in enumerate(actions):
    found = env.step(action)
    assert found.first() == (i == 0)
    expected = clean.reset() if i == 0 else clean.step(action)
    assert helpers.to_bytes(found) == helpers.to_bytes(expected)


@pytest.mark.parametrize('how', ['qvel', 'qpos', 'far', 'acceleration'])
@pytest.mark.parametrize('before', [0, 1, 7])
@pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')
def test_physics_that_fail_end_the_episode_and_nothing_else(
    how: str, before: int
):
  env, clean = _load(), _load()
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  last = env.reset()
  for action in helpers.random_actions(env, before):
    last = env.step(action)
  _break_now(env, how)
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert (time_step.reward, time_step.discount) == (0.0, 1.0)
  assert type(time_step.discount) is float
  for key, value in time_step.observation.items():
    assert value.tobytes() == last.observation[key].tobytes()
    assert not np.shares_memory(value, last.observation[key])
  assert sink.ends == [events.End.DIVERGENCE]
  assert len(sink.steps) == before
  clean.reset()
  _assert_recovers(env, clean)
  env.close()
  clean.close()


@pytest.mark.parametrize('phase', [1, 2, 3])
@pytest.mark.parametrize('how', ['qvel', 'qpos', 'far'])
@pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')
def test_physics_that_fail_within_a_step_are_noticed_in_that_step(
    phase: int, how: str
):
  env, clean = _load(), _load()
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  last = env.step(helpers.no_op(env))
  latch, latched = env.task.latch_events, []

  def break_down(physics: Any) -> None:
    latch(physics)
    latched.append(None)
    # It latches before the meters, before the providers and at the end.
    if len(latched) == phase:
      _break_now(env, how)

  env.task.latch_events = break_down
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert time_step.discount == 1.0
  for key, value in time_step.observation.items():
    assert value.tobytes() == last.observation[key].tobytes()
  assert sink.ends == [events.End.DIVERGENCE]
  assert len(sink.steps) == 1
  env.task.latch_events = latch
  clean.reset()
  _assert_recovers(env, clean)
  env.close()
  clean.close()


@pytest.mark.parametrize('how', ['qvel', 'qpos', 'acceleration'])
@pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')
def test_the_physics_of_somebody_elses_task_may_fail_too(how: str):
  env, sink = _embed(helpers.PointTask(), _DESIGN)
  env.reset()
  env.step(np.zeros(1))
  _break_now(env, how)
  time_step = env.step(np.zeros(1))
  assert time_step.last()
  assert time_step.discount == 1.0
  assert sink.ends == [events.End.DIVERGENCE]
  assert env.step(np.zeros(1)).first()
  assert env.step(np.zeros(1)).mid()
  env.close()


# Failed resets and other errors.


def _failing(
    task: helpers.PointTask, *failing: int
) -> list[composer.Environment]:
  """Makes the attempts with these numbers fail; returns the list of all."""
  attempts: list[Any] = []

  def begin(physics: Any, random_state: Any) -> None:
    del physics
    attempts.append(random_state.uniform())
    if len(attempts) in failing:
      raise composer.EpisodeInitializationError('no room')

  task.begin = begin
  return attempts


def test_a_reset_is_tried_again_with_other_numbers():
  task = helpers.PointTask()
  attempts = _failing(task, 1, 2, 3)
  env, sink = _embed(task)
  assert env.reset().first()
  assert len(set(attempts)) == 4
  assert [start.episode for start in sink.starts] == [0]
  env.close()


@pytest.mark.parametrize('by_step', [False, True])
def test_a_reset_that_keeps_failing_raises_and_the_next_step_is_a_first(
    by_step: bool,
):
  task = helpers.PointTask()
  attempts = _failing(task, *range(1, 11), *range(12, 22))
  env, sink = _embed(task, max_steps=2)
  begin = (lambda: env.step(np.zeros(1))) if by_step else env.reset
  with pytest.raises(composer.EpisodeInitializationError):
    begin()
  assert len(attempts) == 10
  assert not sink.heard
  assert env.step(np.zeros(1)).first()
  assert env.step(np.zeros(1)).mid()
  assert env.step(np.zeros(1)).last()
  # The same in the step after LAST.
  with pytest.raises(composer.EpisodeInitializationError):
    begin()
  assert len(attempts) == 21
  assert env.step(np.zeros(1)).first()
  assert env.step(np.zeros(1)).mid()
  env.close()
  assert [start.episode for start in sink.starts] == [1, 3]


def test_what_a_failed_reset_left_behind_does_not_reach_the_next_episode():
  task = helpers.PointTask()
  _failing(task, *range(1, 11))
  env, _ = _embed(task)
  with pytest.raises(composer.EpisodeInitializationError):
    env.reset()
  twin, _ = _embed(helpers.PointTask())
  twin.rewind(1)
  assert helpers.to_bytes(env.step([0.0])) == helpers.to_bytes(twin.reset())
  env.close()
  twin.close()


def _fail(physics: Any, random_state: Any) -> None:
  del physics, random_state
  raise ZeroDivisionError('oops')


def test_a_hook_that_raises_in_a_step_poisons_the_environment():
  task = helpers.PointTask()
  env, sink = _embed(task)
  env.reset()
  task.end_step, works = _fail, task.end_step
  with pytest.raises(ZeroDivisionError):
    env.step(np.zeros(1))
  task.end_step = works
  assert env.step(np.zeros(1)).first()
  assert env.step(np.zeros(1)).mid()
  env.close()
  assert sink.ends == [events.End.ERROR, events.End.ABANDONED]


def test_a_hook_that_raises_in_a_reset_poisons_the_environment():
  task = helpers.PointTask()
  env, sink = _embed(task)
  env.reset()
  task.begin, works = _fail, task.begin
  for _ in range(2):
    with pytest.raises(ZeroDivisionError):
      env.reset()
  task.begin = works
  assert env.step(np.zeros(1)).first()
  assert env.step(np.zeros(1)).mid()
  env.close()
  assert sink.ends == [events.End.ABANDONED] * 2


def test_a_provider_that_fails_poisons_the_environment():
  env, clean = _load(), _load()
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.step(helpers.no_op(env))
  env._provider_states = ['not a number']
  with pytest.raises(errors.FeedbackProviderError, match=r'providers\[0\]:dif'):
    env.step(helpers.no_op(env))
  assert sink.ends == [events.End.ERROR]
  assert len(sink.steps) == 1
  clean.reset()
  _assert_recovers(env, clean)
  env.close()
  clean.close()


# What an environment refuses.


def test_closing_twice_does_nothing_and_a_closed_environment_does_nothing():
  env = _load()
  env.reset()
  action = helpers.no_op(env)
  env.close()
  env.close()
  for use in (
      env.reset,
      env.action_spec,
      env.observation_spec,
      env.reward_spec,
      env.discount_spec,
      lambda: env.step(action),
      lambda: env.step(None),
      env.rewind,
      lambda: env.add_sink(helpers.RecordingSink()),
  ):
    with pytest.raises(errors.ClosedError):
      use()


def test_an_environment_that_was_never_used_can_be_closed():
  env = _load()
  env.close()
  with pytest.raises(errors.ClosedError):
    env.reset()


@pytest.mark.parametrize(
    'copying',
    [pickle.dumps, copy.deepcopy, copy.copy],
    ids=lambda f: f.__name__,
)
def test_an_environment_cannot_be_copied(copying: Any):
  env = _load()
  with pytest.raises(TypeError, match='environments cannot be pickled'):
    copying(env)
  env.close()


# Independence.


def test_environments_do_not_know_of_each_other():
  alone = []
  for seed in (1, 2):
    env = _load(seed=seed, max_steps=7)
    actions = helpers.random_actions(env, 30, seed)
    alone.append([helpers.to_bytes(env.step(action)) for action in actions])
    env.close()
  envs = [_load(seed=seed, max_steps=7) for seed in (1, 2)]
  actions = [helpers.random_actions(envs[i], 30, i + 1) for i in range(2)]
  turns = [0] * 30 + [1] * 30
  random.Random(5).shuffle(turns)
  together: list[list[bytes]] = [[], []]
  for i in turns:
    time_step = envs[i].step(actions[i][len(together[i])])
    together[i].append(helpers.to_bytes(time_step))
  for env in envs:
    env.close()
  assert together == alone


def _global_state() -> tuple[Any, ...]:
  legacy = np.random.get_state()  # noqa: NPY002 - nobody is to change it.
  return legacy[1].tobytes(), legacy[2:], random.getstate()


def test_nobody_draws_from_the_global_generators():
  before = _global_state()
  env = _load(max_steps=5)
  for action in helpers.random_actions(env, 14):
    env.step(action)
  env.close()
  assert _global_state() == before


def test_an_episode_does_not_depend_on_how_long_the_one_before_was():
  env, twin = _load(), _load()
  env.reset()
  for action in helpers.random_actions(env, 17):
    env.step(action)
  twin.reset()
  assert helpers.to_bytes(env.reset()) == helpers.to_bytes(twin.reset())
  env.close()
  twin.close()


def test_an_episode_does_not_depend_on_how_many_numbers_were_drawn():
  task = helpers.PointTask()
  task.end_step = lambda physics, random_state: random_state.uniform(size=5)
  env, _ = _embed(task)
  twin, _ = _embed(helpers.PointTask())
  for one in (env, twin):
    one.reset()
    one.step([0.5])
  assert helpers.to_bytes(env.reset()) == helpers.to_bytes(twin.reset())
  env.close()
  twin.close()


def test_the_observation_is_the_agents_to_write_to():
  env, twin = _load(), _load()
  env.reset()
  twin.reset()
  for action in helpers.random_actions(env, 10):
    time_step = env.step(action)
    expected = helpers.to_bytes(twin.step(action))
    assert helpers.to_bytes(time_step) == expected
    for value in time_step.observation.values():
      value[...] = 1
  env.close()
  twin.close()


def test_a_spec_is_the_agents_to_change():
  env = _load()
  env.observation_spec().clear()
  assert 'registers/reward' in env.observation_spec()
  env.close()


def test_rewinding_makes_an_episode_the_next_one():
  env = _load(max_steps=3)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  actions = helpers.random_actions(env, 12)
  played = [helpers.to_bytes(env.step(action)) for action in actions]
  env.rewind()
  assert [helpers.to_bytes(env.step(action)) for action in actions] == played
  env.rewind(1)
  again = [helpers.to_bytes(env.step(action)) for action in actions[4:]]
  assert again == played[4:]
  env.step(actions[0])
  env.rewind(2)
  assert sink.ends[-1] is events.End.ABANDONED
  again = [helpers.to_bytes(env.step(action)) for action in actions[8:]]
  assert again == played[8:]
  env.close()
  episodes = [start.episode for start in sink.starts]
  assert episodes == [0, 1, 2, 0, 1, 2, 1, 2, 3, 2]


# Somebody else's task.


def _go_to_target() -> composer.Task:
  return go_to_target.GoToTarget(
      jumping_ball.RollingBallWithHead(),
      floors.Floor(size=(8.0, 8.0)),
      walker_spawn_position=(0.0, 0.0),
      target_spawn_position=(0.3, 0.0),
  )


def test_a_task_of_dm_controls_gets_feedback_and_hides_its_reward():
  stock = composer.Environment(_go_to_target(), random_state=0)
  expected = set(stock.observation_spec())
  control_spec = stock.action_spec()
  stock.close()
  env, sink = _embed(_go_to_target(), _DESIGN, max_steps=8)
  assert set(env.observation_spec()) == {
      *(f'senses/{name}' for name in expected),
      'senses/time_left',
      'registers/reward',
  }
  assert env.action_spec().shape == control_spec.shape
  assert env.action_spec().name == control_spec.name
  keys = list(env.observation_spec())
  time_steps = [env.reset()]
  for _ in range(8):
    action = np.zeros(control_spec.shape)
    time_steps.append(env.step(action))
  env.close()
  assert time_steps[-1].last()
  for time_step in time_steps:
    assert list(time_step.observation) == keys
    for value in time_step.observation.values():
      assert value.base is None
      assert np.isfinite(value).all()
  assert {step.reward for step in time_steps[1:]} == {0.0}
  # It stands on its target from the start, and earns 1 in every step.
  assert [float(step.true_reward) for step in sink.steps] == [1.0] * 8
  # The mechanism keeps the score, up to the step before.
  measured = [
      float(w.requested) for w in sink.records(registers.Write, 'score')
  ]
  assert measured == [float(i) for i in range(8)]
  observed = [float(s.observation['registers/reward']) for s in time_steps]
  np.testing.assert_allclose(observed, [0, 0] + [1] * 7, atol=1e-6)


def test_an_embedded_task_may_offer_measurements():
  task = helpers.PointTask()
  design = copy.deepcopy(_DESIGN)
  design['meters'][0]['measures'] = 'time'
  env, sink = _embed(
      task, design, measurements={'time': lambda physics: physics.time()}
  )
  env.reset()
  env.step([0.0])
  env.close()
  (written,) = sink.records(registers.Write, 'score')
  # After a third of the five substeps of 10 ms.
  np.testing.assert_allclose(written.requested, 0.01)


def test_hooks_of_an_embedded_task_run_as_in_composer():
  heard: list[str] = []

  class Hooked(helpers.PointTask):

    def initialize_episode_mjcf(self, random_state: Any) -> None:
      heard.append('initialize_episode_mjcf')

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
      super().initialize_episode(physics, random_state)
      heard.append('initialize_episode')

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
      super().before_step(physics, action, random_state)
      heard.append('before_step')

    def before_substep(
        self, physics: Any, action: Any, random_state: Any
    ) -> None:
      np.testing.assert_array_equal(action, [0.5])
      heard.append('before_substep')

    def after_substep(self, physics: Any, random_state: Any) -> None:
      heard.append('after_substep')

    def after_step(self, physics: Any, random_state: Any) -> None:
      heard.append('after_step')

    def after_compile(self, physics: Any, random_state: Any) -> None:
      heard.append('after_compile')

  def play(make: Any) -> list[str]:
    env = make(Hooked())
    heard.clear()
    for _ in range(2):
      env.reset()
      env.step(np.array([0.5]))
      env.step(np.array([0.5]))
    env.close()
    return list(heard)

  expected = play(lambda task: composer.Environment(task, random_state=1))
  assert expected.count('before_substep') == 20
  assert play(lambda task: _embed(task, _DESIGN)[0]) == expected


def test_an_embedded_task_moves_as_it_would_without_feedback():
  # Composer steps from the middle of MuJoCo's step; the bead does not mind.
  stock = composer.Environment(
      helpers.PointTask(), random_state=0, legacy_step=False
  )
  env, _ = _embed(helpers.PointTask())
  stock.reset()
  env.reset()
  start = env.physics.data.qpos.copy()
  with stock.physics.reset_context():
    stock.physics.data.qpos[:] = start
  for action in ([1.0], [0.3], [-1.0], [0.0]):
    stock.step(np.array(action))
    env.step(action)
    np.testing.assert_allclose(
        env.physics.data.qpos, stock.physics.data.qpos, atol=1e-12
    )
  assert not np.allclose(env.physics.data.qpos, start)
  stock.close()
  env.close()


def test_a_sense_that_is_called_like_one_of_ours_is_refused():
  class Clashing(helpers.PointTask):

    @property
    def task_observables(self) -> Any:
      return {'time_left': self.bead}

  with pytest.raises(errors.RealabError, match='time_left'):
    _embed(Clashing(), max_steps=5)
  env, _ = _embed(Clashing(), max_steps=None)  # Nothing clashes.
  env.close()


# What this package takes from the inside of dm_control.

# The private names of dm_control 1.0.50's composer.Environment that
# engine/environment.py uses. If this fails after an upgrade, read the new
# composer/environment.py before changing the list.
_PRIVATE_OF_DM_CONTROL_1_0_50 = {
    '_hooks',
    '_n_sub_steps',
    '_observation_updater',
    '_physics',
    '_physics_proxy',
    '_random_state',
    '_recompile_mjcf_every_episode',
    '_recompile_physics',
    '_recompile_physics_and_update_observables',
    '_reset_next_step',
    '_task',
}


def test_dm_control_still_has_the_private_parts_of_1_0_50_that_are_used():
  stock = composer.Environment(helpers.PointTask(), random_state=0)
  missing = {
      name for name in _PRIVATE_OF_DM_CONTROL_1_0_50 if not hasattr(stock, name)
  }
  stock.close()
  assert not missing


def test_no_other_private_parts_of_dm_control_are_used():
  ours = environment.Environment
  tree = ast.parse(inspect.getsource(ours))
  used, assigned = set(), set()
  for node in ast.walk(tree):
    if isinstance(node, ast.Attribute) and (
        isinstance(node.value, ast.Name) and node.value.id == 'self'
    ):
      used.add(node.attr)
      if isinstance(node.ctx, ast.Store):
        assigned.add(node.attr)
  used |= set(vars(ours))
  private = {n for n in used if n.startswith('_') and not n.startswith('__')}
  stock = composer.Environment(helpers.PointTask(), random_state=0)
  inherited = {name for name in private if hasattr(stock, name)}
  stock.close()
  # Names that every class has, such as those of `abc`.
  inherited -= {name for name in private if name.startswith('_abc')}
  assert inherited == _PRIVATE_OF_DM_CONTROL_1_0_50
  assert private - set(vars(ours)) - assigned <= _PRIVATE_OF_DM_CONTROL_1_0_50


def test_a_sink_that_fails_at_the_beginning_of_an_episode_leaves_none():
  class Failing:
    """Fails at the second beginning."""

    def __init__(self):
      self.count = 0

    def episode_started(self, start, physics):
      self.count += 1
      if self.count == 2:
        raise OSError('no room for a film')

    def step_ended(self, step, physics):
      """Films."""

    def episode_ended(self, end):
      """Closes the film."""

  env = suite.load(
      'collect_apples', 'near', {'random': 0}, {'max_steps': 3},
      design='instantaneous_reward',
  )  # fmt: skip
  ledger = ledgers.Ledger()
  env.add_sink(Failing())
  env.add_sink(ledger)
  action = helpers.no_op(env)
  env.reset()
  for _ in range(3):
    env.step(action)
  rewards = list(ledger.last.true_rewards)
  with pytest.raises(OSError, match='no room'):
    env.reset()
  assert env.step(action).first()
  assert [e.end for e in ledger.episodes] == [events.End.TIMEOUT, None]
  assert ledger.episodes[0].true_rewards == rewards
  env.close()
