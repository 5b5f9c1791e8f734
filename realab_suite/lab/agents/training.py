"""Shared parts of learners: batches, minibatches, optimiser, scale."""

import abc
from collections.abc import Callable
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import jax_settings

Loss = Callable[[Any, Any], tuple[jax.Array, dict[str, jax.Array]]]


class OnPolicyOptions(base.Options):
  """Options of on-policy learners.

  Attributes:
    steps_per_update: Number of steps of each world between updates.
    epochs: Number of times an update uses each sample.
    minibatch: Approximate number of samples per gradient.
  """

  steps_per_update: base.Positive = 32
  epochs: base.Positive = 4
  minibatch: base.Positive = 2048


class OnPolicyLearner(base.Learner):
  """Learns from the last `steps_per_update` steps of every world."""

  @jax_settings.pinned()
  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    self._transitions: list[dict[str, Any]] = []
    # Myopic learners have no discount: the scale is that of single readings.
    gamma = getattr(self._options, 'gamma', 0.0)
    self._scale = FeedbackScale(self._num_envs, gamma)
    generator = base.generator_of(self._keys['initial'])
    self.networks = self._initial_networks(generator)

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    self._transitions.append(transition)
    if len(self._transitions) < self._options.steps_per_update:
      return
    batch = jax.tree.map(lambda *x: np.stack(x), *self._transitions)
    self._transitions = []
    metrics = self._learn(batch, observation)
    self._num_updates += 1
    reading, is_valid = batch['reading'], batch['is_valid']
    observed = np.mean(reading, where=is_valid) if is_valid.any() else 0.0
    self._report({**metrics, 'observed_feedback': observed})

  def _draw_minibatches(self) -> np.ndarray:
    """Draws the sample indices of the next update, `(gradients, minibatch)`.

    An epoch uses each sample once, except for the remainder if the number of
    samples is not a multiple of the number of minibatches. NumPy draws the
    indices, because it is faster than jax.
    """
    number = self._num_envs * self._options.steps_per_update
    num_minibatches = max(1, number // self._options.minibatch)
    size = number // num_minibatches
    generator = base.generator_of(self.update_key())
    orders = [
        generator.permutation(number) for _ in range(self._options.epochs)
    ]
    used = np.stack(orders)[:, : num_minibatches * size]
    return used.reshape(-1, size).astype(np.int32)

  def _memory(self) -> dict[str, Any]:
    return {'transitions': self._transitions, 'scale': self._scale.state()}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    self._transitions = memory['transitions']
    self._scale.set_state(memory['scale'])

  @abc.abstractmethod
  def _initial_networks(self, generator: np.random.Generator) -> Any:
    """Returns the initial networks and the initial state of the optimiser."""

  @abc.abstractmethod
  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    """Updates the networks with a batch, and returns metrics by name.

    Args:
      batch: Transitions, each array `(time, worlds, ...)`.
      observation: Packed observation after the last transition.
    """


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


def run_epochs(
    options: base.Options,
    loss: Loss,
    trained: Any,
    data: Any,
    indices: Any,
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes one gradient step for each minibatch.

  Args:
    options: Options of the optimiser.
    loss: Function from a network and a minibatch to a loss and metrics.
    trained: A network and the optimiser's state.
    data: A pytree of arrays, each `(time, worlds, ...)`.
    indices: Sample indices of minibatches, `(gradients, minibatch)`.

  Returns:
    The new network and optimiser's state, and the means of the metrics.
  """
  samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

  def one_step(carry: Any, index: jax.Array) -> Any:
    minibatch = jax.tree.map(lambda x: x[index], samples)
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
      totals = sums[is_valid]
      self._moments += (len(totals), totals.sum(), (totals**2).sum())
      self._sums = np.where(is_valid, sums, 0.0)

  def state(self) -> dict[str, np.ndarray]:
    """Returns the statistics as plain data."""
    return {'sums': self._sums, 'moments': self._moments}

  def set_state(self, state: dict[str, np.ndarray]) -> None:
    """Continues from a state that `state` returned."""
    self._sums, self._moments = state['sums'], state['moments']
