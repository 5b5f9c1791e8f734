"""Trained supervisors in NumPy: a policy and a value function of a network.

The shipped network was trained on the secure twin of reward learning, from the
true reward, which a supervisor may use (paper, sections 2.2 and 3.1). Its
inputs are the senses of an agent, without readings of registers.
"""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.config import option_types
from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import network_files
from realab_suite.policies import random_keys
from realab_suite.policies import recollections

# Distance at which the feature of a ray's hit falls to 1 / e, metres.
_RAY_SCALE = 2.0
_SENSES = 'senses/'


class _NetworkReader(base.Reader, abc.ABC):
  """Base class for policies and value functions that a network computes."""

  def __init__(
      self,
      weights: (
          option_types.FilePath | network_files.Network
      ) = 'demonstrator_v1',
  ) -> None:
    """Makes the policy or the value function.

    Args:
      weights: Name of a network that ships with the package, path of a file, or
        a network.

    Raises:
      SpecError: If the network cannot be loaded.
    """
    self._network = network_files.load(weights)
    names = [feature.name for feature in self._network.header.features]
    # Keys of what it remembers, and of the readings of which it does.
    self._recalls = {
        name: reading
        for name in names
        if (reading := recollections.reading_of(name)) is not None
    }

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._network.header.actions()

  @property
  def required_senses(self) -> tuple[str, ...]:
    keys = [
        key
        for feature in self._network.header.features
        for key in (feature.name, feature.partner)
    ]
    if self._recalls:
      keys.extend(recollections.SENSES)
    senses = [
        key.removeprefix(_SENSES) for key in keys if key.startswith(_SENSES)
    ]
    return tuple(dict.fromkeys(senses))

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    if not self._recalls:
      return ()
    return {key: recollections.initial(batch_shape) for key in self._recalls}

  def _outputs(
      self, observation: base.Observation, start: np.ndarray, state: Any
  ) -> tuple[np.ndarray, Any]:
    """Returns the outputs of the network, and the next state.

    Raises:
      SpecError: If an input is missing from the observation, or of what it
        remembers.
    """
    for reading in self._recalls.values():
      base.check_senses(
          'network', (reading, *recollections.SENSES), observation, 'observed'
      )
    state = {
        key: recollections.recall(observation, reading, start, state[key])
        for key, reading in self._recalls.items()
    } or state
    seen = {**observation, **state} if state else observation
    return outputs(self._network, seen, np.shape(start)), state


@base.POLICIES.add('network_demonstrator')
@final
class NetworkDemonstrator(_NetworkReader, base.Policy):
  """Takes the action with the largest output of a network.

  It remembers what its network takes as an input, and nothing else, so that
  agents without memory can imitate one that takes no `recollections`.
  """

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    values, state = self._outputs(observation, episode_start, state)
    return np.asarray(values.argmax(axis=-1)), state


@final
class NetworkAgent(_NetworkReader, base.Policy):
  """Draws actions with the probabilities of a network, as learners do.

  It is an agent and no supervisor, so it has no name in the registry.
  """

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    values, state = self._outputs(observation, episode_start, state)
    weights = np.exp(values - values.max(axis=-1, keepdims=True), dtype=float)
    sums = weights.cumsum(axis=-1)
    draws = random_keys.uniform(key)[..., np.newaxis] * sums[..., -1:]
    # Rounded, a draw may be the whole sum; the last action is then taken.
    return (draws >= sums[..., :-1]).sum(axis=-1), state


@base.VALUE_FUNCTIONS.add('network_values')
@final
class NetworkValues(_NetworkReader, base.ValueFunction):
  """Values actions by the log-probabilities of a trained policy.

  The values are scaled linearly: 1 for the best action, -1 for the worst.
  Because the policy was trained with an entropy bonus, its log-probabilities
  approximate advantages. A learner that maximises these values in each step
  alone takes the actions of the policy, which was trained on whole returns.
  """

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    values, state = self._outputs(observation, episode_start, state)
    low = values.min(axis=-1, keepdims=True)
    high = values.max(axis=-1, keepdims=True)
    # With equal outputs, all actions have the best value.
    spread = np.where(high > low, high - low, np.inf)
    return (1.0 - 2.0 * (high - values) / spread).astype(float), state


def outputs(
    network: network_files.Network,
    observation: base.Observation,
    lead: tuple[int, ...],
) -> np.ndarray:
  """Returns the outputs of a network, `(..., actions)`, float32.

  Each world is a matrix product of its own. The last bits of a product depend
  on the number of rows, so a common product would make the outputs of a world
  depend on the number of worlds.

  Args:
    network: Network.
    observation: Observation; leading axes are worlds.
    lead: Shape of the leading axes.

  Raises:
    SpecError: If an input is missing from the observation or has another shape.
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
  """Returns the features of `lab/agents/features.py`, `(..., features)`.

  Args:
    features: Encodings of parts of the observation, in order.
    observation: Observation; leading axes are worlds.
    lead: Shape of the leading axes.

  Raises:
    SpecError: If a part is missing from the observation or has another shape.
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
  return np.arcsinh(value) if feature.kind == 'reading' else value


def _take(
    observation: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    dtype: type[np.generic],
) -> np.ndarray:
  if name not in observation:
    raise errors.SpecError(
        f'network: observation {name!r} is missing; given are'
        f' {sorted(observation)}'
    )
  value = np.asarray(observation[name], dtype)
  if value.shape != shape:
    raise errors.SpecError(
        f'network: {name!r} has shape {value.shape}; must be {shape}'
    )
  return value
