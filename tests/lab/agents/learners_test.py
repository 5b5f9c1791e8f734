"""Tests of learners: they learn toys, resume from a state, refuse bad specs."""

from typing import Any

from dm_env import specs as dm_env_specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from tests.lab.agents import toys

# Small and quick, the same for all, so that little has to be compiled.
_QUICK = {
    'hidden': [16],
    'learning_rate': 0.02,
    'steps_per_update': 8,
    'minibatch': 64,
}
_ACTIONS = 14
_ONE = ('query',)
_PAIR = ('query', 'other')
_DECOUPLED = {'approval': 'feedback'}
_PAIRED = {'approval': 'feedback', 'other_query': 'other'}
_ADVISED = {'advice': 'feedback', 'query': 'query'}
_Q = {'form': 'q', 'exploration_steps': 2000, 'exploration': 0.1}


def _make(env: Any, kind: str, seed: int = 1, **options: Any) -> agents.Learner:
  return agents.make(
      {'kind': kind, **_QUICK, **options},
      env.observation_spec(),
      env.action_spec(),
      env.num_envs,
      seed,
  )


def _run(learner: agents.Learner, env: Any, num_steps: int) -> None:
  time_step = env.reset()
  for _ in range(num_steps):
    time_step = env.step(learner.step(time_step))


# Every kind and form, in the environment that it is for.
_CASES: dict[str, tuple[Any, str, dict[str, Any]]] = {
    'policy_gradient': (
        lambda: toys.Bandit(16),
        'policy_gradient',
        {'reward': 'feedback', 'gamma': 0},
    ),
    'q_learning': (
        lambda: toys.Bandit(16),
        'q_learning',
        {
            'reward': 'feedback',
            'gamma': 0,
            'exploration_steps': 600,
            'replay_size': 640,
            'min_replay': 128,
        },
    ),
    'behavioural_cloning': (
        lambda: toys.Bandit(16, shows='demonstration'),
        'behavioural_cloning',
        {'demonstration': 'feedback'},
    ),
    **{
        name: (
            lambda queries=queries: toys.Bandit(16, _ACTIONS, queries=queries),
            kind,
            {**options, 'query': 'query'},
        )
        for name, kind, queries, options in (
            ('coupled', 'value_advice', _ONE, {'advice': 'feedback'}),
            ('decoupled_q', 'decoupled_approval', _ONE, {**_DECOUPLED, **_Q}),
            ('paired', 'decoupled_approval', _PAIR, _PAIRED),
        )
    },
    'delayed': (
        lambda: toys.Bandit(16, _ACTIONS, queries=_ONE, is_delayed=True),
        'value_advice',
        {**_ADVISED, 'query_delay': 1},
    ),
}


def test_following_the_readings_helps_where_they_all_drift():
  scores = {}
  for follows in (True, False):
    env = toys.Bandit(16, _ACTIONS, queries=_PAIR, drift=0.5)
    learner = _make(
        env, 'decoupled_approval', **_PAIRED, query='query',
        follows_reading=follows,
    )  # fmt: skip
    _run(learner, env, 300)
    scores[follows] = np.mean(env.scores[-100:])
  assert scores[True] > max(0.8, scores[False] + 0.1)


@pytest.mark.parametrize(
    ('delay', 'expected'),
    # With a delay, the last query of an episode never gets feedback, and the
    # first step has none to give.
    [(0, [True] * 4 + [False]), (1, [True] * 3 + [False] * 2)],
)
def test_a_reading_is_credited_to_its_query_and_the_observation_of_then(
    delay, expected
):
  env = toys.Bandit(50, _ACTIONS, queries=_ONE, is_delayed=delay, length=4)
  learner = _make(
      env, 'value_advice', **_ADVISED, query_delay=delay, steps_per_update=99
  )
  _run(learner, env, 16)
  for i, transition in enumerate(learner.state()['memory']['transitions']):
    assert (transition['is_valid'] == expected[i % 5]).all()
    if expected[i % 5]:
      asked = transition['choice']['asked'][:, 0]
      good = asked == transition['observation']['thing']
      np.testing.assert_array_equal(transition['reading'], good)
  assert i + delay == 14


# In one test, because compiling a learner takes longer than training it.
@pytest.mark.parametrize('case', _CASES)
def test_a_learner_learns_and_resumes_from_its_state_bit_for_bit(case):
  make_env, kind, options = _CASES[case]
  env = make_env()
  learner = _make(env, kind, **options)
  time_step = env.reset()
  for _ in range(19):
    time_step = env.step(learner.step(time_step))
  state = learner.state()
  successor = _make(make_env(), kind, seed=7, **options)
  successor.set_state(state)
  for _ in range(14):
    actions = learner.step(time_step)
    np.testing.assert_array_equal(actions, successor.step(time_step))
    time_step = env.step(actions)
  assert trees.are_equal(learner.state(), successor.state())
  assert learner.metrics() == successor.metrics()
  # The state that was handed out is a copy.
  assert state['num_acts'] == 19

  for _ in range(60 if env.num_actions == 3 else 200):
    time_step = env.step(learner.step(time_step))
  assert np.mean(env.scores[:8]) < 0.6
  assert np.mean(env.scores[-20:]) > 0.8
  assert learner.num_steps == 16 * len(env.scores)
  metrics = learner.metrics()
  assert metrics['num_updates'] > 0
  # As it was read, in the units of the register.
  observed = np.mean(env.feedback[-9:-1])
  assert metrics['observed_feedback'] == pytest.approx(observed, abs=0.3)
  assert all(np.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize(
    ('time_limit', 'after'), [('continues', 1), ('ends', 0)]
)
def test_nothing_follows_a_time_limit_that_ends_an_episode(time_limit, after):
  env = toys.Bandit(2, length=4)
  learner = _make(
      env, 'policy_gradient', reward='feedback', time_limit=time_limit
  )
  seen = []
  learner._observe = lambda transition, _: seen.append(transition['discount'])
  _run(learner, env, 5)
  assert [list(discount) for discount in seen] == [[1, 1]] * 3 + [[after] * 2]


def test_policy_gradient_learns_vectors_from_pixels():
  env = toys.Aim(16, as_pixels=True)
  learner = _make(env, 'policy_gradient', reward='reward', gamma=0)
  _run(learner, env, 60)
  assert np.mean(env.scores[:8]) < -2.2
  assert np.mean(env.scores[-20:]) > -1.7


def test_the_state_of_another_learner_is_refused():
  env = toys.Bandit(16)
  learner = _make(env, 'policy_gradient', reward='feedback')
  wider = _make(env, 'policy_gradient', reward='feedback', hidden=[17])
  cloner = _make(env, 'behavioural_cloning', demonstration='feedback')
  deeper = _make(env, 'policy_gradient', reward='feedback', hidden=[16, 16])
  before = learner.state()
  for other, problem in (
      (wider, r'has shape \(\d+, 17\), expected'),
      (cloner, "kind 'behavioural_cloning'; this learner is"),
      (deeper, 'is either missing or unexpected'),
  ):
    with pytest.raises(errors.StateLayoutError, match=problem):
      learner.set_state(other.state())
  assert trees.are_equal(learner.state(), before)


def test_the_decoupled_query_is_independent_of_the_action():
  env = toys.Bandit(4000, _ACTIONS, queries=_PAIR)
  for other_query in (None, 'other'):
    learner = _make(
        env,
        'decoupled_approval',
        approval='feedback',
        query='query',
        other_query=other_query,
    )
    actions = learner.step(env.reset())
    columns = [0, 2] if other_query is None else [0, 1, 2]
    for i in columns:
      for j in columns[: columns.index(i)]:
        same = np.mean(actions[:, i] == actions[:, j])
        # Of independent ones, 1 in 14 are the same.
        assert 0.05 < same < 0.1, (i, j)
  assert len(set(actions[:, 0])) == _ACTIONS


@pytest.mark.parametrize(
    ('spec', 'problem'),
    [
        ({'kind': 'q_lerning'}, "did you mean 'q_learning'"),
        (
            {'kind': 'q_learning', 'reward': 'feedback', 'gama': 1},
            "unknown key 'gama'; did you mean 'gamma'",
        ),
        (
            {'kind': 'policy_gradient', 'reward': 'bonus'},
            r"learner.reward: the agent does not read 'bonus'; .*"
            "'registers/feedback'",
        ),
        (
            {'kind': 'value_advice', 'advice': 'feedback', 'query': 'query'},
            r"learner: 'query' is not a query register; .* has \[\]",
        ),
        (
            {
                'kind': 'decoupled_approval',
                'approval': 'feedback',
                'query': 'query',
                'query_policy': 'taken_action',
            },
            "query_policy: .*'independent_action'.*got 'taken_action'",
        ),
        (
            {'kind': 'value_advice', **_ADVISED, 'form': 'q', 'floor': 0.01},
            'learner: floor: 0.01; must be 0 with the form q',
        ),
        (
            {'kind': 'value_advice', **_ADVISED, 'query_delay': True},
            'learner: query_delay: must be 0 or 1, got true',
        ),
    ],
)
def test_a_wrong_learner_is_refused_in_one_line(spec, problem):
  env = toys.Bandit(2)
  with pytest.raises(errors.SpecError, match=problem) as caught:
    agents.make(spec, env.observation_spec(), env.action_spec(), 2, 1)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('kind', 'option'),
    [('behavioural_cloning', 'demonstration'), ('q_learning', 'reward')],
)
def test_a_learner_of_discrete_actions_refuses_vectors(kind, option):
  env = toys.Aim(2)
  with pytest.raises(errors.SpecError, match='design must have an action_set'):
    _make(env, kind, **{option: 'reward'})


def test_a_query_register_has_to_hold_every_action():
  env = toys.Bandit(2, _ACTIONS - 1, queries=('query',))
  with pytest.raises(errors.SpecError, match=r"'query' holds \[0, 12\]"):
    _make(env, 'value_advice', advice='feedback', query='query')


def test_a_scale_of_changes_does_not_grow_with_a_displacement():
  scales = {}
  for scale in ('reading', 'change'):
    env = toys.Bandit(16, _ACTIONS, queries=_ONE, drift=2.0)
    learner = _make(env, 'value_advice', **_ADVISED, scale=scale)
    _run(learner, env, 129)
    scales[scale] = learner.metrics()['feedback_scale']
  # A walk of 128 steps of 2: a variance of 4 * t, 4 * 64 on average.
  assert scales['reading'] == pytest.approx(16.0, abs=3.0)
  # The feedback adds less than 2 * 1/14 to the variance of a change, 4.
  assert scales['change'] == pytest.approx(2.0, abs=0.1)


def test_a_floor_has_to_leave_room_for_all_actions():
  env = toys.Bandit(40, _ACTIONS, queries=_ONE)
  with pytest.raises(errors.SpecError, match=r'0\.1; .* below 1/14, because'):
    _make(env, 'value_advice', **_ADVISED, floor=0.1)


def test_other_specs_are_refused():
  good = toys.Bandit(2)
  spec = {'kind': 'policy_gradient', 'reward': 'feedback'}
  with pytest.raises(errors.SpecError, match='must be a DiscreteArray'):
    agents.make(
        spec, good.observation_spec(), dm_env_specs.Array((2, 2), float), 2, 1
    )
  words = {**good.observation_spec(), 'words': dm_env_specs.StringArray(())}
  with pytest.raises(errors.SpecError, match="'words': dtype object"):
    agents.make(spec, words, good.action_spec(), 2, 1)
  vector = {'registers/feedback': dm_env_specs.Array((3,), float)}
  with pytest.raises(errors.SpecError, match='must be a scalar'):
    agents.make(spec, vector, good.action_spec(), 2, 1)


def test_an_observation_of_another_shape_is_refused():
  env = toys.Bandit(2)
  learner = _make(env, 'policy_gradient', reward='feedback')
  with pytest.raises(errors.SpecError, match=r'shape \(3,\), expected \(2,\)'):
    learner.step(toys.Bandit(3).reset())
