"""Shared parts of learners: optimiser, minibatches, advantages, scaling."""

from collections.abc import Callable
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite.agents import base

Loss = Callable[[Any, Any], tuple[jax.Array, dict[str, jax.Array]]]


def optimizer(options: base.Options) -> optax.GradientTransformation:
  """Returns the Adam optimiser with clipping of gradient norms."""
  return optax.chain(
      optax.clip_by_global_norm(options.max_gradient_norm),
      optax.adam(options.learning_rate, eps=1e-5),
  )


def descend(
    options: base.Options, loss: Loss, trained: Any, data: Any
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes one gradient step.

  Args:
    options: Options of the optimiser.
    loss: Function from a network and data to a loss and metrics.
    trained: A network and the optimiser's state.
    data: Minibatch, a pytree of arrays.

  Returns:
    The new network and optimiser's state, and the metrics.
  """
  network, optimizer_state = trained
  gradient, metrics = jax.grad(loss, has_aux=True)(network, data)
  updates, optimizer_state = optimizer(options).update(
      gradient, optimizer_state
  )
  return (optax.apply_updates(network, updates), optimizer_state), metrics


def exploration(options: Any, num_steps: int) -> np.float32:
  """Returns the current probability of a random action.

  It falls linearly from 1 to `options.exploration`.

  Args:
    options: Options with `exploration` and `exploration_steps`.
    num_steps: Number of control steps so far, summed over worlds.
  """
  spent = min(num_steps / options.exploration_steps, 1.0)
  return np.float32(1.0 + spent * (options.exploration - 1.0))


def draw_minibatches(
    options: Any, num_samples: int, key: np.ndarray
) -> np.ndarray:
  """Draws the sample indices of minibatches, `(gradients, minibatch)`.

  An epoch uses each sample once, except for the remainder if the number of
  samples is not a multiple of the number of minibatches. NumPy draws the
  indices, because it is faster than jax.

  Args:
    options: Options with `epochs` and `minibatch`.
    num_samples: Number of samples.
    key: Random key.
  """
  num_minibatches = max(1, num_samples // options.minibatch)
  size = num_samples // num_minibatches
  generator = np.random.Generator(np.random.Philox(key=key.astype(np.uint64)))
  orders = [generator.permutation(num_samples) for _ in range(options.epochs)]
  used = np.stack(orders)[:, : num_minibatches * size]
  return used.reshape(-1, size).astype(np.int32)


def run_epochs(
    options: base.Options,
    loss: Loss,
    trained: Any,
    data: Any,
    indices: Any,
    by_world: bool = False,
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes one gradient step for each minibatch.

  Args:
    options: Options of the optimiser.
    loss: Function from a network and a minibatch to a loss and metrics.
    trained: A network and the optimiser's state.
    data: A pytree of arrays, each `(time, worlds, ...)`.
    indices: Sample indices from `draw_minibatches`, `(gradients, minibatch)`.
    by_world: True if they are indices of worlds, of which minibatches contain
      all steps: `(time, minibatch, ...)`.

  Returns:
    The new network and optimiser's state, and the means of the metrics.
  """
  samples = data
  if not by_world:
    samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

  def one_step(carry: Any, index: jax.Array) -> Any:
    chosen = (slice(None), index) if by_world else index
    minibatch = jax.tree.map(lambda x: x[chosen], samples)
    return descend(options, loss, carry, minibatch)

  trained, metrics = jax.lax.scan(one_step, trained, indices)
  return trained, jax.tree.map(jnp.mean, metrics)


def mean(x: jax.Array, weight: jax.Array) -> jax.Array:
  """Returns the mean of the elements with weight 1; 0 if there are none."""
  return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def standardize(x: jax.Array, weight: jax.Array) -> jax.Array:
  """Returns x minus its weighted mean, divided by its standard deviation."""
  centered = x - mean(x, weight)
  return centered / (jnp.sqrt(mean(centered**2, weight)) + 1e-8)


def clipped_objective(
    log_ratio: jax.Array, advantage: jax.Array, clip: float
) -> jax.Array:
  """Returns PPO's clipped objective of each sample.

  Args:
    log_ratio: Logarithm of new over old probability of each action.
    advantage: Advantage of each action.
    clip: Largest change of a probability ratio that raises the objective.
  """
  ratio = jnp.exp(log_ratio)
  clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
  return jnp.minimum(ratio * advantage, clipped * advantage)


def advantages(
    batch: dict[str, jax.Array],
    values: jax.Array,
    next_values: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
  """Returns generalised advantage estimates, `(time, worlds)`.

  The value of the last observation estimates the rest of a truncated episode
  (discount 1). A terminated episode has no further value (discount 0).

  Args:
    batch: `reading`, `discount` and `is_valid` of the step after each choice,
      each `(time, worlds)`. The step that begins an episode is not valid.
    values: Values of the observations, `(time, worlds)`.
    next_values: Values of the observations one step later, `(time, worlds)`.
    gamma: Discount of the learner.
    gae_lambda: Decay of the estimates.
  """
  discount = gamma * batch['discount']
  errors = batch['reading'] + discount * next_values - values

  def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
    error, factor, is_valid = now
    # An ignored action has no outcome, and separates two episodes.
    advantage = jnp.where(is_valid, error + factor * later, 0.0)
    return advantage, advantage

  _, estimates = jax.lax.scan(
      back,
      jnp.zeros_like(values[0]),
      (errors, discount * gae_lambda, batch['is_valid']),
      reverse=True,
  )
  return estimates


def mean_and_deviation(moments: np.ndarray) -> tuple[float, float]:
  """Returns mean and standard deviation, from number, sum and sum of squares.

  Fewer than two numbers have the mean 0 and the deviation 1.
  """
  count, total, squares = moments
  if count < 2:
    return 0.0, 1.0
  variance = squares / count - (total / count) ** 2
  return float(total / count), float(np.sqrt(max(variance, 0.0)) + 1e-4)


@final
class FeedbackScale:
  """Running standard deviation of the discounted sum of feedback.

  Learners divide feedback by it. Without that, an agent whose feedback is a sum
  of rare apples does not learn; one that holds a register displaced gets a
  thousand times more feedback.
  """

  def __init__(self, num_envs: int, gamma: float) -> None:
    """Makes a scale.

    Args:
      num_envs: Number of worlds.
      gamma: Discount of the sum; 0 for single readings.
    """
    self._gamma = gamma
    self._sums = np.zeros(num_envs)
    # Count, sum and sum of squares of all sums so far.
    self._moments = np.zeros(3)

  @property
  def value(self) -> float:
    """Divisor of the feedback."""
    return mean_and_deviation(self._moments)[1]

  def update(self, batch: dict[str, np.ndarray]) -> None:
    """Updates the scale with the transitions of a batch.

    Args:
      batch: Arrays with `reading` and `is_valid`, each `(time, worlds)`.
    """
    for reading, is_valid in zip(
        batch['reading'], batch['is_valid'], strict=True
    ):
      sums = self._gamma * self._sums + reading
      known = sums[is_valid]
      self._moments += (len(known), known.sum(), (known**2).sum())
      self._sums = np.where(is_valid, sums, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    """Returns the statistics as plain data."""
    return {'sums': self._sums, 'moments': self._moments}

  def set_state(self, state: dict[str, np.ndarray]) -> None:
    """Continues from a state that `state` returned."""
    self._sums, self._moments = state['sums'], state['moments']
