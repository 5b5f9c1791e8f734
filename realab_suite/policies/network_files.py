"""Files of small networks: arrays and a header of JSON, and nothing to run.

A file is a `.npz` archive without pickles. Its header says how a network sees,
what its outputs stand for, how it was made and what it reaches.
"""

from collections.abc import Sequence
import dataclasses
import hashlib
from importlib import resources
import io
import json
import math
import os
from typing import Annotated, Any, Literal, final
import zipfile
import zlib

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import validation
from realab_suite.policies import action_sets

_HEADER = 'header'
_MAX_BYTES = 2**22
_Count = Annotated[int, pydantic.Field(ge=1, le=2**16)]
_Sizes = Annotated[tuple[_Count, ...], pydantic.Field(strict=False)]
_Texts = Annotated[tuple[str, ...], pydantic.Field(strict=False)]
_Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]


class _Part(pydantic.BaseModel):
  """Frozen; unknown keys and lossy conversions are errors."""

  model_config = pydantic.ConfigDict(frozen=True, extra='forbid', strict=True)


@final
class Feature(_Part):
  """How one part of an observation is shown, as in `agents/features.py`.

  Attributes:
    name: Its key in the observation.
    kind: How it becomes features.
    shape: Its shape in one world.
    low: Its lowest value, where it has one.
    high: Its highest value, where it has one.
    partner: For rays, the key of the distances.
  """

  name: str
  kind: Literal['plain', 'scaled', 'one_hot', 'rays']
  shape: _Sizes
  low: _Finite = 0.0
  high: _Finite = 0.0
  partner: str = ''

  @pydantic.model_validator(mode='after')
  def _bounded(self) -> 'Feature':
    if self.kind != 'plain' and not 0 < self.high - self.low <= 2**10:
      raise ValueError(f'low {self.low:g} and high {self.high:g} do not fit')
    if (self.kind == 'rays') != bool(self.partner):
      raise ValueError('rays, and nothing else, have a partner')
    return self

  @property
  def size(self) -> int:
    """How many numbers it becomes."""
    is_one_of_many = self.kind in ('one_hot', 'rays')
    values = int(self.high - self.low) + 1 if is_one_of_many else 1
    return math.prod(self.shape) * values


@final
class Reached(_Part):
  """A mean true return, with its interval over episodes.

  Attributes:
    task: Where, as in `unlock_door.near`.
    mean: The mean.
    low: The lower bound of the interval.
    high: Its upper bound.
    level: The share of such intervals that should contain the mean.
    episodes: How many episodes there were, one in each world of a batch.
    seed: The seed of the batch.
  """

  task: str
  mean: _Finite
  low: _Finite
  high: _Finite
  level: _Finite
  episodes: _Count
  seed: int


@final
class Made(_Part):
  """How a network was made.

  Attributes:
    learner: The options of the learner.
    task: Where it learned.
    design: The agent design that it learned in.
    overrides: What was changed in the design.
    design_digest: The digest of the changed design.
    num_envs: How many worlds it learned in.
    steps: For how many control steps, all worlds together.
    seed: Of the learner and of the worlds.
    versions: Of what it was made with, by name.
  """

  learner: dict[str, Any]
  task: str
  design: str
  overrides: _Texts
  design_digest: str
  num_envs: _Count
  steps: int
  seed: int
  versions: dict[str, str]


@final
class Header(_Part):
  """What is known of a network.

  Attributes:
    format: The version of this format.
    outputs: What the outputs are: the logarithms of the probabilities of
      actions, but for what they have in common.
    description: What it does, in a sentence.
    action_set: The name of the action set that the outputs are of.
    action_set_version: Its version.
    features: What it sees, in the order of its inputs.
    hidden: The widths of the hidden layers.
    made: How it was made.
    reached: What comes of taking the best action in every step.
  """

  format: Literal[1] = 1
  outputs: Literal['log_probabilities']
  description: str
  action_set: str
  action_set_version: int
  features: Annotated[
      tuple[Feature, ...], pydantic.Field(strict=False, min_length=1)
  ]
  hidden: _Sizes
  made: Made
  reached: Annotated[tuple[Reached, ...], pydantic.Field(strict=False)]

  @pydantic.model_validator(mode='after')
  def _known(self) -> 'Header':
    try:
      self.actions()
    except errors.UnknownNameError as error:
      raise ValueError(str(error)) from error
    return self

  def actions(self) -> action_sets.ActionSet:
    """Returns the action set that the outputs are of."""
    return action_sets.get(self.action_set, self.action_set_version)

  def sizes(self) -> list[int]:
    """Returns the width of every layer, the inputs' and outputs' included."""
    inputs = sum(feature.size for feature in self.features)
    return [inputs, *self.hidden, len(self.actions())]


@final
@dataclasses.dataclass(frozen=True)
class Network:
  """A network, as its file holds it.

  Attributes:
    header: What is known of it.
    weights: For each layer, `(inputs, outputs)`, float32.
    biases: For each layer, `(outputs,)`, float32.
  """

  header: Header
  weights: tuple[np.ndarray, ...]
  biases: tuple[np.ndarray, ...]

  def digest(self) -> str:
    """Returns the SHA-256 of all that it is."""
    canonical = json.dumps(
        self.header.model_dump(mode='json'),
        sort_keys=True,
        separators=(',', ':'),
    )
    digest = hashlib.sha256(canonical.encode())
    for weight, bias in zip(self.weights, self.biases, strict=True):
      digest.update(weight.tobytes() + bias.tobytes())
    return digest.hexdigest()

  def to_bytes(self) -> bytes:
    """Returns what `load` reads from a file."""
    content = {**self.header.model_dump(mode='json'), 'sha256': self.digest()}
    text = json.dumps(content, indent=1).encode()
    arrays = {_HEADER: np.frombuffer(text, np.uint8)}
    for i, layer in enumerate(zip(self.weights, self.biases, strict=True)):
      arrays.update(zip(_names(i), layer, strict=True))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


Weights = str | os.PathLike[str] | Network


def load(weights: Weights) -> Network:
  """Loads a network.

  Args:
    weights: The name of one that ships with the package, or a path; a network
      is returned as it is.

  Raises:
    SpecError: If there is no such file, or it does not hold a network.
  """
  if isinstance(weights, Network):
    return weights
  if not isinstance(weights, str | os.PathLike):
    raise errors.SpecError(
        f'weights: {weights!r:.80}; allowed are a path and {list(NETWORKS)}'
    )
  if weights in NETWORKS:
    where = f'{weights}.npz'
    return from_bytes((_FOLDER / where).read_bytes(), where)
  path = os.fsdecode(weights)
  place = messages.Location(path)
  if not os.path.isfile(path):
    raise errors.UnknownNameError(
        f'weights {messages.quote(path)} are neither a file nor one of'
        f' {list(NETWORKS)}'
    )
  try:
    with open(path, 'rb') as stream:
      data = stream.read(_MAX_BYTES + 1)
  except OSError as error:
    raise place.error(f'cannot be read: {error.strerror}') from error
  return from_bytes(data, path)


def from_bytes(data: bytes, where: str) -> Network:
  """Returns the network of a file.

  Args:
    data: What the file holds.
    where: What error messages call it.

  Raises:
    SpecError: If that is no network, or not all of it.
  """
  place = messages.Location(where)
  arrays = _read_archive(data, place)
  text = arrays.pop(_HEADER, np.zeros(0)).tobytes()
  try:
    content = json.loads(text)
  except (ValueError, RecursionError) as error:
    raise place.error(f'not a network: header: {error}') from error
  if not isinstance(content, dict):
    raise place.error('not a network: header: must be a mapping')
  digest = content.pop('sha256', None)
  header = validation.validate(Header, content, where)
  network = Network(header, *_layers(arrays, header.sizes(), place))
  if network.digest() != digest:
    raise place.error(
        f'damaged: SHA-256 {network.digest()}; the header says {digest!r:.80}'
    )
  return network


def _read_archive(
    data: bytes, place: messages.Location
) -> dict[str, np.ndarray]:
  """Returns the arrays of an archive that is no larger than networks are."""
  too_large = place.error(f'larger than the {_MAX_BYTES} bytes of a network')
  if len(data) > _MAX_BYTES:
    raise too_large
  try:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
      size = sum(info.file_size for info in archive.infolist())
    if size > _MAX_BYTES:
      raise too_large
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
      return {name: np.asarray(arrays[name]) for name in arrays.files}
  except errors.SpecError:
    raise
  # What is damaged may ask for more memory than there is, or for a password.
  except (
      ValueError,
      OSError,
      EOFError,
      MemoryError,
      RuntimeError,
      zipfile.BadZipFile,
      zlib.error,
  ) as error:
    raise place.error(f'not a network: {error}') from error


def _layers(
    arrays: dict[str, np.ndarray],
    sizes: Sequence[int],
    place: messages.Location,
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
  """Returns weights and biases, checked against the widths of layers."""
  num_layers = len(sizes) - 1
  expected: dict[str, tuple[int, ...]] = {}
  for i in range(num_layers):
    weight, bias = _names(i)
    expected |= {weight: (sizes[i], sizes[i + 1]), bias: (sizes[i + 1],)}
  if arrays.keys() != expected.keys():
    raise place.error(
        f'holds {sorted(arrays)}; its header describes {sorted(expected)}'
    )
  for name, shape in expected.items():
    array = arrays[name]
    if array.shape != shape or array.dtype != np.float32:
      raise place.error(
          f'{name}: {array.dtype} of shape {array.shape}; its header describes'
          f' float32 of shape {shape}'
      )
    if not np.isfinite(array).all():
      raise place.error(f'{name}: not all numbers are finite')
  return tuple(
      tuple(
          np.ascontiguousarray(arrays[_names(i)[j]]) for i in range(num_layers)
      )
      for j in range(2)
  )  # type: ignore[return-value]


def _names(layer: int) -> tuple[str, str]:
  return f'weight_{layer}', f'bias_{layer}'


_FOLDER = resources.files('realab_suite.configs') / 'networks'
NETWORKS: tuple[str, ...] = tuple(
    sorted(
        path.name.removesuffix('.npz')
        for path in _FOLDER.iterdir()
        if path.name.endswith('.npz')
    )
)
"""Names of the networks that ship with the package."""
