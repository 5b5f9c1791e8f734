"""Tests of the gate of a learner from values, by hand and from its state."""

import contextlib
import re
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from realab_suite.lab.agents import gate_settings
from realab_suite.lab.agents import gates
from realab_suite.lab.testing import probes
from tests.lab.agents import toys

_WORKER = {'policy': 'probe_worker', 'options': {'rest': 0.3}, 'worlds': 0.5}
_CLONED = {**_WORKER, 'clone_steps': 5}
_LEARNER = {
    'kind': 'q_learning',
    'reward': 'feedback',
    'hidden': [8],
    'gamma': 0.5,
    'minibatch': 8,
    'gradients_per_update': 2,
    'replay_size': 400,
    'min_replay': 20,
}


def _keeper(
    num_envs: int, num_returns: int = 3, **options: Any
) -> gates.Gatekeeper:
  """Returns an open gate, whose model was never fitted and predicts about 0."""
  env = toys.Bandit(num_envs)
  learner = agents.make(
      {**_LEARNER, 'num_returns': num_returns},
      env.observation_spec(), env.action_spec(), num_envs, 1,
  )  # fmt: skip
  given = {'threshold': 2.0, 'fit_steps': 100, 'gradients': 4, **options}
  keeper = gates.Gatekeeper(gate_settings.Gate(**given), learner)
  keeper._state['is_open'] = True
  return keeper


def _learned_in_a_probe_world(gate: dict[str, Any]) -> Any:
  """Returns a learner after nine steps of four worlds."""
  with contextlib.closing(probes.load('one_push', num_envs=4)) as env:
    learner = agents.make(
        {**_LEARNER, 'reward': 'reward', 'gate': gate},
        env.observation_spec(), env.action_spec(), 4, 1,
    )  # fmt: skip
    time_step = env.reset()
    for _ in range(9):
      time_step = env.step(learner.step(time_step))
  return learner


def _transition(readings: list[float], **entries: Any) -> Any:
  number = len(readings)
  return {
      'observation': _observation(number),
      'choice': {'action': np.arange(number, dtype=np.int32) % 3},
      'reading': np.array(readings, np.float32),
      'discount': np.ones(number, np.float32),
      'is_valid': np.ones(number, bool),
      **entries,
  }


def _observation(number: int) -> Any:
  return {
      'thing': np.zeros(number, np.int32),
      'registers/feedback': np.zeros(number, np.float32),
  }


@pytest.mark.parametrize('trusted', [None, _WORKER])
def test_before_it_opens_a_gate_believes_whatever_the_trusted_policy_reads(
    trusted,
):
  gate = {'threshold': 0.001, 'fit_steps': 10**6, 'trusted': trusted}
  learner = _learned_in_a_probe_world(gate)
  replay = learner.state()['memory']['replay']
  own = trusted is None
  assert replay['is_valid'].tolist() == [[1, 1, own, own]] * 8


def test_unexpected_readings_are_held_back_in_any_direction():
  keeper = _keeper(5)
  is_valid = np.array([1, 1, 1, 0, 1], bool)
  sifted = keeper.treat(
      _transition([1.9, 2.1, -2.1, 9.0, 0.0], is_valid=is_valid)
  )
  assert sifted['is_valid'].tolist() == [1, 0, 0, 0, 1]
  assert sifted['is_held'].tolist() == [0, 1, 1, 0, 0]
  assert is_valid.tolist() == [1, 1, 1, 0, 1]
  assert keeper.metrics['changed'] == 2 / 4
  assert keeper.metrics['gate_unexpected'] == 2
  # What is no number is unexpected.
  sifted = keeper.treat(_transition([np.nan, np.inf, 0.0, 0.0, 0.0]))
  assert sifted['is_held'].tolist() == [1, 1, 0, 0, 0]


def test_what_remains_of_an_episode_after_a_trial_is_not_tried():
  keeper = _keeper(3)
  keeper._state['is_judged'] = np.array([1, 1, 0], bool)
  # An episode of the second world begins, so that its next step counts.
  begins = np.array([1, 0, 1], bool)
  held = [
      keeper.treat(_transition([9.0] * 3, **entry))
      for entry in ({}, {'is_valid': begins}, {})
  ]
  assert [one['is_held'].tolist() for one in held] == [
      [0, 0, 1], [0, 0, 1], [0, 1, 1],
  ]  # fmt: skip
  assert not any(one['is_valid'].any() for one in held)


def _replay(held: Any) -> Any:
  """Returns a replay of 10 slots, whose readings are 0 and 7 where held."""
  is_held = np.array(held, bool)
  slots, worlds = is_held.shape
  return {
      'observation': {'number': np.arange(slots)[:, None].repeat(worlds, 1)},
      'choice': {'action': np.zeros(is_held.shape, np.int32)},
      'reading': np.where(is_held, 7.0, 0.0).astype(np.float32),
      'discount': np.ones(is_held.shape, np.float32),
      'is_valid': ~is_held,
      'is_held': is_held,
  }


def test_a_share_of_each_minibatch_begins_where_readings_are_held_back():
  begin = np.zeros((3, 8), int), np.zeros((3, 8), int)
  gates._inject(begin, (np.array([3]), np.array([1])), np.random.default_rng(0))
  assert begin[0].tolist() == [[3, 3, *[0] * 6]] * 3
  assert begin[1].tolist() == [[1, 1, *[0] * 6]] * 3


@pytest.mark.parametrize(
    ('convinced', 'others', 'later', 'is_accepted'),
    [
        (0.5, 0.5, 0.0, True),
        (0.5, 1.0, 0.0, False),
        (np.nan, 0.5, 0.0, False),
        # The copy that earns more in the trial earns less after it.
        (1.0, 0.5, 8.0, False),
    ],
)
def test_the_copy_that_earns_more_by_the_model_goes_on(
    monkeypatch, convinced, others, later, is_accepted
):
  # Worlds 1 and 3 are those of the copy with unexpected readings. Two steps
  # count 1 + 0.5, and the value after them 0.25.
  keeper = _keeper(4, alarms=2, trial_steps=2)
  learner, state = keeper._learner, keeper._state
  learner.replay = replay = _replay(np.zeros((10, 4)))
  learner.num_stored = 10
  trainings = []

  def train(*arguments):
    trainings.append(arguments)
    return f'copy {len(trainings)}'

  monkeypatch.setattr(keeper, '_trained', train)
  learner.networks = 'plain'
  replay['is_held'][3, 0] = True
  assert not keeper.holds(_observation(4))
  assert learner.networks == 'plain'
  replay['is_held'][3, 3] = True
  replay['is_valid'][3] = [0, 1, 0, 0]
  assert keeper.holds(_observation(4))
  assert learner.networks == 'copy 2'
  assert trainings == [('plain', 4, True), ('plain', 4)]
  rewards = np.array([others, convinced, others, convinced])
  values = {
      'model': rewards[:, np.newaxis].repeat(3, 1),
      'values': np.array([later, 0.0, later, 0.0])[:, np.newaxis],
  }
  monkeypatch.setattr(keeper, '_values', lambda kept, unused: values[kept])
  for is_over in (False, True):
    sifted = keeper.treat(_transition([9.0] * 4))
    assert not sifted['is_valid'].any()
    assert keeper.holds(_observation(4)) != is_over
  assert learner.networks == ('copy 1' if is_accepted else 'copy 2')
  assert replay['is_valid'][3].tolist() == [is_accepted, 1, 0, is_accepted]
  assert not replay['is_held'].any()
  counts = state['counts']
  assert counts['accepted' if is_accepted else 'refused'] == 2
  assert counts['refused' if is_accepted else 'accepted'] == 0
  assert counts['trials'] == 1
  assert counts['trial_steps'] == 2 * 4
  assert counts['unexpected'] == 2 * 4
  assert state['is_judged'].all()


def test_a_learner_continues_in_the_middle_of_a_trial_bit_for_bit():
  learner = {
      **_LEARNER,
      'reward': 'reward',
      'exploration_steps': 800,
      'gate': {
          'threshold': 1.5, 'fit_steps': 400, 'alarms': 4, 'gradients': 4,
          'trial_steps': 22, 'trusted': _WORKER,
      },
  }  # fmt: skip
  with contextlib.closing(probes.load('one_push', num_envs=8)) as env:
    spec = env.observation_spec(), env.action_spec(), 8
    one, other = agents.make(learner, *spec, 1), agents.make(learner, *spec, 2)
    time_step, is_twin = env.reset(), False
    for _ in range(400):
      action = one.step(time_step)
      if is_twin:
        np.testing.assert_array_equal(action, other.step(time_step))
      time_step = env.step(action)
      (keeper,) = one._wrappers
      if keeper._state['is_trying']:
        # Nothing is updated in a trial, but its price is reported.
        assert keeper.metrics.items() <= one.metrics().items()
      if keeper._state['is_trying'] and not is_twin:
        other.set_state(one.state())
        is_twin = True
  assert is_twin
  assert trees.are_equal(one.state(), other.state())
  assert one.metrics()['gate_trials'] >= 2


@pytest.mark.parametrize(
    ('gate', 'message'),
    [
        ({'threshold': -1.0, 'fit_steps': 9}, 'gate.threshold: '),
        (
            {'threshold': 1.0, 'fit_steps': 9, 'trusted': _CLONED},
            'trusted.clone_steps: 5; must be 0',
        ),
        (
            {'threshold': 1.0, 'fit_steps': 20},
            'gate.fit_steps: 20; must be more than min_replay, 20',
        ),
        (
            {'threshold': 1.0, 'fit_steps': 99, 'alarms': 10**6},
            'gate.alarms: 1000000; must be at most 388, the transitions',
        ),
    ],
)
def test_a_gate_that_does_not_fit_is_refused_in_one_line(gate, message):
  with (
      contextlib.closing(probes.load('one_push', num_envs=4)) as env,
      pytest.raises(errors.RealabError, match=re.escape(message)) as raised,
  ):
    agents.make(
        {**_LEARNER, 'reward': 'reward', 'gate': gate},
        env.observation_spec(), env.action_spec(), num_envs=4, seed=1,
    )  # fmt: skip
  assert '\n' not in str(raised.value)
