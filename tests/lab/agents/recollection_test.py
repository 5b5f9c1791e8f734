"""Tests of learners that remember what they were paid, and where."""

from typing import Any, Literal

from dm_env import specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from realab_suite.lab.agents import defences
from realab_suite.lab.agents import network_export
from realab_suite.lab.experiments import training
from realab_suite.policies import action_sets
from realab_suite.policies import network_policies
from realab_suite.policies import recollections
from tests import registries
from tests.lab.agents import toys

_KEY = 'registers/reward/recollection'
_READING = 'registers/reward'
_EAST, _NORTH = (1, 0), (0, 1)
# Of each step: whether an episode begins, the reading, position and heading;
# and what is remembered then.
_STEPS = (
    # An episode begins: nobody has been paid.
    (1, 5.0, (1, 1), _EAST, (0,) * 11),
    # Too small to take notice of.
    (0, 0.09, (1, 1), _EAST, (0,) * 11),
    (0, -0.5, (1, 1), _EAST, (-0.5, -0.5, -0.5, -0.5, 1, *(0,) * 6)),
    # Paid here; the next step is 2 m to the east of it, with it behind.
    (0, 2.0, (1, 1), _EAST, (1.5, 2, -0.5, 2, 2, 1, 1, 1, 0, 0, 0)),
    (0, 0.0, (3, 1), _EAST, (1.5, 2, -0.5, 2, 2, 1, 1, 1, 2, -1, 0)),
    # It is to the left of who looks north.
    (0, 0.0, (3, 1), _NORTH, (1.5, 2, -0.5, 2, 2, 1, 1, 1, 2, 0, 1)),
    # Paid elsewhere; a loss there does not count as pay.
    (0, 0.5, (3, 1), _EAST, (2, 0.5, -0.5, 2, 3, 1, 3, 1, 0, 0, 0)),
    (0, -1.0, (3, 4), _EAST, (1, -1, -1, 2, 4, 1, 3, 1, 3, 0, -1)),
    (1, 1.0, (2, 2), _EAST, (0,) * 11),
)


class Field:
  """Avatars that jump about, and are sometimes paid; episodes have 6 steps."""

  def __init__(self, num_envs: int) -> None:
    self.num_envs = num_envs
    self._time = np.arange(num_envs) % 7
    self._generator = np.random.default_rng(3)

  def observation_spec(self) -> dict[str, specs.Array]:
    return {
        'senses/position': specs.Array((2,), np.float32),
        'senses/heading': specs.BoundedArray((2,), np.float32, -1.0, 1.0),
        _READING: specs.Array((), np.float64),
    }

  def action_spec(self) -> specs.Array:
    return specs.DiscreteArray(
        len(action_sets.DMLAB_LIKE), name='dmlab_like/v1'
    )

  def step(self, actions: np.ndarray) -> toys.ToyStep:
    del actions
    draws = self._generator.uniform(-3, 3, (self.num_envs, 4))
    observation = {
        'senses/position': np.float32(draws[:, :2]),
        'senses/heading': np.float32(
            [np.cos(draws[:, 2]), np.sin(draws[:, 2])]
        ).T,
        _READING: np.where(draws[:, 3] > 0, draws[:, 3], 0.0),
    }
    step_type = np.where(self._time == 6, 2, np.sign(self._time))
    self._time = (self._time + 1) % 7
    return toys.ToyStep(step_type, np.ones(self.num_envs), observation)

  def reset(self) -> toys.ToyStep:
    return self.step(np.zeros(self.num_envs))


def _make(env: Any, kind: str, seed: int = 1, **options: Any) -> agents.Learner:
  quick = {'hidden': [8], 'reward': 'reward', 'minibatch': 32}
  few = (
      {'steps_per_update': 8}
      if kind == 'policy_gradient'
      else {'min_replay': 64, 'replay_size': 1024}
  )
  return agents.make(
      {'kind': kind, 'recollection': True, **quick, **few, **options},
      env.observation_spec(),
      env.action_spec(),
      env.num_envs,
      seed,
  )


def test_readings_and_places_of_an_episode_are_remembered():
  one, two = recollections.initial(()), recollections.initial((2,))
  for number, (begins, reading, position, heading, expected) in enumerate(
      _STEPS
  ):
    seen = {
        'senses/position': np.float32(position),
        'senses/heading': np.float32(heading),
        _READING: np.array(reading),
    }
    both = {name: np.stack([x, 2 * x]) for name, x in seen.items()}
    start = np.array(bool(begins))
    one = recollections.recall(seen, _READING, start, one)
    two = recollections.recall(both, _READING, np.stack([start] * 2), two)
    np.testing.assert_allclose(one, expected, atol=1e-6, err_msg=str(number))
    assert one.dtype == two.dtype == np.float32
    np.testing.assert_array_equal(two[0], one)
  assert len(expected) == len(recollections.NUMBERS)


@pytest.mark.parametrize('kind', ['policy_gradient', 'q_learning'])
def test_a_learner_resumes_within_an_episode_bit_for_bit(kind):
  env = Field(8)
  learner = _make(env, kind)
  time_step = env.reset()
  for _ in range(11):
    time_step = env.step(learner.step(time_step))
  assert learner.state()['last']['observation'][_KEY].any()
  successor = _make(env, kind, seed=7)
  successor.set_state(learner.state())
  for _ in range(9):
    actions = learner.step(time_step)
    np.testing.assert_array_equal(actions, successor.step(time_step))
    time_step = env.step(actions)
  assert trees.are_equal(learner.state(), successor.state())


def test_it_is_off_by_default_and_has_the_senses_that_it_needs():
  env = Field(2)
  plain = _make(env, 'policy_gradient', recollection=False)
  assert plain.setting.encoder.names == tuple(env.observation_spec())
  with pytest.raises(errors.StateLayoutError, match='shape'):
    plain.set_state(_make(env, 'policy_gradient').state())
  bandit = toys.Bandit(2)
  with pytest.raises(errors.SpecError, match=r'recollection: true; .*heading'):
    agents.make(
        {
            'kind': 'policy_gradient',
            'reward': 'feedback',
            'recollection': True,
        },
        bandit.observation_spec(),
        bandit.action_spec(),
        2,
        0,
    )


def test_evaluation_and_an_exported_policy_see_what_training_sees(monkeypatch):
  env = Field(6)
  learner = _make(env, 'policy_gradient', steps_per_update=1000)
  actor = training.LearnerActor(learner, 0, greedy=False)
  made = network_export.export(learner, description='', made={}, reached=())
  policy = network_policies.NetworkAgent(made)
  assert policy.required_senses == ('position', 'heading')
  seen = []
  choose = learner._choose

  def watched(observation, keys, greedy):
    seen.append(observation)
    return choose(observation, keys, greedy)

  monkeypatch.setattr(learner, '_choose', watched)
  state = policy.initial_state((6,))
  keys = np.ones((6, 2), np.uint64)
  time_step = env.reset()
  for _ in range(11):
    actor.act(time_step)
    start = time_step.step_type == 0
    _, state = policy.step(time_step.observation, start, keys, state)
    time_step = env.step(learner.step(time_step))
    acted, trained = seen[-2:]
    assert trees.are_equal(acted, trained)
    np.testing.assert_array_equal(state[_KEY], trained[_KEY])
  with pytest.raises(errors.SpecError, match='needs the senses'):
    policy.step({'senses/position': 0}, start, keys, state)
  # Worlds differ, so the checks above are not empty.
  assert len(np.unique(trained[_KEY][:, 0])) > 3


def test_a_defence_does_not_get_what_it_has_not_declared_by_way_of_memory():
  seen = []

  class Curious(defences.Defence):
    kind: Literal['curious'] = 'curious'

    def treat(self, batch, setting, state, key):
      seen.extend(batch['observation'])
      return defences.Treated(batch, state)

  env = Field(4)
  with registries.preserved():
    defences.DEFENCES.add('curious')(Curious)
    learner = _make(env, 'policy_gradient', defence={'kind': 'curious'})
  time_step = env.reset()
  for _ in range(20):
    time_step = env.step(learner.step(time_step))
  assert _READING in seen
  assert _KEY not in seen
