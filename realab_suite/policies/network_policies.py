"""Supervisors that were trained: a demonstrator and an adviser, in NumPy.

Their network was trained on the secure twin of reward learning, from the true
reward, which a supervisor may know (paper, sections 2.2 and 3.1). It sees the
senses of an agent and no reading of a register.
"""

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.config import option_types
from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import network_files

# How far off a ray's hit is worth 1 / e of one that touches, metres.
_RAY_SCALE = 2.0


@base.POLICIES.add('network_demonstrator')
@final
class NetworkDemonstrator(base.Policy):
  """Takes the action that a network finds best, by what is seen now.

  It remembers nothing, so what it shows can be imitated by who does not either.
  """

  def __init__(
      self,
      weights: (
          option_types.FilePath | network_files.Network
      ) = 'demonstrator_v1',
  ) -> None:
    """Makes the policy.

    Args:
      weights: The name of a network that ships with the package, the path of a
        file, or a network.

    Raises:
      SpecError: If there is no such network.
    """
    self._network = network_files.load(weights)

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._network.header.actions()

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    values = outputs(self._network, observation, np.shape(episode_start))
    return np.asarray(values.argmax(axis=-1)), state


@base.VALUE_FUNCTIONS.add('network_values')
@final
class NetworkValues(base.ValueFunction):
  """Values actions from 1, for the best, down to -1, for the worst.

  What is between is in proportion to the logarithms of the probabilities that a
  trained policy gives to actions. With its bonus for entropy a policy takes an
  action the more often, the more is to be gained by it, so these stand for its
  advantages. A learner that maximises them in every step by itself does what
  the policy, which looks ahead, finds best.
  """

  def __init__(
      self,
      weights: (
          option_types.FilePath | network_files.Network
      ) = 'demonstrator_v1',
  ) -> None:
    """Makes the value function; arguments are those of the demonstrator."""
    self._network = network_files.load(weights)

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._network.header.actions()

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    values = outputs(self._network, observation, np.shape(episode_start))
    low = values.min(axis=-1, keepdims=True)
    high = values.max(axis=-1, keepdims=True)
    # A network that finds all actions alike has no advice.
    spread = np.where(high > low, high - low, np.inf)
    return (1.0 - 2.0 * (high - values) / spread).astype(float), state


def outputs(
    network: network_files.Network,
    observation: base.Observation,
    lead: tuple[int, ...],
) -> np.ndarray:
  """Returns what a network gives for each action, `(..., actions)`, float32.

  Every world is multiplied by itself: the last bits of a product of matrices
  depend on how many rows there are, and so would those of a world on whether it
  is alone.

  Args:
    network: The network.
    observation: What is seen; leading axes are worlds.
    lead: The shape of these axes.

  Raises:
    SpecError: If it needs something that is not seen, or not in that shape.
  """
  x = encode(network.header.features, observation, lead)[..., np.newaxis, :]
  last = len(network.weights) - 1
  layers = zip(network.weights, network.biases, strict=True)
  for i, (weight, bias) in enumerate(layers):
    x = np.matmul(x, weight) + bias
    if i < last:
      x = np.tanh(x)
  return x[..., 0, :]


def encode(
    features: Sequence[network_files.Feature],
    observation: base.Observation,
    lead: tuple[int, ...],
) -> np.ndarray:
  """Returns features as `agents/features.py` does, `(..., features)`.

  Args:
    features: How parts of the observation are shown, in their order.
    observation: What is seen; leading axes are worlds.
    lead: The shape of these axes.

  Raises:
    SpecError: If something is not seen, or not in that shape.
  """
  parts = []
  for feature in features:
    shown = _show(feature, observation, (*lead, *feature.shape))
    parts.append(shown.reshape(*lead, feature.size).astype(np.float32))
  return np.concatenate(parts, axis=-1)


def _show(
    feature: network_files.Feature,
    observation: Mapping[str, np.ndarray],
    shape: tuple[int, ...],
) -> np.ndarray:
  """Returns the features of one part of an observation."""
  if feature.kind in ('one_hot', 'rays'):
    index = _take(observation, feature.name, shape, np.int32)
    values = np.arange(int(feature.low), int(feature.high) + 1, dtype=np.int32)
    shown = index[..., np.newaxis] == values
    if feature.kind == 'one_hot':
      return shown
    distance = _take(observation, feature.partner, shape, np.float32)
    return shown * np.exp(-distance / _RAY_SCALE)[..., np.newaxis]
  value = _take(observation, feature.name, shape, np.float32)
  if feature.kind == 'scaled':
    return 2.0 * (value - feature.low) / (feature.high - feature.low) - 1.0
  return value


def _take(
    observation: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    dtype: type[np.generic],
) -> np.ndarray:
  if name not in observation:
    raise errors.SpecError(
        f'network: {name!r} is not seen here; given are {sorted(observation)}'
    )
  value = np.asarray(observation[name], dtype)
  if value.shape != shape:
    raise errors.SpecError(
        f'network: {name!r} has shape {value.shape}, expected {shape}'
    )
  return value
