"""Damage to files: strategies that change some bytes of them."""

from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

_MOST_LOST = 512


@st.composite
def damaged(draw: Any, data: bytes, others: Sequence[bytes] = ()) -> bytes:
  """Draws what a file contains after some damage; never what it contained.

  Args:
    draw: Draws from a strategy.
    data: Content of the file.
    others: Contents of other files, which may take its place.
  """
  hows = ['flip', 'cut', 'zero', 'lose', 'repeat', 'digit']
  how = draw(st.sampled_from([*hows, *['swap'] * bool(others)]))
  start = draw(st.integers(0, len(data) - 1))
  end = min(len(data), start + draw(st.integers(1, _MOST_LOST)))
  if how == 'flip':
    flipped = bytes([data[start] ^ 1 << draw(st.integers(0, 7))])
    found = data[:start] + flipped + data[start + 1 :]
  elif how == 'cut':
    found = data[:start]
  elif how == 'zero':
    found = data[:start] + bytes(end - start) + data[end:]
  elif how == 'lose':
    found = data[:start] + data[end:]
  elif how == 'repeat':
    found = data[:end] + data[start:]
  elif how == 'digit':
    found = _another_digit(data, start)
  else:
    found = draw(st.sampled_from(others))
  # Zeros may have been zeros before.
  return data[:-1] if found == data else found


def _another_digit(data: bytes, start: int) -> bytes:
  """Changes the first digit after a place, so that JSON stays JSON."""
  for i in range(start, len(data)):
    if data[i : i + 1].isdigit():
      digit = b'0' if data[i : i + 1] != b'0' else b'1'
      return data[:i] + digit + data[i + 1 :]
  return data[:start]
