"""Encoding of observations as features of networks, from specs alone."""

from collections.abc import Collection, Mapping
import dataclasses
from typing import Any, Literal, final

from dm_env import specs
import jax
import jax.numpy as jnp
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance

# Distance at which the feature of a ray has fallen to 1 / e, in metres.
_RAY_SCALE = 2.0
_DISTANCES, _CLASSES = 'ray_distances', 'ray_classes'

Packed = dict[str, np.ndarray]
Kind = Literal['plain', 'scaled', 'reading', 'one_hot', 'image', 'rays']


@final
@dataclasses.dataclass(frozen=True)
class _Entry:
  """Encoding of one entry of an observation.

  Attributes:
    name: Key of the entry in the observation.
    kind: Kind of encoding.
    shape: Shape of the entry in one world.
    dtype: Data type in which the entry is stored.
    low: Lower bound, for kinds that need one.
    high: Upper bound, for kinds that need one.
    partner: Key of the distances, for rays.
    values: Values that have a feature each, for rays and one-hot encodings.
  """

  name: str
  kind: Kind
  shape: tuple[int, ...]
  dtype: str
  low: float = 0.0
  high: float = 0.0
  partner: str = ''
  values: tuple[int, ...] = ()


@final
@dataclasses.dataclass(frozen=True)
class Encoder:
  """Encodes observations as a feature vector and unchanged images.

  Rays become the one-hot class of the object they hit, times a factor that
  decreases with its distance. Readings of registers are transformed by arcsinh,
  because they are unbounded if a block can be carried away. Integers with few
  values become one-hot. Other bounded numbers are scaled to [-1, 1].

  Classes of objects have a feature for each code that their spec lists, or for
  each code within the bounds if it lists none. Most of the codes that are
  reserved never occur, and features for them would almost double the time of an
  update.

  Attributes:
    entries: Encoding of each entry of the observation.
  """

  entries: tuple[_Entry, ...]

  @classmethod
  def from_spec(
      cls, observation_spec: Mapping[str, specs.Array], frame_stack: int = 1
  ) -> 'Encoder':
    """Makes the encoder for observations of a spec.

    Args:
      observation_spec: Observation spec of one world.
      frame_stack: Number of images that are stacked on the channels of one.

    Raises:
      SpecError: If an entry is not numeric, or there is no image to stack.
    """
    rays = {
        name: partner
        for name, spec in observation_spec.items()
        if (partner := _partner(name, spec, observation_spec)) is not None
    }
    entries = [
        _entry(name, spec, rays.get(name, ''), frame_stack)
        for name, spec in observation_spec.items()
        if name not in rays.values()
    ]
    encoder = cls(tuple(entries))
    if frame_stack > 1 and not encoder.image_shapes:
      raise errors.SpecError(
          f'learner.frame_stack: {frame_stack}; must be 1, because no entry'
          f' of the observation is an image: {sorted(observation_spec)}'
      )
    return encoder

  @property
  def image_shapes(self) -> dict[str, tuple[int, ...]]:
    """Height, width and channels of every image, or of a stack, by name."""
    return {e.name: e.shape for e in self.entries if e.kind == 'image'}

  @property
  def names(self) -> tuple[str, ...]:
    """Keys of observations that are encoded."""
    partners = (e.partner for e in self.entries if e.partner)
    return (*(e.name for e in self.entries), *partners)

  @property
  def vector_size(self) -> int:
    """Number of features, excluding images."""
    return sum(
        int(np.prod(entry.shape)) * (len(entry.values) or 1)
        for entry in self.entries
        if entry.kind != 'image'
    )

  def pack(self, observation: Mapping[str, Any], num_envs: int) -> Packed:
    """Checks an observation of a batch, and copies the entries to encode.

    Args:
      observation: Observations by name, each `(worlds, ...)`.
      num_envs: Number of worlds.

    Raises:
      SpecError: If an entry is missing or has another shape than in the spec.
    """
    packed = {}
    for entry in self.entries:
      shape = (num_envs, *entry.shape)
      packed[entry.name] = _take(observation, entry.name, shape, entry.dtype)
      if entry.partner:
        packed[entry.partner] = _take(
            observation, entry.partner, shape, 'float32'
        )
    return packed

  def encode(self, packed: Mapping[str, Any]) -> dict[str, jax.Array]:
    """Returns `vector`, `(..., vector_size)`, and images by name.

    Args:
      packed: Result of `pack`, or a stack of such results; entries may have any
        number of leading axes.
    """
    parts = [jnp.zeros((*_lead(packed, self.entries), 0), jnp.float32)]
    encoded = {}
    for entry in self.entries:
      value = jnp.asarray(packed[entry.name])
      if entry.kind == 'image':
        encoded[entry.name] = value
        continue
      lead = value.shape[: value.ndim - len(entry.shape)]
      part = _features(entry, value, packed)
      parts.append(part.reshape(*lead, -1).astype(jnp.float32))
    return {'vector': jnp.concatenate(parts, axis=-1), **encoded}


def key_of(register: str, observation: Collection[str]) -> str | None:
  """Returns the key of the reading of a register; `None` if there is none.

  Args:
    register: Name of the register.
    observation: Keys of observations.
  """
  keys = (f'registers/{register}', register)
  return next((key for key in keys if key in observation), None)


def find_key(where: str, register: str, observation: Collection[str]) -> str:
  """Returns the key of the reading of a register, which must exist.

  Args:
    where: Location of the name of the register, for the message.
    register: Name of the register.
    observation: Keys of observations.

  Raises:
    SpecError: If there is no such reading.
  """
  if (key := key_of(register, observation)) is None:
    raise errors.SpecError(
        f'{where}: the agent does not read {register!r}; this environment has'
        f' {sorted(observation)}'
    )
  return key


def _features(
    entry: _Entry, value: jax.Array, packed: Mapping[str, Any]
) -> jax.Array:
  """Returns the features of one entry of an observation."""
  if entry.kind in ('one_hot', 'rays'):
    is_equal = value[..., jnp.newaxis] == jnp.array(entry.values)
    one_hot = is_equal.astype(jnp.float32)
    if entry.kind == 'rays':
      distance = jnp.asarray(packed[entry.partner])
      one_hot *= jnp.exp(-distance / _RAY_SCALE)[..., jnp.newaxis]
    return one_hot
  if entry.kind == 'scaled':
    return 2.0 * (value - entry.low) / (entry.high - entry.low) - 1.0
  if entry.kind == 'reading':
    return jnp.arcsinh(value)
  return value


def _lead(
    packed: Mapping[str, Any], entries: tuple[_Entry, ...]
) -> tuple[int, ...]:
  """Returns the leading axes: worlds, and time if there is such an axis."""
  shape = np.shape(packed[entries[0].name])
  return shape[: len(shape) - len(entries[0].shape)]


def _take(
    observation: Mapping[str, Any],
    name: str,
    shape: tuple[int, ...],
    dtype: str,
) -> np.ndarray:
  """Returns a copy of one entry of an observation, if it has the shape."""
  if name not in observation:
    raise errors.SpecError(
        f'observation: {name!r} is missing; it has {sorted(observation)}'
    )
  value = np.array(observation[name], dtype)
  if value.shape != shape:
    raise errors.SpecError(
        f'observation {name!r}: shape {value.shape}, expected {shape}'
    )
  return value


def _partner(
    name: str,
    spec: specs.Array,
    observation_spec: Mapping[str, specs.Array],
) -> str | None:
  """Returns the key of the distances for an entry of ray classes, if any."""
  if not name.endswith(_CLASSES) or not isinstance(spec, specs.BoundedArray):
    return None
  partner = name.removesuffix(_CLASSES) + _DISTANCES
  array = observation_spec.get(partner)
  return partner if array is not None and array.shape == spec.shape else None


def _entry(
    name: str, spec: specs.Array, partner: str, frame_stack: int
) -> _Entry:
  """Returns the encoding of one entry of an observation spec.

  Raises:
    SpecError: If the entry is not numeric.
  """
  dtype = np.dtype(spec.dtype)
  if dtype.kind not in 'biuf':
    raise errors.SpecError(
        f'observation_spec {name!r}: dtype {dtype}; must be numeric'
    )
  if dtype == np.uint8 and len(spec.shape) == 3:
    *size, channels = spec.shape
    return _Entry(name, 'image', (*size, channels * frame_stack), 'uint8')
  if name.startswith('registers/'):
    return _Entry(name, 'reading', spec.shape, 'float32')
  low, high = -np.inf, np.inf
  if isinstance(spec, specs.BoundedArray):
    low, high = float(np.min(spec.minimum)), float(np.max(spec.maximum))
  if partner:
    values = _values(spec, low, high)
    return _Entry(name, 'rays', spec.shape, 'int32', low, high, partner, values)
  if not (np.isfinite([low, high]).all() and low < high):
    return _Entry(name, 'plain', spec.shape, 'float32')
  if dtype.kind in 'iu' and high - low < appearance.CAPACITY:
    values = _values(spec, low, high)
    return _Entry(name, 'one_hot', spec.shape, 'int32', low, high, '', values)
  return _Entry(name, 'scaled', spec.shape, 'float32', low, high)


def _values(spec: specs.Array, low: float, high: float) -> tuple[int, ...]:
  """Returns the values of an integer that have a feature each."""
  if isinstance(spec, appearance.ClassArray):
    return spec.codes
  return tuple(range(int(low), int(high) + 1))
