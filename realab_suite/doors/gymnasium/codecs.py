"""Spaces of Gymnasium for specs of dm_env, and conversion of their values."""

from collections.abc import Mapping
from typing import Any, final

from dm_env import specs
from gymnasium import spaces
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import appearance

# Gymnasium's checker warns about infinite bounds.
_LARGEST = float(np.finfo(np.float32).max)

Observation = dict[str, np.ndarray] | np.ndarray


def key_of(name: str) -> str:
  """Returns the key in Gymnasium's observations, which have no slashes."""
  return name.replace('/', '_')


@final
class ObservationCodec:
  """Converts observations of one world or of a batch.

  Entries of dict observations:

  - Integers with up to `appearance.CAPACITY` values are classes:
    `MultiDiscrete`, from 0. Gymnasium and Stable-Baselines3 encode them as
    one-hot.
  - Images are `Box` of uint8.
  - Other numbers are `Box` of floats, with at least one axis.

  A flat observation is a vector of floats, in which classes are one-hot. It
  equals that of Gymnasium's `FlattenObservation`, but all worlds are computed
  together.
  """

  def __init__(
      self, observation_spec: Mapping[str, specs.Array], flat: bool = False
  ) -> None:
    """Initializes the codec.

    Args:
      observation_spec: Observation spec of one world.
      flat: True for flat observations.
    """
    self._flat = flat
    self._names = {key_of(name): name for name in sorted(observation_spec)}
    self._parts = {
        key: _part(observation_spec[name]) for key, name in self._names.items()
    }
    self._lows = {
        key: int(np.min(observation_spec[name].minimum))
        for key, name in self._names.items()
        if isinstance(self._parts[key], spaces.MultiDiscrete)
    }
    self.space: spaces.Space[Any] = spaces.Dict(self._parts)
    if flat:
      box: Any = spaces.flatten_space(self.space)
      low, high = (bound.astype(np.float32) for bound in (box.low, box.high))
      self.space = spaces.Box(low, high)

  def encode(
      self, observation: Mapping[str, np.ndarray], lead: tuple[int, ...] = ()
  ) -> Observation:
    """Returns an observation as an element of `space`, or a batch of them.

    Args:
      observation: Arrays by name, each `(*lead, *spec.shape)`.
      lead: `()` for one world, `(worlds,)` for a batch.
    """
    encoded = {
        key: self._encode(key, observation[name], lead)
        for key, name in self._names.items()
    }
    if not self._flat:
      return encoded
    vectors = [
        self._vector(key, value).reshape(*lead, -1)
        for key, value in encoded.items()
    ]
    return np.concatenate(vectors, axis=-1).astype(np.float32, copy=False)

  def _encode(
      self, key: str, value: np.ndarray, lead: tuple[int, ...]
  ) -> np.ndarray:
    part = self._parts[key]
    low = self._lows.get(key, 0)
    shifted = value - low if low else value
    return np.array(shifted, part.dtype).reshape(*lead, *(part.shape or ()))

  def _vector(self, key: str, value: np.ndarray) -> np.ndarray:
    part = self._parts[key]
    if not isinstance(part, spaces.MultiDiscrete):
      return value
    num_classes = int(part.nvec.flat[0])
    one_hot: np.ndarray = np.eye(num_classes, dtype=np.float32)[value]
    return one_hot


def _part(spec: specs.Array) -> spaces.Space[Any]:
  """Returns the space of one entry of an observation."""
  kind = np.dtype(spec.dtype).kind
  shape = spec.shape or (1,)
  is_bounded = isinstance(spec, specs.BoundedArray)
  low = spec.minimum if is_bounded else -_LARGEST
  high = spec.maximum if is_bounded else _LARGEST
  if spec.dtype == np.uint8 and len(shape) == 3:
    return spaces.Box(0, 255, shape, np.uint8)
  if kind in 'iu' and is_bounded:
    num_classes = int(np.max(high)) - int(np.min(low)) + 1
    if num_classes <= appearance.CAPACITY:
      # Of 16 bits: Gymnasium's flattening then keeps 32-bit floats, and sums of
      # the numbers of classes, as in Stable-Baselines3, do not overflow.
      return spaces.MultiDiscrete(np.full(shape, num_classes), dtype=np.int16)
  low, high = (
      np.broadcast_to(np.clip(one, -_LARGEST, _LARGEST), shape)
      for one in (low, high)
  )
  return spaces.Box(low.astype(np.float32), high.astype(np.float32), shape)


@final
class ActionCodec:
  """Converts actions of one world or of a batch.

  `space` is `Discrete` if an action is an index, `MultiDiscrete` if it consists
  of indices (queries and the action), and `Box` otherwise.
  """

  def __init__(self, action_spec: specs.Array) -> None:
    """Initializes the codec.

    Args:
      action_spec: Action spec of one world.
    """
    self._spec = action_spec
    self.space: spaces.Space[Any]
    if isinstance(action_spec, specs.DiscreteArray):
      self.space = spaces.Discrete(action_spec.num_values)
    elif np.dtype(action_spec.dtype).kind in 'iu':
      start = np.asarray(action_spec.minimum, np.int64)
      number = np.asarray(action_spec.maximum, np.int64) - start + 1
      self.space = spaces.MultiDiscrete(number, start=start)
    else:
      low, high = (
          np.broadcast_to(one, action_spec.shape).astype(np.float32)
          for one in (action_spec.minimum, action_spec.maximum)
      )
      self.space = spaces.Box(low, high)

  def decode(self, action: Any) -> Any:
    """Returns actions of `space` as actions of the environment.

    Actions outside the space stay invalid.
    """
    if not isinstance(self.space, spaces.Box):
      return action
    try:
      values = np.asarray(action)
    except Exception:  # `__array__` may raise anything.
      return action
    trailing = values.shape[-1:]
    if values.dtype.kind not in 'iuf' or trailing != self.space.shape:
      return action
    exact = np.array(values, np.float64)
    # Rounding to 32 bits may move a bound outwards.
    for rounded, bound in (
        (self.space.low, self._spec.minimum),
        (self.space.high, self._spec.maximum),
    ):
      exact = np.where(values == rounded, bound, exact)
    return exact


def reward_key(
    reward_register: str | None, observation_spec: Mapping[str, specs.Array]
) -> str | None:
  """Returns the entry of the observation that is the reward, or `None`.

  Args:
    reward_register: Name of a register that the agent reads, or `None`.
    observation_spec: Observation spec of one world.

  Raises:
    SpecError: If the agent does not read such a register.
  """
  if reward_register is None:
    return None
  prefix = 'registers/'
  readable = [
      name.removeprefix(prefix)
      for name in observation_spec
      if name.startswith(prefix)
  ]
  if reward_register not in readable:
    raise errors.SpecError(
        f'reward_register: {messages.quote(reward_register)}; must be None'
        f' or one of the registers that the agent reads: {readable}'
    )
  return prefix + reward_register
