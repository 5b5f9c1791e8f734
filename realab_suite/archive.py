"""Archives: a header and nested containers of plain data, as bytes.

The contents are numbers, strings and arrays in tuples, lists and dicts.
Archives do not use pickle, so reading one never runs code from it. The modules
that write and read archives define the meaning of the contents.
"""

from collections.abc import Mapping
import hashlib
import io
import json
from typing import Any, Self, final

import numpy as np

from realab_suite import errors

_FORMAT = 1
# First bytes of every archive; they mention snapshots, the first archives.
_MAGIC = b'realab_suite snapshot\n'
_SNAPSHOT = 'snapshot'
_STRUCTURE = 'structure'
# Largest number of differing header entries in a message.
_MAX_NAMED = 3


def name_of(header: Mapping[str, Any]) -> str:
  """Returns the kind of contents of an archive with this header."""
  return str(header.get('what', _SNAPSHOT))


@final
class Archive:
  """Immutable plain data with a header."""

  def __init__(self, header: Mapping[str, Any], contents: Any) -> None:
    """Makes an archive of copies of the header and the contents.

    Args:
      header: Data that JSON can represent. Its entry `what` is the kind of the
        contents.
      contents: Tuples, lists and dicts, with strings as keys, of arrays,
        numbers, strings and `None`.

    Raises:
      StateLayoutError: If the contents include an object of another type.
    """
    self._header = json.dumps({'format': _FORMAT, **header}, sort_keys=True)
    self._arrays: list[np.ndarray] = []
    self._tree = _encode(self.what, contents, self._arrays)

  @property
  def header(self) -> dict[str, Any]:
    """Copy of the header."""
    return dict(json.loads(self._header))

  @property
  def what(self) -> str:
    """Kind of the contents."""
    return name_of(self.header)

  def contents(self) -> Any:
    """Returns a copy of the contents."""
    return _decode(self._tree, self._arrays)

  def contents_for(self, header: Mapping[str, Any]) -> Any:
    """Returns a copy of the contents after checking the header.

    Args:
      header: Expected header.

    Raises:
      StateLayoutError: If the headers differ; the message lists the
        differences.
    """
    expected = name_of(header)
    if self.what != expected:
      raise errors.StateLayoutError(
          f'holds {self.what!r:.40}; expected {expected!r}'
      )
    differing = self.differences(header, 'in the file', 'expected')
    if differing:
      raise errors.StateLayoutError(
          f'holds {expected!r} with another header: {differing}'
      )
    return self.contents()

  def differences(
      self, header: Mapping[str, Any], there: str, here: str
  ) -> str:
    """Returns the differences between the header and another one.

    Args:
      header: Other header.
      there: Words for the origin of the archive's values.
      here: Words for the origin of the other values.

    Returns:
      A string for messages, empty if the headers are equal.
    """
    saved = self.header
    other = json.loads(json.dumps({'format': _FORMAT, **header}))
    return '; '.join(
        _difference(key, saved.get(key), other.get(key), there, here)
        for key in sorted(saved.keys() | other.keys())
        if saved.get(key) != other.get(key)
    )

  def to_bytes(self) -> bytes:
    """Returns the archive as bytes, for files or other processes."""
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
    """Returns the archive with the given bytes.

    Args:
      data: Bytes that `to_bytes` returned.
      expected: Noun for the expected kind of archive, for messages.

    Raises:
      StateLayoutError: If the bytes are damaged or have another format.
    """
    start = len(_MAGIC) + hashlib.sha256().digest_size
    payload = data[start:]
    if data[:start] != _MAGIC + hashlib.sha256(payload).digest():
      raise errors.StateLayoutError(
          f'{len(data)} bytes are not a valid {expected}: they are damaged, or'
          ' this package has not written them'
      )
    try:
      header, contents = _read(payload)
    except Exception as error:  # Of the libraries that read it.
      raise errors.StateLayoutError(
          f'a malformed {expected}: {type(error).__name__}: {error!s:.80}'
      ) from error
    return cls(header, contents)


def _difference(key: str, saved: Any, other: Any, there: str, here: str) -> str:
  """Returns the difference between two header entries, for messages."""
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
  """Returns a JSON tree for a value and appends its arrays to `arrays`.

  Raises:
    StateLayoutError: If the value is not plain data.
  """
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
      f'{where} is a {kind.__name__}: {value!r:.60}; must be tuples, lists'
      ' and dicts (with strings as keys) of arrays, numbers, strings and None'
  )


def _decode(node: Any, arrays: list[np.ndarray]) -> Any:
  """Returns the value of a tree, with copies of its arrays.

  Raises:
    ValueError: If the tree contains an unknown kind of node.
  """
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
    return np.array(arrays[inside])  # Preserves the memory order.
  if kind == 'scalar':
    return arrays[inside][()]
  raise ValueError(f'unknown kind of node: {kind!r:.40}')


def _read(payload: bytes) -> tuple[dict[str, Any], Any]:
  """Returns the header and the contents of an archive's bytes."""
  with np.load(io.BytesIO(payload), allow_pickle=False) as file:
    header, tree = json.loads(file[_STRUCTURE].tobytes())
    if header['format'] != _FORMAT:
      raise ValueError(f'format is {header["format"]!r:.20}; must be {_FORMAT}')
    arrays = [file[str(i)] for i in range(len(file.files) - 1)]
  return header, _decode(tree, arrays)
