"""Ensembles of networks that predict rewards, from readings or comparisons.

Their samples are spans of several consecutive steps, also across batches.
"""

from collections.abc import Mapping
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training

# Weight of squared rewards beside the loss of comparisons, which determine them
# up to a constant, and up to a factor if they never contradict each other.
_SHRINKAGE = 0.01
# A smaller `beta` is 0: in float32, one would divide by 0.
_LEAST_BETA = 1e-30


def make(
    encoder: features.Encoder,
    options: base.Options,
    number: int,
    num_more: int,
    generator: np.random.Generator,
) -> Any:
  """Returns networks, stacked on a leading axis, and their optimisers' states.

  They begin with predictions that differ by about 1, and so go on to disagree
  where nothing teaches them better. `num_more` is that of `networks.Network`.
  """
  each = [
      networks.Network(encoder, options.hidden, 1, 1.0, generator, num_more)
      for _ in range(number)
  ]
  stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
  return stacked, jax.vmap(training.optimizer(options).init)(stacked)


def soft_least(values: np.ndarray, beta: float | None) -> np.ndarray:
  """Returns -beta log mean exp(-values / beta) over the leading axis.

  Args:
    values: Prediction of each network, `(networks, ...)`.
    beta: 0 for the least, larger numbers towards the mean, `None` for the mean.
  """
  if beta is None:
    return values.mean(axis=0)
  least = values.min(axis=0)
  if beta < _LEAST_BETA:
    return least
  with np.errstate(over='ignore'):
    shares = np.expm1((least - values) / beta)
  return least - beta * np.log1p(shares.mean(axis=0))


@jax.jit
def predict(trained: Any, data: dict[str, jax.Array]) -> jax.Array:
  """Returns the prediction of each network for features, `(networks, ...)`."""
  return jax.vmap(lambda network: network(data)[..., 0])(trained[0])


def fit(
    options: base.Options,
    trained: Any,
    data: dict[str, Any],
    ends: np.ndarray,
    targets: np.ndarray,
    span: int,
    shape: tuple[int, int, int],
    key: np.ndarray,
) -> Any:
  """Takes gradient steps, and returns the networks and optimisers' states.

  Args:
    options: Options of the optimiser.
    trained: Networks and the states of their optimisers.
    data: Features, each `(span - 1 + time, worlds, ...)`.
    ends: Last step of each sample, an index of the flattened `(time, worlds)`.
    targets: The reward of each sample, or the probability that its later half
      is the better one.
    span: Number of steps of a sample: 1 for rewards, otherwise two clips.
    shape: Number of gradient steps, of networks, and of samples of each.
    key: Random key, two numbers.
  """
  generator = base.generator_of(key)
  drawn = generator.integers(len(ends), size=shape)
  samples = ends[drawn].astype(np.int32), targets[drawn].astype(np.float32)
  return _descend(options, span, trained, data, samples)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _descend(
    options: base.Options, span: int, trained: Any, data: Any, samples: Any
) -> Any:
  # `data` begins so early that the last step of a sample, as an index of the
  # batch, is its first one as an index of `flat`.
  offsets = np.arange(span) * data['vector'].shape[1]
  flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

  def loss(network: Any, sample: Any) -> Any:
    steps, target = sample[0][:, jnp.newaxis] + offsets, sample[1]
    rewards = network(jax.tree.map(lambda x: x[steps], flat))[..., 0]
    if span == 1:
      value = jnp.mean((rewards[:, 0] - target) ** 2)
    else:
      earlier, later = jnp.split(rewards, 2, axis=1)
      # The log-odds of Bradley and Terry.
      odds = later.sum(axis=1) - earlier.sum(axis=1)
      value = jnp.mean(jax.nn.softplus(odds) - target * odds)
      value += _SHRINKAGE * jnp.mean(rewards**2)
    return value, {'loss': value}

  one_step = jax.vmap(functools.partial(training.descend, options, loss))
  return jax.lax.scan(one_step, trained, samples)[0]


def initial_spans(
    encoder: features.Encoder, num_more: int, num_envs: int, span: int
) -> dict[str, Any]:
  """Returns the state of spans before the first batch.

  `num_more` is that of `networks.Network`, `span` the number of steps of a
  sample.
  """
  lead = (span - 1, num_envs)
  tail = {
      name: np.zeros((*lead, *shape), np.uint8)
      for name, shape in encoder.image_shapes.items()
  }
  size = encoder.vector_size + num_more
  tail['vector'] = np.zeros((*lead, size), np.float32)
  return {'tail': tail, 'ages': np.zeros(num_envs, int)}


def joined(
    spans: Mapping[str, Any], data: Mapping[str, Any]
) -> dict[str, np.ndarray]:
  """Returns features from `span - 1` steps before a batch on.

  Args:
    spans: Result of `initial_spans`, or of `next_spans` for the last batch.
    data: Features of the batch, each `(time, worlds, ...)`.
  """
  return {
      name: np.concatenate([before, np.asarray(data[name])])
      for name, before in spans['tail'].items()
  }


def ages_of(spans: Mapping[str, Any], is_valid: np.ndarray) -> np.ndarray:
  """Returns the number of each step of a batch in its episode, from 1.

  Args:
    spans: Same as in `joined`.
    is_valid: Same as in the batch, `(time, worlds)` bool.

  Returns:
    `(time, worlds)` int, 0 where a step is not valid.
  """
  ages, age = np.zeros(is_valid.shape, int), spans['ages']
  for t, is_outcome in enumerate(is_valid):
    ages[t] = age = np.where(is_outcome, age + 1, 0)
  return ages


def next_spans(
    features_of_spans: Mapping[str, np.ndarray], ages: np.ndarray
) -> dict[str, Any]:
  """Returns the state of spans after a batch, from `joined` and `ages_of`."""
  tail = {n: x[len(ages) :].copy() for n, x in features_of_spans.items()}
  return {'tail': tail, 'ages': ages[-1].copy()}
