"""Training: optimiser, minibatches, the scale of feedback, advantages."""

from collections.abc import Callable
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite.agents import base

Loss = Callable[[Any, Any], tuple[jax.Array, dict[str, jax.Array]]]


def optimizer(options: base.Options) -> optax.GradientTransformation:
  """Returns Adam, with the length of gradients limited."""
  return optax.chain(
      optax.clip_by_global_norm(options.max_gradient_norm),
      optax.adam(options.learning_rate, eps=1e-5),
  )


def descend(
    options: base.Options, loss: Loss, trained: Any, data: Any
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes one step of gradient descent; returns what `run_epochs` does."""
  network, optimizer_state = trained
  gradient, metrics = jax.grad(loss, has_aux=True)(network, data)
  updates, optimizer_state = optimizer(options).update(
      gradient, optimizer_state
  )
  return (optax.apply_updates(network, updates), optimizer_state), metrics


def exploration(options: Any, num_steps: int) -> np.float32:
  """Returns how often an action is drawn at random now.

  Args:
    options: Options with `exploration` and `exploration_steps`.
    num_steps: How many control steps there have been, of all worlds together.
  """
  spent = min(num_steps / options.exploration_steps, 1.0)
  return np.float32(1.0 + spent * (options.exploration - 1.0))


def draw_minibatches(
    options: Any, num_samples: int, key: np.ndarray
) -> np.ndarray:
  """Draws which samples go into which gradient, `(gradients, minibatch)`.

  In NumPy, which is faster at it than jax.

  Args:
    options: Options with `epochs` and `minibatch`.
    num_samples: How many samples there are; each is used once in an epoch, but
      for the few that are left over if the numbers do not divide.
    key: A random key.
  """
  num_minibatches = max(1, num_samples // options.minibatch)
  size = num_samples // num_minibatches
  generator = np.random.Generator(np.random.Philox(key=key.astype(np.uint64)))
  orders = [generator.permutation(num_samples) for _ in range(options.epochs)]
  used = np.stack(orders)[:, : num_minibatches * size]
  return used.reshape(-1, size).astype(np.int32)


def run_epochs(
    options: base.Options, loss: Loss, trained: Any, data: Any, indices: Any
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes a step of gradient descent for each minibatch.

  Args:
    options: How fast.
    loss: From a network and a minibatch to a loss and metrics.
    trained: A network and the optimiser's state.
    data: A pytree of arrays, `(time, worlds, ...)`.
    indices: What `draw_minibatches` returned.

  Returns:
    What is trained now, and the means of the metrics.
  """
  samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

  def one_step(carry: Any, index: jax.Array) -> Any:
    minibatch = jax.tree.map(lambda x: x[index], samples)
    return descend(options, loss, carry, minibatch)

  trained, metrics = jax.lax.scan(one_step, trained, indices)
  return trained, jax.tree.map(jnp.mean, metrics)


def mean(x: jax.Array, weight: jax.Array) -> jax.Array:
  """The mean of what has weight 1; 0 if nothing has."""
  return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def standardize(x: jax.Array, weight: jax.Array) -> jax.Array:
  """Returns x less its mean, over its standard deviation."""
  centered = x - mean(x, weight)
  return centered / (jnp.sqrt(mean(centered**2, weight)) + 1e-8)


def clipped_objective(
    log_ratio: jax.Array, advantage: jax.Array, clip: float
) -> jax.Array:
  """PPO's objective: no gain from leaving the old policy far behind."""
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
  """Generalized advantage estimates, `(time, worlds)`.

  Where an episode was cut off (the last step, discount 1) the value of what was
  seen last stands for the rest; where it ended (discount 0), nothing does.

  Args:
    batch: `reading`, `discount` and `is_valid` of what came of each choice,
      `(time, worlds)`; the step after an episode's last one is not valid.
    values: Of the observations.
    next_values: Of the observations one step later.
    gamma: The learner's own discount.
    gae_lambda: How much later errors of the value count.
  """
  discount = gamma * batch['discount']
  errors = batch['reading'] + discount * next_values - values

  def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
    error, factor, is_valid = now
    # Nothing came of an ignored action, and nothing before it depends on it.
    advantage = jnp.where(is_valid, error + factor * later, 0.0)
    return advantage, advantage

  _, estimates = jax.lax.scan(
      back,
      jnp.zeros_like(values[0]),
      (errors, discount * gae_lambda, batch['is_valid']),
      reverse=True,
  )
  return estimates


@final
class FeedbackScale:
  """The running standard deviation of the discounted sum of feedback.

  Without it an agent whose feedback is a sum of rare apples learns nothing: one
  that holds a register off its place gets a thousand times more.
  """

  def __init__(self, num_envs: int, gamma: float) -> None:
    self._gamma = gamma
    self._sums = np.zeros(num_envs)
    # Count, sum and sum of squares of what the sums have been.
    self._moments = np.zeros(3)

  @property
  def value(self) -> float:
    """What to divide feedback by."""
    count, total, squares = self._moments
    if count < 2:
      return 1.0
    variance = squares / count - (total / count) ** 2
    return float(np.sqrt(max(variance, 0.0)) + 1e-4)

  def update(self, batch: dict[str, np.ndarray]) -> None:
    """Takes in readings and what came with them, `(time, worlds)`."""
    for reading, is_valid in zip(
        batch['reading'], batch['is_valid'], strict=True
    ):
      sums = self._gamma * self._sums + reading
      known = sums[is_valid]
      self._moments += (len(known), known.sum(), (known**2).sum())
      self._sums = np.where(is_valid, sums, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    return {'sums': self._sums, 'moments': self._moments}

  def set_state(self, state: dict[str, np.ndarray]) -> None:
    self._sums, self._moments = state['sums'], state['moments']
