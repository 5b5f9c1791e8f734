"""Tests of the gate of a learner from values, by hand and from its state."""

import contextlib
import re
from typing import Any

import numpy as np
import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from realab_suite import agents
from realab_suite import errors
from realab_suite import trees
from realab_suite.agents import action_encoding
from realab_suite.agents import defences
from realab_suite.agents import features
from realab_suite.agents import gates
from realab_suite.testing import probes
from tests.agents import toys

_WORKER = {'policy': 'probe_worker', 'options': {'rest': 0.3}, 'worlds': 0.5}
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


def _gate(num_envs: int, **options: Any) -> gates.Gate:
  env = toys.Bandit(num_envs)
  setting = defences.Setting(
      agents.QLearning.OPTIONS.model_validate(_LEARNER),
      features.Encoder.from_spec(env.observation_spec()),
      action_encoding.Controls.from_spec(env.action_spec()),
      num_envs,
  )
  given = {'threshold': 2.0, 'fit_steps': 10, 'gradients': 4, **options}
  return gates.Gate(
      gates.GateOptions(**given), setting, np.random.default_rng(0)
  )


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


def _opened(num_envs: int, value: Any = 'kept', **options: Any) -> gates.Gate:
  """Returns an open gate, whose model was never fitted and predicts about 0."""
  gate = _gate(num_envs, **options)
  gate.learn(lambda: {}, 1.0, value, 10)
  assert gate.is_open
  return gate


def test_before_it_opens_a_gate_believes_whatever_the_trusted_policy_reads():
  readings = [0.0, 99.0, -99.0]
  for trusted, is_valid in ((None, [1, 1, 1]), (_WORKER, [1, 0, 1])):
    gate = _gate(3, trusted=trusted)
    is_trusted = np.array([1, 0, 1], bool)
    sifted = gate.sift(
        _transition(readings, is_trusted=is_trusted), _observation(3), 0
    )
    assert sifted['is_valid'].tolist() == is_valid
    assert not gate.is_open


def test_unexpected_readings_are_held_back_in_any_direction():
  gate = _opened(5, alarms=4)
  is_valid = np.array([1, 1, 1, 0, 1], bool)
  sifted = gate.sift(
      _transition([1.9, 2.1, -2.1, 9.0, 0.0], is_valid=is_valid),
      _observation(5),
      7,
  )
  assert sifted['is_valid'].tolist() == [1, 0, 0, 0, 1]
  assert is_valid.tolist() == [1, 1, 1, 0, 1]
  held = gate.state()['held']
  assert [one['where'].tolist() for one in held] == [[7, 1], [7, 2]]
  assert [float(one['total']) for one in held] == pytest.approx([2.1, -2.1])
  assert [float(one['factor']) for one in held] == [0.5, 0.5]
  # No more are held than start a trial, and the others are left out as well.
  sifted = gate.sift(_transition([9.0] * 5), _observation(5), 8)
  assert not sifted['is_valid'].any()
  assert len(gate.state()['held']) == 4


def test_both_copies_divide_readings_by_the_same_scale():
  # The scale of the gate is that of the time when it opened.
  gate = _gate(1, alarms=1)
  gate._scale = 10.0
  gate.learn(lambda: {}, 99.0, 'kept', 10)
  gate.sift(_transition([5.0]), _observation(1), 0)
  samples = {
      'observation': {k: v[None] for k, v in _observation(4).items()},
      'action': np.zeros((1, 4), np.int32),
      'total': np.full((1, 4), 2.0, np.float32),
      'factor': np.zeros((1, 4), np.float32),
      'later': {k: v[None] for k, v in _observation(4).items()},
      'weight': np.ones((1, 4), np.float32),
  }
  mixed = []
  gate.decide(
      'networks', _observation(1), lambda *a: mixed.append(a[2](samples))
  )
  assert mixed[0]['total'].tolist() == [[5.0, 2.0, 2.0, 2.0]]


def test_a_quarter_of_each_minibatch_is_what_was_held_back():
  gate = _opened(3, alarms=3)
  gate.sift(_transition([3.0, 4.0, 5.0]), _observation(3), 0)
  samples = {
      'observation': {
          'thing': np.full((2, 8), 2, np.int32),
          'registers/feedback': np.zeros((2, 8), np.float32),
      },
      'action': np.zeros((2, 8), np.int32),
      'total': np.zeros((2, 8), np.float32),
      'factor': np.zeros((2, 8), np.float32),
      'later': {
          'thing': np.full((2, 8), 2, np.int32),
          'registers/feedback': np.zeros((2, 8), np.float32),
      },
      'weight': np.zeros((2, 8), np.float32),
  }
  seen = []

  def train(trained, number, changed):
    seen.append((number, changed(samples)))
    return trained

  gate.decide('networks', _observation(3), train)
  assert gate.is_trying
  (number, mixed), (other, plain) = seen
  assert number == other == 4
  assert plain is samples
  # They take turns.
  assert mixed['total'].tolist() == [[3, 4] + [0] * 6, [5, 3] + [0] * 6]
  assert mixed['action'].tolist() == [[0, 1] + [0] * 6, [2, 0] + [0] * 6]
  assert mixed['weight'].tolist() == [[1, 1] + [0] * 6] * 2
  assert mixed['observation']['thing'].tolist() == [[0, 0] + [2] * 6] * 2


@pytest.mark.parametrize(
    ('convinced', 'others', 'is_accepted'),
    [(1.0, 0.5, True), (0.5, 0.5, True), (0.5, 1.0, False)],
)
def test_the_copy_that_earns_more_by_the_model_goes_on(
    monkeypatch, convinced, others, is_accepted
):
  # Worlds 1 and 3 are those of the copy with unexpected readings. Two steps
  # count 1 + 0.5, and the value after them 0.25.
  gate = _opened(4, alarms=2, trial_steps=2)
  gate.sift(_transition([3.0, 0.0, 0.0, 3.0]), _observation(4), 5)
  trained, _ = gate.decide('plain', _observation(4), lambda *arguments: 'both')
  assert gate.is_trying
  predictions = np.array([others, convinced, others, convinced])
  monkeypatch.setattr(gate, '_predicted', lambda transition: predictions)
  monkeypatch.setattr(gates, '_values', lambda *unused: np.full((4, 3), 8.0))
  for number in (6, 7):
    assert gate.is_trying
    sifted = gate.sift(_transition([9.0] * 4), _observation(4), number)
    assert not sifted['is_valid'].any()
    trained, accepted = gate.decide(trained, _observation(4), None)
  assert not gate.is_trying
  assert trained == 'both'
  where = [one.tolist() for one in accepted]
  assert where == ([[5, 0], [5, 3]] if is_accepted else [])
  kind = 'accepted' if is_accepted else 'refused'
  assert gate.metrics[f'gate_{kind}'] == 2
  assert gate.metrics['gate_gradients'] == 8
  assert gate.metrics['gate_trial_steps'] == 2 * 4
  assert gate.metrics['gate_unexpected'] == 2 + 2 * 4
  assert gate.state()['held'] == []


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
      if one._gate.is_trying and not is_twin:
        other.set_state(one.state())
        assert other._gate.is_trying
        is_twin = True
  assert is_twin
  assert trees.are_equal(one.state(), other.state())
  assert one.metrics()['gate_trials'] >= 2


@pytest.mark.parametrize(
    ('gate', 'message'),
    [
        ({'threshold': -1.0, 'fit_steps': 9}, 'gate.threshold: '),
        ({'threshold': 1.0, 'fit_steps': 0}, 'gate.fit_steps: '),
        (
            {
                'threshold': 1.0,
                'fit_steps': 9,
                'trusted': {**_WORKER, 'clone_steps': 5},
            },
            'trusted.clone_steps: 5; allowed is 0',
        ),
        ({'threshold': 1.0}, 'gate.fit_steps: required key is missing'),
        (
            {'threshold': 1.0, 'fit_steps': 9, 'injected': 0.5},
            'gate.injected: ',
        ),
        (
            {
                'threshold': 1.0,
                'fit_steps': 9,
                'trusted': {'policy': 'apple_seeker'},
            },
            "learner.gate.trusted.policy 'apple_seeker': has the actions of"
            ' dmlab_like v1',
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
