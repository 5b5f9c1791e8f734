"""Tests of estimators: advantages, scales, and gradients from approval."""

import hypothesis
from hypothesis import strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from realab_suite.lab.agents import approval
from realab_suite.lab.agents import policy_gradient
from realab_suite.lab.agents import q_learning
from realab_suite.lab.agents import training

_ACTIONS = 4


def _batch(**columns: list) -> dict[str, np.ndarray]:
  """One world, by time."""
  batch = {
      'reading': columns['reading'],
      'discount': columns.get('discount', [1.0] * 4),
      'is_valid': columns.get('is_valid', [True] * 4),
  }
  return {name: np.array(x)[:, np.newaxis] for name, x in batch.items()}


# gamma = 0.5 and lambda = 0.5 throughout; worked by hand.
@pytest.mark.parametrize(
    ('columns', 'expected'),
    [
        # Errors 1 + 4/2 - 2 = 1, 0 + 6/2 - 4 = -1, 2 + 8/2 - 6 = 0,
        # 4 + 2/2 - 8 = -3; each later one counts a quarter.
        ({}, [0.703125, -1.1875, -0.75, -3.0]),
        # It ended with the second step: that step's error is 0 - 4.
        (
            {
                'discount': [1.0, 0.0, 1.0, 1.0],
                'is_valid': [True, True, False, True],
            },
            [0.0, -4.0, 0.0, -3.0],
        ),
        # It was cut off there: the value of the last observation, 6, counts.
        ({'is_valid': [True, True, False, True]}, [0.75, -1.0, 0.0, -3.0]),
        # A reset in the middle: the second action has no effect.
        ({'is_valid': [True, False, True, True]}, [1.0, 0.0, -0.75, -3.0]),
    ],
)
def test_advantages_equal_those_worked_out_by_hand(columns, expected):
  values = np.array([[2.0], [4.0], [6.0], [8.0], [2.0]])
  batch = _batch(reading=[1.0, 0.0, 2.0, 4.0], **columns)
  got = policy_gradient.advantages(batch, values[:-1], values[1:], 0.5, 0.5)
  np.testing.assert_allclose(got[:, 0], expected)


def test_feedback_is_scaled_by_the_deviation_of_its_discounted_sum():
  scale = training.FeedbackScale(num_envs=1, gamma=0.5)
  assert scale.value == 1.0
  scale.update(
      _batch(reading=[4.0, 2.0, 7.0, 1.0], is_valid=[True, True, False, True])
  )
  # The sums are 4, 4 and, in the next episode, 1.
  assert scale.value == pytest.approx(np.std([4.0, 4.0, 1.0]), rel=1e-3)


_numbers = st.floats(-3.0, 3.0, width=32)
_logits = st.lists(_numbers, min_size=_ACTIONS, max_size=_ACTIONS)


def _expected_update(logits, approvals, corruption, queries) -> np.ndarray:
  """The exact mean of the estimator over all actions and queries.

  Args:
    logits: Logits of the policy, in one state.
    approvals: The value that the supervisor writes about each action.
    corruption: The value that each *executed* action adds to it.
    queries: 0 if the action taken is asked about, or 1 or 2 drawn
      independently.
  """
  log_probs = np.asarray(jax.nn.log_softmax(jnp.asarray(logits)), np.float64)
  axes = [np.arange(_ACTIONS)] * (1 + queries)
  drawn = np.stack(np.meshgrid(*axes, indexing='ij'), -1)
  drawn = drawn.reshape(-1, 1 + queries)
  probability = np.exp(log_probs[drawn].sum(axis=1))
  executed, asked = drawn[:, 0], drawn[:, 1:] if queries else drawn
  said = approvals[asked[:, 0]]
  if queries == 2:
    said = said - approvals[asked[:, 1]]
  return np.asarray(
      _gradient(
          np.array(logits),
          probability,
          asked,
          log_probs[asked],
          said + corruption[executed],
      )
  )


@jax.jit
@jax.grad
def _gradient(logits, probability, asked, old_log_prob, feedback):
  """The gradient of the objective, each case with its probability."""
  log_probs = jnp.broadcast_to(
      jax.nn.log_softmax(logits), (len(asked), _ACTIONS)
  )
  objective = approval.policy_objective(
      log_probs, asked, old_log_prob, feedback, 0.2
  )
  return jnp.sum(probability * objective)


_any_case = hypothesis.given(
    logits=_logits, approvals=_logits, corruption=_logits
)
_settings = hypothesis.settings(max_examples=15, deadline=None)


@pytest.mark.parametrize('queries', [1, 2])
@_any_case
@_settings
def test_corruption_by_actions_does_not_bias_decoupled_approval(
    queries, logits, approvals, corruption
):
  approvals, corruption = np.array(approvals), np.array(corruption)
  honest = _expected_update(logits, approvals, 0 * corruption, queries)
  corrupted = _expected_update(logits, approvals, corruption, queries)
  np.testing.assert_allclose(corrupted, honest, atol=2e-5)
  # It equals the policy gradient of the mean approval.
  pi = np.exp(np.asarray(jax.nn.log_softmax(jnp.asarray(logits)), float))
  np.testing.assert_allclose(
      honest, pi * (approvals - pi @ approvals), atol=2e-5
  )


@_any_case
@_settings
def test_corruption_by_actions_biases_coupled_approval(
    logits, approvals, corruption
):
  approvals, corruption = np.array(approvals), np.array(corruption)
  honest = _expected_update(logits, approvals, 0 * corruption, 0)
  corrupted = _expected_update(logits, approvals, corruption, 0)
  pi = np.exp(np.asarray(jax.nn.log_softmax(jnp.asarray(logits)), float))
  bias = pi * (corruption - pi @ corruption)
  np.testing.assert_allclose(corrupted - honest, bias, atol=2e-5)


def test_corruption_redirects_a_coupled_update():
  corruption = np.array([0.0, 0.0, 0.0, 2.0])
  approvals = np.array([1.0, 0.0, 0.0, 0.0])
  flat = np.zeros(_ACTIONS)
  assert _expected_update(flat, approvals, corruption, 0).argmax() == 3
  assert _expected_update(flat, approvals, corruption, 1).argmax() == 0


def test_sums_of_readings_stop_at_the_end_of_an_episode():
  """Every third step of a world's life is looked at, by hand."""
  replay = {
      'observation': {'x': np.arange(8)[:, np.newaxis]},
      'choice': {'action': np.arange(8)[:, np.newaxis]},
      'reading': np.array([1, 2, 4, 8, 16, 32, 64, 128.0])[:, np.newaxis],
      'discount': np.array([1, 1, 0, 1, 1, 1, 1, 1.0])[:, np.newaxis],
      'is_valid': np.array([1, 1, 1, 0, 1, 1, 0, 1], bool)[:, np.newaxis],
  }
  options = q_learning.QLearningOptions(
      kind='q_learning', reward='r', gamma=0.5, num_returns=2, minibatch=400
  )
  begin = q_learning.draw(options, replay, 8, np.random.default_rng(0))
  samples = q_learning.samples_at(options, replay, *begin)
  got = {}
  for action, total, factor, later, weight in zip(
      samples['action'].ravel(),
      samples['total'].ravel(),
      samples['factor'].ravel(),
      samples['later']['x'].ravel(),
      samples['weight'].ravel(),
      strict=True,
  ):
    got[int(action)] = (total, factor, int(later), weight)
  assert got == {
      0: (1 + 2 / 2, 0.25, 2, 1),
      1: (2 + 4 / 2, 0.0, 3, 1),  # It ended: nothing is to come.
      2: (4, 0.0, 3, 1),
      3: (0, 1.0, 3, 0),  # The action was ignored.
      4: (16 + 32 / 2, 0.25, 6, 1),  # Cut off, after what 6 was chosen on.
      5: (32, 0.5, 6, 1),
  }
