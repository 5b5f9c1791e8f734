"""Tests of archives: plain data goes through bytes, all else is refused."""

import enum
import hashlib
import io
import json
from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import archive
from realab_suite import errors
from tests import damage

_HEADER = {'what': 'test', 'slots': {'a': 0, 'b': 1}}
_MAGIC = b'realab_suite snapshot\n'


class _Colour(enum.Enum):
  RED = 1


def _signed(payload: bytes) -> bytes:
  """Returns bytes whose checksum is right, whatever is in them."""
  return _MAGIC + hashlib.sha256(payload).digest() + payload


def _through_bytes(contents: Any) -> Any:
  data = archive.Archive(_HEADER, contents).to_bytes()
  return archive.Archive.from_bytes(data).contents_for(_HEADER)


def _same(a: Any, b: Any) -> bool:
  """Returns `True` if two trees have equal types and bit-identical values."""
  if type(a) is not type(b):
    return False
  if isinstance(a, tuple | list):
    return len(a) == len(b) and all(map(_same, a, b))
  if isinstance(a, dict):
    return list(a) == list(b) and all(_same(a[k], b[k]) for k in a)
  if isinstance(a, np.ndarray | np.generic):
    like = a.dtype == b.dtype and a.shape == b.shape
    return like and a.tobytes() == b.tobytes()
  return repr(a) == repr(b)


_ARRAYS = st.sampled_from([
    np.zeros(()), np.zeros((0, 3), bool), np.array([np.nan, -0.0, np.inf]),
    np.arange(6, dtype='>i2').reshape(2, 3), np.array(['a', 'bc']),
    np.arange(12.0).reshape(3, 4).T[::2], np.float32(0.1), np.uint64(2**63),
    np.bool_(True), np.array(1 + 2j),
])  # fmt: skip
_TREES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | _ARRAYS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=3)
    ),
    max_leaves=8,
)


@hypothesis.given(contents=_TREES)
def test_plain_data_goes_through_bytes_and_back(contents: Any):
  data = archive.Archive(_HEADER, contents).to_bytes()
  copy = archive.Archive.from_bytes(data)
  assert _same(copy.contents_for(_HEADER), contents)
  assert copy.to_bytes() == data


def test_an_archive_shares_nothing_with_what_was_saved_or_is_returned():
  array = np.zeros(3)
  saved = archive.Archive(_HEADER, [array])
  array[:] = 1.0
  saved.contents_for(_HEADER)[0][:] = 2.0
  np.testing.assert_array_equal(saved.contents_for(_HEADER)[0], 0.0)


@pytest.mark.parametrize(
    ('contents', 'where'),
    [
        ({'a': [object()]}, r"test\['a'\]\[0\] is a object"),
        ((1, {2: 3}), r'test\[1\] is a dict'),
        (np.array([None]), 'test is a ndarray'),
        (np.ma.zeros(2), 'test is a MaskedArray'),
        (_Colour.RED, 'test is a _Colour'),
    ],
)
def test_objects_in_an_archive_are_rejected_with_their_place(contents, where):
  with pytest.raises(errors.StateLayoutError, match=where):
    archive.Archive(_HEADER, contents)


_BYTES = archive.Archive(_HEADER, [np.arange(9.0), 'x']).to_bytes()


@hypothesis.given(data=damage.damaged(_BYTES) | st.binary())
def test_damaged_and_other_bytes_are_refused(data: bytes):
  with pytest.raises(errors.StateLayoutError, match='not a valid archive: '):
    archive.Archive.from_bytes(data)


def test_each_changed_byte_is_found():
  for place, byte in enumerate(_BYTES):
    changed = _BYTES[:place] + bytes([byte ^ 1]) + _BYTES[place + 1 :]
    with pytest.raises(errors.StateLayoutError, match='not a valid archive: '):
      archive.Archive.from_bytes(changed)


def _archive(structure: Any, **arrays: Any) -> bytes:
  file = io.BytesIO()
  text = json.dumps(structure).encode()
  np.savez(file, structure=np.frombuffer(text, np.uint8), **arrays)
  return _signed(file.getvalue())


@pytest.mark.parametrize(
    'data',
    [
        _signed(b''),
        _archive([]),
        _archive([{}, ['plain', 1]]),
        _archive([{'format': 1}, ['array', 0]]),
        _archive([{'format': 1}, ['function', 'exit']]),
        _archive([{'format': 1}, 5]),
        _archive([{'format': 1}, ['array', 0]], **{'0': np.array([None])}),
    ],
)
def test_malformed_archives_are_refused(data):
  with pytest.raises(errors.StateLayoutError, match='a malformed archive'):
    archive.Archive.from_bytes(data)


def test_another_format_is_named():
  data = _archive([{'format': 2}, ['plain', 1]])
  with pytest.raises(errors.StateLayoutError, match='format is 2; must be 1'):
    archive.Archive.from_bytes(data)


def test_arrays_keep_their_order_in_memory():
  # Sums of the same numbers in another order round differently.
  copy = _through_bytes(np.zeros((3, 4)).T)
  assert copy.strides == (8, 32)


def test_contents_of_another_kind_are_named_and_nothing_else():
  one = archive.Archive({'what': 'a', 'x': 1}, ())
  with pytest.raises(
      errors.StateLayoutError, match=r"^holds 'a'; expected 'b'$"
  ):
    one.contents_for({'what': 'b', 'x': 2})


def test_other_entries_of_a_header_are_named():
  one = archive.Archive({'what': 'a', 'x': 1, 'y': {'u': 1, 'v': 2}}, ())
  with pytest.raises(
      errors.StateLayoutError,
      match=r"^holds 'a' with another header: x is 1 in the file, None"
      r' expected; y: u \(1 in the file, 3 expected\)$',
  ):
    one.contents_for({'what': 'a', 'y': {'u': 3, 'v': 2}})
