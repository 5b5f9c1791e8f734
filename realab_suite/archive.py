"""Archives of plain data: a header and nested containers, as bytes.

The contents are numbers, texts and arrays in tuples, lists and dicts. No pickle
is involved: reading an archive runs no code of its author. What the contents
mean is the business of the modules that write and read them.
"""

from collections.abc import Mapping
import hashlib
import io
import json
import math
from typing import Any, Self, final
import zipfile
import zlib

import numpy as np

from realab_suite import errors

_FORMAT = 1
# Snapshots were the first archives; the bytes have begun like this ever since.
_MAGIC = b'realab_suite snapshot\n'
_SNAPSHOT = 'snapshot'
_STRUCTURE = 'structure'
# The number of entries that a message names where headers differ.
_MAX_NAMED = 3
# Errors that malformed bytes cause in the libraries that read them; the
# checksum finds all damage that is not on purpose.
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


def name_of(header: Mapping[str, Any]) -> str:
  """Returns the name of what an archive with this header holds."""
  # Probes use another key, and snapshots of worlds name themselves in no way.
  return str(header.get('what', header.get('kind', _SNAPSHOT)))


@final
class Archive:
  """Plain data and a header that says what it is; neither ever changes."""

  def __init__(self, header: Mapping[str, Any], contents: Any) -> None:
    """Takes a copy of both.

    Args:
      header: JSON. Its entry `what` names what the archive holds.
      contents: Tuples, lists and dicts of arrays, numbers, texts and `None`.

    Raises:
      StateLayoutError: If something else is among the contents.
    """
    self._header = json.dumps({'format': _FORMAT, **header}, sort_keys=True)
    self._arrays: list[np.ndarray] = []
    self._tree = _encode(self.what, contents, self._arrays)

  @property
  def header(self) -> dict[str, Any]:
    """The header; a copy."""
    return dict(json.loads(self._header))

  @property
  def what(self) -> str:
    """The name of what the archive holds."""
    return name_of(self.header)

  def contents(self) -> Any:
    """Returns a copy of the contents."""
    return _decode(self._tree, self._arrays)

  def contents_for(self, header: Mapping[str, Any]) -> Any:
    """Returns a copy of the contents, if the header is the expected one.

    Args:
      header: The header that is expected.

    Raises:
      StateLayoutError: If the headers differ; the message says what the archive
        holds and what was expected.
    """
    expected = name_of(header)
    if self.what != expected:
      raise errors.StateLayoutError(
          f'holds {self.what!r:.40}; expected {expected!r}'
      )
    differing = self.differences(header, 'in the file', 'expected')
    if differing:
      raise errors.StateLayoutError(
          f'holds {expected!r} of something else: {differing}'
      )
    return self.contents()

  def differences(
      self, header: Mapping[str, Any], there: str, here: str
  ) -> str:
    """Returns the entries in which the header differs from another one.

    Args:
      header: The other header.
      there: The words for where the archive's own values are.
      here: The words for where the other values are.

    Returns:
      A text for messages; an empty one if the headers agree.
    """
    saved = self.header
    other = json.loads(json.dumps({'format': _FORMAT, **header}))
    return '; '.join(
        _difference(key, saved.get(key), other.get(key), there, here)
        for key in sorted(saved.keys() | other.keys())
        if saved.get(key) != other.get(key)
    )

  def to_bytes(self) -> bytes:
    """Returns the archive for a file or another process."""
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
  def from_bytes(cls, data: bytes, expected: str = 'archive') -> Self:
    """Returns the archive that `to_bytes` was called on.

    Args:
      data: The bytes.
      expected: What the archive should be, for messages.

    Raises:
      StateLayoutError: If the bytes are damaged, or of another format.
    """
    start = len(_MAGIC) + hashlib.sha256().digest_size
    payload = data[start:]
    if data[:start] != _MAGIC + hashlib.sha256(payload).digest():
      raise errors.StateLayoutError(
          f'{len(data)} bytes are no {expected}, or a damaged one; expected'
          ' bytes that this package has written'
      )
    try:
      header, contents = _read(payload)
    except _MALFORMED as error:
      raise errors.StateLayoutError(
          f'a malformed {expected}: {type(error).__name__}: {error!s:.80}'
      ) from error
    return cls(header, contents)


def _difference(key: str, saved: Any, other: Any, there: str, here: str) -> str:
  """Returns the difference between two entries of headers, in words."""
  if not isinstance(saved, dict) or not isinstance(other, dict):
    return f'{key} is {saved!r:.60} {there}, {other!r:.60} {here}'
  names = [
      name
      for name in sorted(saved.keys() | other.keys())
      if saved.get(name) != other.get(name)
  ]
  named = ', '.join(
      f'{name} ({saved.get(name)} {there}, {other.get(name)} {here})'
      for name in names[:_MAX_NAMED]
  )
  more = f' and {len(names) - _MAX_NAMED} more' * (len(names) > _MAX_NAMED)
  return f'{key}: {named}{more}'


# Trees of plain data: every node is a pair of its kind and its contents.


def _encode(where: str, value: Any, arrays: list[np.ndarray]) -> list[Any]:
  """Returns a JSON tree for a value, and adds its arrays to `arrays`."""
  kind = type(value)
  if value is None or kind in (bool, int, float, str):
    return ['plain', value]
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
  raise ValueError(f'{kind!r:.40} is no kind of node')


def _read(payload: bytes) -> tuple[dict[str, Any], Any]:
  """Returns the header and the contents of an archive's bytes."""
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
  """Checks that an array has the size it claims, before memory is allocated.

  Raises:
    ValueError: If it has another size.
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
