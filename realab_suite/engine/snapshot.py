"""Snapshots: everything that the future of a world depends on, as plain data.

The state of an episode is physical, so most of it is one array of MuJoCo's. The
rest are numbers, texts and arrays in nested containers. No pickle is involved:
whoever reads a snapshot's bytes runs nobody's code.
"""

from collections.abc import Callable, Mapping
import hashlib
import io
import json
import math
from typing import Any, NamedTuple, Self, final
import zipfile
import zlib

import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import seeding
from realab_suite.entities import state

_FORMAT = 1
_MAGIC = b'realab_suite snapshot\n'
_STRUCTURE = 'structure'
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
# Of what differs, so many entries are named.
_MAX_NAMED = 3
# What malformed bytes can make of their readers; the checksum keeps away all
# damage that is not on purpose.
_MALFORMED = (
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)


@final
class Snapshot:
  """A world at one moment, and a header that says where it fits.

  It never changes, and can be restored any number of times.
  """

  def __init__(self, header: Mapping[str, Any], contents: Any) -> None:
    """Takes a copy of `contents`.

    Args:
      header: What an environment has to have in common with the one that was
        saved; JSON.
      contents: Tuples, lists and dicts of arrays, numbers, texts and `None`.

    Raises:
      StateLayoutError: If something else is among the contents.
    """
    self._header = json.dumps({'format': _FORMAT, **header}, sort_keys=True)
    self._arrays: list[np.ndarray] = []
    self._tree = _encode('snapshot', contents, self._arrays)

  @property
  def header(self) -> dict[str, Any]:
    """Where the snapshot fits; a copy."""
    return dict(json.loads(self._header))

  def contents_for(self, header: Mapping[str, Any]) -> Any:
    """Returns a copy of the contents, for an environment that they fit.

    Args:
      header: The environment's own.

    Raises:
      StateLayoutError: If the headers differ; the message names where.
    """
    saved = self.header
    here = json.loads(json.dumps({'format': _FORMAT, **header}))
    differing = [
        _difference(key, saved.get(key), here.get(key))
        for key in sorted(saved.keys() | here.keys())
        if saved.get(key) != here.get(key)
    ]
    if differing:
      raise errors.StateLayoutError(
          'the snapshot does not fit this environment: ' + '; '.join(differing)
      )
    return _decode(self._tree, self._arrays)

  def to_bytes(self) -> bytes:
    """Returns the snapshot for a file or another process."""
    text = f'[{self._header},{json.dumps(self._tree)}]'
    file = io.BytesIO()
    np.savez(
        file,
        allow_pickle=False,
        **{_STRUCTURE: np.frombuffer(text.encode(), np.uint8)},
        **{str(i): array for i, array in enumerate(self._arrays)},
    )
    payload = file.getvalue()
    return _MAGIC + hashlib.sha256(payload).digest() + payload

  @classmethod
  def from_bytes(cls, data: bytes) -> Self:
    """Returns the snapshot that `to_bytes` was called on.

    Raises:
      StateLayoutError: If the bytes are damaged, or of another format.
    """
    start = len(_MAGIC) + hashlib.sha256().digest_size
    payload = data[start:]
    if data[:start] != _MAGIC + hashlib.sha256(payload).digest():
      raise errors.StateLayoutError(
          f'{len(data)} bytes are no snapshot, or a damaged one; allowed is'
          ' what Snapshot.to_bytes returned'
      )
    try:
      header, contents = _read(payload)
    except _MALFORMED as error:
      raise errors.StateLayoutError(
          f'a malformed snapshot: {type(error).__name__}: {error!s:.80}'
      ) from error
    return cls(header, contents)


@final
class Worlds(NamedTuple):
  """What snapshots have in them: some worlds, each whole.

  Attributes:
    places: Where in a batch each world was; `None` for a world alone.
    physics: The integration states, `(worlds, size)`.
    seed: Of each world; what its random streams follow from. A `SaltedSeed`
      is saved with its salt.
    world: The number of each, which they follow from, too.
    episode: The number of each world's episode, -1 before the first.
    is_pending: Whether the next step of each begins an episode.
    is_open: Whether the sinks of each are waiting for the end of an episode.
    provider_keys: The keys of each provider, `(worlds, 2)`.
    provider_states: Of a batch, trees of arrays, `(worlds, ...)`; of a world
      alone, as its providers returned them.
    observation: By name, each `(worlds, ...)`; empty before the first episode.
    sinks: For each sink, its kind and what it knows of each world.
    random_state: The generator; `None` where there is none, as in a batch.
  """

  places: list[int] | None
  physics: np.ndarray
  seed: list[int]
  world: list[int]
  episode: list[int]
  is_pending: list[bool]
  is_open: list[bool]
  provider_keys: list[np.ndarray]
  provider_states: list[Any]
  observation: dict[str, np.ndarray]
  sinks: list[Any]
  random_state: dict[str, Any] | None

  def refuse_other_sinks(self, kinds: list[str]) -> None:
    """Refuses sinks that would miss how the episodes under way began.

    Args:
      kinds: What listens where the worlds are to go on.

    Raises:
      StateLayoutError: If there are sinks, and others than were saved.
    """
    saved = [kind for kind, _ in self.sinks]
    if kinds and kinds != saved:
      raise errors.StateLayoutError(
          f'the snapshot was saved with sinks {saved}; this environment has'
          f' {kinds}; allowed are the same ones, or none here'
      )


def of_batch(tree: Any) -> Any:
  """Returns a tree of one world's values as that of a batch of one."""
  return _map(lambda value: np.asarray(value)[np.newaxis], tree)


def of_world(tree: Any) -> Any:
  """Returns the tree of a batch of one as that of a world alone."""
  return _map(lambda value: np.array(value[0])[()], tree)


def spread(tree: Any, rows: np.ndarray) -> Any:
  """Returns a tree of arrays with these of their rows, in this order."""
  return _map(lambda value: value[rows], tree)


def merge(where: str, tree: Any, places: np.ndarray, saved: Any) -> Any:
  """Returns a tree of arrays whose rows at some places are others.

  Args:
    where: What to call the tree in a message.
    tree: The tree; it is not written to.
    places: The rows.
    saved: A tree with as many rows as there are places.

  Raises:
    StateLayoutError: If the trees differ in anything but the number of rows.
  """
  if type(tree) is not type(saved):
    raise _misfit(where, type(saved).__name__, type(tree).__name__)
  if isinstance(tree, dict):
    if tree.keys() != saved.keys():
      raise _misfit(where, sorted(saved), sorted(tree))
    return {
        key: merge(f'{where}[{key!r}]', value, places, saved[key])
        for key, value in tree.items()
    }
  if isinstance(tree, tuple | list):
    if len(tree) != len(saved):
      raise _misfit(where, f'of length {len(saved)}', f'of {len(tree)}')
    return type(tree)(
        merge(f'{where}[{i}]', value, places, saved[i])
        for i, value in enumerate(tree)
    )
  # Rows that stay have the last word on the type of numbers.
  is_whole = len(places) == len(tree) and not saved.dtype.hasobject
  is_like = is_whole or tree.dtype == saved.dtype
  if not is_like or tree.shape[1:] != saved.shape[1:]:
    raise _misfit(where, *(f'{x.dtype} {x.shape[1:]}' for x in (saved, tree)))
  merged = np.empty_like(saved) if is_whole else np.array(tree)
  merged[places] = saved
  return merged


def describe(model: Any) -> dict[str, Any]:
  """Returns what a snapshot's header says of a compiled model.

  Args:
    model: The model, as `physics.model`.

  Raises:
    SpecError: If MuJoCo keeps some of the state where nobody can get at it.
  """
  if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
    raise errors.SpecError(
        'a world whose bodies fall asleep cannot be saved or restored: MuJoCo'
        ' does not give away who sleeps; allowed is sleep off'
    )
  compiled = np.empty(mujoco.mj_sizeModel(model.ptr), np.uint8)
  mujoco.mj_saveModel(model.ptr, None, compiled)
  return {
      'mujoco': mujoco.__version__,
      'model': hashlib.sha256(compiled.tobytes()).hexdigest()[:16],
      'slots': state.layout(model),
  }


def get_state(physics: Any) -> np.ndarray:
  """Returns all of the physics that the future depends on."""
  model, data = physics.model.ptr, physics.data.ptr
  values = np.empty(mujoco.mj_stateSize(model, _INTEGRATION))
  mujoco.mj_getState(model, data, values, _INTEGRATION)
  return values


def set_state(physics: Any, values: np.ndarray) -> None:
  """Does the opposite of `get_state`, and brings up to date what derives."""
  model, data = physics.model.ptr, physics.data.ptr
  # Warnings of what went on here before say nothing about what is restored.
  mujoco.mj_resetData(model, data)
  mujoco.mj_setState(model, data, values, _INTEGRATION)
  physics.forward()


def _map(function: Callable[[Any], Any], tree: Any) -> Any:
  """Returns a tree of what a function makes of the values in another one."""
  if isinstance(tree, dict):
    return {key: _map(function, value) for key, value in tree.items()}
  if isinstance(tree, tuple | list):
    return type(tree)(_map(function, value) for value in tree)
  return function(tree)


def _misfit(where: str, saved: Any, here: Any) -> errors.StateLayoutError:
  return errors.StateLayoutError(
      'the snapshot does not fit this environment:'
      f' {where} is {saved!s:.60} in the snapshot, {here!s:.60} here'
  )


# Trees of plain data: every node is a pair of what it is and what is in it.


def _encode(where: str, value: Any, arrays: list[np.ndarray]) -> list[Any]:
  """Returns a JSON tree for a value, and adds its arrays to `arrays`."""
  kind = type(value)
  if value is None or kind in (bool, int, float, str):
    return ['plain', value]
  if kind is seeding.SaltedSeed:
    return ['salted seed', [int(value), value.salt.hex()]]
  if kind in (tuple, list):
    items = [
        _encode(f'{where}[{i}]', item, arrays) for i, item in enumerate(value)
    ]
    return [kind.__name__, items]
  if kind is dict and all(type(key) is str for key in value):
    pairs = [
        [key, _encode(f'{where}[{key!r}]', item, arrays)]
        for key, item in value.items()
    ]
    return ['dict', pairs]
  is_scalar = isinstance(value, np.generic)
  if (is_scalar or kind is np.ndarray) and not value.dtype.hasobject:
    arrays.append(np.array(value))
    return ['scalar' if is_scalar else 'array', len(arrays) - 1]
  raise errors.StateLayoutError(
      f'{where} is a {kind.__name__}: {value!r:.60}; what is saved has to be'
      ' tuples, lists and dicts (by text) of arrays, numbers, texts and None'
  )


def _decode(node: Any, arrays: list[np.ndarray]) -> Any:
  """Returns the value of a tree, with arrays of its own."""
  kind, inside = node
  if kind == 'plain':
    return inside
  if kind == 'dict':
    return {key: _decode(item, arrays) for key, item in inside}
  if kind == 'list':
    return [_decode(item, arrays) for item in inside]
  if kind == 'tuple':
    return tuple(_decode(item, arrays) for item in inside)
  if kind == 'array':
    return np.array(arrays[inside])  # In the same order in memory.
  if kind == 'scalar':
    return arrays[inside][()]
  if kind == 'salted seed':
    seed, salt = inside
    return seeding.SaltedSeed(seed, bytes.fromhex(salt))
  raise ValueError(f'{kind!r:.40} is no kind of node')


def _read(payload: bytes) -> tuple[dict[str, Any], Any]:
  """Returns the header and the contents that are in a snapshot's bytes."""
  with zipfile.ZipFile(io.BytesIO(payload)) as archive:
    for member in archive.infolist():
      _check_size(archive, member)
  with np.load(io.BytesIO(payload), allow_pickle=False) as file:
    header, tree = json.loads(file[_STRUCTURE].tobytes())
    if header['format'] != _FORMAT:
      raise ValueError(
          f'format is {header["format"]!r:.20}; allowed is {_FORMAT}'
      )
    arrays = [file[str(i)] for i in range(len(file.files) - 1)]
  return header, _decode(tree, arrays)


def _check_size(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
  """Checks that an array is as large as it says, before room is made for it.

  Raises:
    ValueError: If it is not.
  """
  if member.compress_type != zipfile.ZIP_STORED:
    raise ValueError(f'{member.filename!r:.40} is compressed')
  with archive.open(member) as file:
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
      raise ValueError(f'{member.filename!r:.40} is of version {version}')
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    size = math.prod(shape) * dtype.itemsize
    if size != member.file_size - file.tell():
      raise ValueError(
          f'{member.filename!r:.40} says that it has {size} bytes; there are'
          f' {member.file_size - file.tell()}'
      )


def _difference(key: str, saved: Any, here: Any) -> str:
  """Says in what two entries of headers differ."""
  if not isinstance(saved, dict) or not isinstance(here, dict):
    return f'{key} is {saved!r:.60} in the snapshot, {here!r:.60} here'
  names = [
      name
      for name in sorted(saved.keys() | here.keys())
      if saved.get(name) != here.get(name)
  ]
  named = ', '.join(
      f'{name} ({saved.get(name)} in the snapshot, {here.get(name)} here)'
      for name in names[:_MAX_NAMED]
  )
  more = f' and {len(names) - _MAX_NAMED} more' * (len(names) > _MAX_NAMED)
  return f'{key}: {named}{more}'
