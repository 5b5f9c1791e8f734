"""Files of small networks: arrays and a JSON header, without code.

A file is a `.npz` archive without pickles. Its header describes the inputs and
outputs of a network, its training and its true return. `network_policies`
computes the outputs.
"""

import dataclasses
import hashlib
import io
import itertools
import json
import math
import os
from typing import Annotated, Any, Literal, final
import zipfile

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import documents
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import validation
from realab_suite.policies import action_sets

_HEADER = 'header'
_MAX_BYTES = 2**22
_Count = Annotated[int, pydantic.Field(ge=1, le=2**16)]
_Sizes = Annotated[tuple[_Count, ...], pydantic.Field(strict=False)]
_Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]


@final
class Feature(validation.Model):
  """Encoding of one part of an observation, as in `lab/agents/features.py`.

  Attributes:
    name: Key in the observation.
    kind: Kind of the encoding; a reading of a register becomes its arcsinh.
    shape: Shape in one world.
    low: Lowest value, if the part is bounded.
    high: Highest value, if the part is bounded.
    partner: Key of the distances, for rays.
  """

  name: str
  kind: Literal['plain', 'scaled', 'reading', 'one_hot', 'rays']
  shape: _Sizes
  low: _Finite = 0.0
  high: _Finite = 0.0
  partner: str = ''

  @pydantic.model_validator(mode='after')
  def _bounded(self) -> 'Feature':
    is_bounded = self.kind not in ('plain', 'reading')
    if is_bounded and not 0 < self.high - self.low <= 2**10:
      raise ValueError(f'low {self.low:g} and high {self.high:g} do not fit')
    if (self.kind == 'rays') != bool(self.partner):
      raise ValueError('partner: required for rays, and only for them')
    return self

  @property
  def size(self) -> int:
    """Number of inputs that the part becomes."""
    is_one_of_many = self.kind in ('one_hot', 'rays')
    values = int(self.high - self.low) + 1 if is_one_of_many else 1
    return math.prod(self.shape) * values


@final
class Header(validation.Model):
  """Header of a file: description of a network.

  Attributes:
    format: Version of this format.
    outputs: Kind of the outputs: logarithms of the probabilities of actions, up
      to a common constant.
    description: Description of the network, in a sentence.
    action_set: Name of the action set of the outputs.
    action_set_version: Version of the action set.
    features: Encoded parts of the observation, in the order of the inputs.
    hidden: Widths of the hidden layers.
    made: Record of the training, as plain data: the learner, the task, the
      design, the steps, the seed and the versions of packages.
    reached: True returns of the policy, as plain data: the task, the mean with
      its interval, and the episodes. It takes the best action, unless `actions`
      in `made` is 'sampled'.
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
  made: dict[str, Any]
  reached: Annotated[tuple[dict[str, Any], ...], pydantic.Field(strict=False)]

  @pydantic.model_validator(mode='after')
  def _known(self) -> 'Header':
    self.actions()
    return self

  def actions(self) -> action_sets.ActionSet:
    """Returns the action set of the outputs."""
    return action_sets.get(self.action_set, self.action_set_version)

  def sizes(self) -> list[int]:
    """Returns the width of every layer, including inputs and outputs."""
    inputs = sum(feature.size for feature in self.features)
    return [inputs, *self.hidden, len(self.actions())]


@final
@dataclasses.dataclass(frozen=True)
class Network:
  """Network in a file.

  Attributes:
    header: Description of the network.
    weights: Weights of each layer, `(inputs, outputs)`, float32.
    biases: Biases of each layer, `(outputs,)`, float32.
  """

  header: Header
  weights: tuple[np.ndarray, ...]
  biases: tuple[np.ndarray, ...]

  def digest(self) -> str:
    """Returns the SHA-256 of the header and the arrays."""
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
    """Returns the contents of a file that `load` reads."""
    content = {**self.header.model_dump(mode='json'), 'sha256': self.digest()}
    text = json.dumps(content, indent=1).encode()
    arrays = {_HEADER: np.frombuffer(text, np.uint8)}
    for i, weight in enumerate(self.weights):
      arrays |= {f'weight_{i}': weight, f'bias_{i}': self.biases[i]}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


Weights = str | os.PathLike[str] | Network

_FILES = documents.shipped('networks', '.npz')
NETWORKS: tuple[str, ...] = tuple(_FILES)
"""Names of the networks that ship with the package."""


def load(weights: Weights) -> Network:
  """Loads a network.

  Args:
    weights: Name of a network that ships with the package, or a path. A network
      is returned unchanged.

  Raises:
    SpecError: If the file is missing or does not contain a network.
  """
  if isinstance(weights, Network):
    return weights
  if not isinstance(weights, str | os.PathLike):
    raise errors.SpecError(
        f'weights: {weights!r:.80}; must be a path or one of {list(NETWORKS)}'
    )
  path = os.fsdecode(weights)
  if path in _FILES:
    return from_bytes(_FILES[path].read_bytes(), f'{path}.npz')
  if not os.path.isfile(path):
    raise errors.UnknownNameError(
        f'weights {messages.quote(path)} are neither a file nor one of'
        f' {list(NETWORKS)}'
    )
  return from_bytes(loading.read_file(path, _MAX_BYTES), path)


def from_bytes(data: bytes, where: str) -> Network:
  """Returns the network of a file.

  Args:
    data: Contents of the file.
    where: Name of the file in error messages.

  Raises:
    SpecError: If the contents are not a complete network.
  """
  location = messages.Location(where)
  try:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
      if sum(info.file_size for info in archive.infolist()) > _MAX_BYTES:
        raise ValueError(f'larger than {_MAX_BYTES} bytes')
    with np.load(io.BytesIO(data), allow_pickle=False) as files:
      arrays = {name: np.ascontiguousarray(files[name]) for name in files}
    content = dict(json.loads(arrays.pop(_HEADER).tobytes()))
  except Exception as error:  # Damage raises errors of many libraries.
    raise location.error(f'not a network: {error}') from error
  digest = content.pop('sha256', None)
  header = validation.validate(Header, content, where)
  expected: dict[str, tuple[int, ...]] = {}
  for i, (inputs, outputs) in enumerate(itertools.pairwise(header.sizes())):
    expected |= {f'weight_{i}': (inputs, outputs), f'bias_{i}': (outputs,)}
  shapes = {
      name: array.shape
      for name, array in arrays.items()
      if array.dtype == np.float32 and np.isfinite(array).all()
  }
  if shapes != expected or len(arrays) > len(expected):
    raise location.error(
        f'contains {sorted(arrays)}, with finite float32 of shapes {shapes};'
        f' its header describes {expected}'
    )
  layers = range(len(expected) // 2)
  network = Network(
      header,
      tuple(arrays[f'weight_{i}'] for i in layers),
      tuple(arrays[f'bias_{i}'] for i in layers),
  )
  if network.digest() != digest:
    raise location.error(
        f'damaged: SHA-256 {network.digest()}; the header has {digest!r:.80}'
    )
  return network
