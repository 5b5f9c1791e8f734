"""Tests of learners with a recurrent memory."""

from typing import Any, Literal

import numpy as np
import pytest

pytest.importorskip('jax', reason='JAX is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

import equinox as eqx
import jax

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from realab_suite.lab.agents import defences
from realab_suite.lab.agents import features
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import policy_gradient
from realab_suite.lab.experiments import training
from tests import registries
from tests.lab.agents import toys

_QUICK = {
    'kind': 'policy_gradient',
    'reward': 'reward',
    'hidden': [16],
    'learning_rate': 0.02,
    'gamma': 0.9,
    'minibatch': 160,
}


def _make(env: Any, seed: int = 1, **options: Any) -> agents.Learner:
  return agents.make(
      {**_QUICK, 'steps_per_update': 10, **options},
      env.observation_spec(),
      env.action_spec(),
      env.num_envs,
      seed,
  )


def _train(learner: agents.Learner, env: toys.Recall, num_steps: int) -> Any:
  time_step = env.reset()
  for _ in range(num_steps):
    time_step = env.step(learner.step(time_step))
  return time_step


def _recalled(learner: agents.Learner, env: toys.Recall) -> float:
  """Returns the share of worlds with the right answer, acting greedily."""
  actor = training.LearnerActor(learner, 0, greedy=True)
  time_step = env.reset()
  for _ in range(2 * env.wait + 3):
    time_step = env.step(actor.act(time_step))
  return float(env.right.mean())


# Without a memory, one answer is given in all worlds: right in 1 of 2 or of 3.
@pytest.mark.parametrize(
    ('memory', 'choices', 'phases', 'steps_per_update', 'share'),
    [
        (0, 2, 1, 10, 1 / 2),
        # An episode begins with the batch, or anywhere in it.
        (8, 2, 1, 5, 1.0),
        (12, 3, 5, 10, 1.0),
    ],
)
def test_only_a_memory_recalls_what_was_shown(
    memory, choices, phases, steps_per_update, share
):
  env = toys.Recall(60, choices, phases=phases)
  learner = _make(env, memory=memory, steps_per_update=steps_per_update)
  _train(learner, env, 800)
  # In another number of worlds, for the first time.
  assert _recalled(learner, toys.Recall(6 * choices, choices)) == share


def test_the_state_is_that_of_a_gated_unit_and_begins_anew():
  encoder = features.Encoder.from_spec(toys.Recall(2).observation_spec())
  memory = networks.Memory(encoder, 4, np.random.default_rng(0))
  size = encoder.vector_size
  cell = eqx.nn.GRUCell(size, 4, key=jax.random.PRNGKey(0))
  (layer,) = memory.inputs.layers
  bias = np.arange(12, dtype=np.float32) / 10
  more = np.concatenate([np.zeros(8), [0.3, -0.2, 0.1, 0.5]]).astype('f4')
  memory = eqx.tree_at(
      lambda m: (m.inputs.layers[0].bias, m.recurrent.bias),
      memory,
      (bias, more),
  )
  cell = eqx.tree_at(
      lambda c: (c.weight_ih, c.weight_hh, c.bias, c.bias_n),
      cell,
      (layer.weight.T, memory.recurrent.weight.T, bias, more[8:]),
  )
  vector = np.random.default_rng(1).normal(size=(3, 2, size + 4)).astype('f4')
  # The second world begins an episode with the third observation.
  continues = np.array([[True, True], [True, False], [True, True]])
  found = memory.through({'vector': vector}, continues)['vector']
  np.testing.assert_array_equal(found[..., :size], vector[..., :size])
  for world in range(2):
    state = vector[0, world, size:]
    for time in range(3):
      state = cell(vector[time, world, :size], state)
      np.testing.assert_allclose(found[time, world, size:], state, atol=1e-6)
      state = state if continues[time, world] else np.zeros(4)
  once = memory({'vector': vector[0]})['vector']
  np.testing.assert_allclose(once, found[0], atol=1e-6)


def test_a_learner_with_a_memory_resumes_bit_for_bit():
  env = toys.Recall(10, phases=5)
  learner = _make(env, memory=4, minibatch=40)
  time_step = _train(learner, env, 27)
  successor = _make(env, seed=7, memory=4, minibatch=40)
  successor.set_state(learner.state())
  for _ in range(14):
    actions = learner.step(time_step)
    np.testing.assert_array_equal(actions, successor.step(time_step))
    time_step = env.step(actions)
  assert trees.are_equal(learner.state(), successor.state())
  with pytest.raises(errors.StateLayoutError, match='missing or unexpected'):
    _make(env).set_state(learner.state())


def test_evaluation_remembers_what_training_remembers(monkeypatch):
  env = toys.Recall(10, phases=5)
  learner = _make(env, memory=4, steps_per_update=1000)
  actor = training.LearnerActor(learner, 0, greedy=False)
  seen = []
  choose = learner._choose

  def watched(observation, keys, greedy):
    seen.append(observation)
    return choose(observation, keys, greedy)

  monkeypatch.setattr(learner, '_choose', watched)
  time_step = env.reset()
  for _ in range(11):
    actor.act(time_step)
    begins = time_step.step_type == 0
    time_step = env.step(learner.step(time_step))
    acted, trained = seen[-2:]
    assert trees.are_equal(acted, trained)
    assert not acted[features.MEMORY][begins].any()
  assert acted[features.MEMORY][~begins].any(axis=1).all()


def test_a_batch_begins_where_the_policy_that_acted_was():
  # Before the first gradient, the probabilities that an update recomputes are
  # those of acting, also in the middle of episodes.
  env = toys.Recall(10, phases=5)
  learner = _make(env, memory=4, steps_per_update=7)
  updated = []
  learn = learner._learn
  learner._learn = lambda batch, last: updated.append(
      (batch, learner._networks[0])
  ) or learn(batch, last)
  _train(learner, env, 15)
  assert len(updated) == 2
  for batch, agent in updated:
    encoded = learner._encoder.encode(batch['observation'])
    seen = agent.memory.through(encoded, batch['is_valid'])
    log_prob = agent.policy(seen).log_prob(batch['choice']['action'])
    np.testing.assert_allclose(log_prob, batch['choice']['log_prob'], atol=1e-5)


class _Screen(defences.Defence):
  """Leaves out each step with a right answer."""

  kind: Literal['test_screen']

  def treat(self, batch, setting, state, key):
    is_valid = batch['is_valid'] & (batch['reading'] <= 0.5)
    return defences.Treated({**batch, 'is_valid': is_valid}, state)


def test_an_episode_goes_on_for_the_memory_where_a_defence_screens(monkeypatch):
  update, batches = policy_gradient._update, []

  def watched(options, encoder, trained, batch, *args):
    batches.append(batch)
    return update(options, encoder, trained, batch, *args)

  monkeypatch.setattr(policy_gradient, '_update', watched)
  env = toys.Recall(20, phases=5)
  with registries.preserved():
    defences.DEFENCES.add('test_screen')(_Screen)
    # The step with a right answer is the last one of its episode.
    learner = _make(env, memory=4, defence={'kind': 'test_screen'})
    _train(learner, env, 41)
  assert len(batches) == 4
  for batch in batches:
    screened = batch['reading'] > 0
    assert not batch['is_valid'][screened].any()
    assert batch['continues'][screened].all()
    # Every fifth step begins an episode, in each world.
    np.testing.assert_array_equal((~batch['continues']).sum(axis=0), 2)
  # Defences get features of single steps.
  assert features.MEMORY not in learner.setting.encoder.names


@pytest.mark.parametrize('given', [-1, 1.5, 4097, 'four', 10**9])
def test_a_wrong_memory_is_refused_in_one_line(given):
  with pytest.raises(errors.SpecError, match='learner: memory') as caught:
    _make(toys.Recall(2), memory=given)
  assert '\n' not in str(caught.value)


def test_acting_without_the_memory_is_refused():
  env = toys.Recall(2)
  learner = _make(env, memory=4)
  key = np.array([1, 2], np.uint32)
  with pytest.raises(errors.SpecError, match="'learner/memory' is missing"):
    learner.act(env.reset().observation, key)
