"""Formatting of locations and values in error messages.

The module does not decide what is wrong.
"""

from collections.abc import Iterable, Sequence
import dataclasses
import difflib
import re
from typing import final

from realab_suite import errors

_MAX_LENGTH = 80


@final
@dataclasses.dataclass(frozen=True)
class Location:
  """Location of a value: a source, a path of keys and a line."""

  where: str
  path: tuple[str | int, ...] = ()
  line: int | None = None

  def child(self, key: str | int) -> 'Location':
    return Location(self.where, (*self.path, key), self.line)

  def error(self, problem: str) -> errors.SpecError:
    where = self.where if self.line is None else f'{self.where}:{self.line}'
    parts = (where, format_path(self.path), problem)
    message = ': '.join(part for part in parts if part)
    # File names, keys and texts of validators may contain any character. An
    # error is one line of printable characters.
    return errors.SpecError(
        ''.join(c if c.isprintable() else repr(c)[1:-1] for c in message)
    )


def format_path(path: Sequence[str | int]) -> str:
  """Returns a path of keys as text: `registers.reward.range[1]`."""
  text = ''
  for part in path:
    if isinstance(part, int):
      text += f'[{part}]'
    elif re.fullmatch(rf'[\w-]{{1,{_MAX_LENGTH}}}', part):
      text += f'.{part}' if text else part
    else:
      text += f'[{quote(part)}]'
  return text


def quote(value: object) -> str:
  """Returns the repr of a value, cut to a length that fits a message."""
  try:
    text = ' '.join(repr(value).split())
  except Exception:  # For instance an integer too long for Python to print.
    text = f'<{type(value).__name__}>'
  return text if len(text) <= _MAX_LENGTH else f'{text[: _MAX_LENGTH - 3]}...'


def did_you_mean(
    given: object, known: Iterable[str], cutoff: float = 0.6
) -> str:
  """Returns a hint at the known name that is most like a name, or ''.

  Args:
    given: The name.
    known: Known names.
    cutoff: Least likeness of a name in a hint, from 0 to 1.
  """
  close = nearest(given, known, cutoff)
  return '' if close is None else f'; did you mean {close!r}?'


def nearest(
    given: object, known: Iterable[str], cutoff: float = 0.6
) -> str | None:
  """Returns the known name that is most like a name, as in `did_you_mean`."""
  close = difflib.get_close_matches(str(given), list(known), n=1, cutoff=cutoff)
  return close[0] if close else None


def exception(error: BaseException) -> str:
  """Returns the class and the message of an exception, on one line."""
  message = ' '.join(str(error).split())
  return (
      f'{type(error).__name__}: {message}' if message else type(error).__name__
  )
