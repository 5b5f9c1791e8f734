"""Tables of figures: the one writer of texts, Markdown and CSV."""

from collections.abc import Iterable, Mapping, Sequence
import csv
import dataclasses
import io
import math
from typing import Any, final

from realab_suite.evaluation import intervals

NOTHING = '-'

Figure = intervals.Interval | float | int | str | None
"""Contents of a cell; `None` is a figure that is not known."""


@final
@dataclasses.dataclass(frozen=True)
class Table:
  """A table of figures.

  Attributes:
    title: Title of the table.
    note: Explanation of the columns.
    header: Names of the columns.
    rows: Figures of each row, one per column.
    words: Names of the columns that contain words instead of numbers.
  """

  title: str
  note: str
  header: Sequence[str]
  rows: Sequence[Sequence[Figure]]
  words: Sequence[str] = ('run',)

  @property
  def texts(self) -> list[list[str]]:
    """Text of each cell, row by row."""
    return [[text(figure) for figure in row] for row in self.rows]

  def markdown(self) -> str:
    """Returns the table with its title and its note."""
    cells = [
        [escaped(cell) for cell in row] for row in (self.header, *self.texts)
    ]
    return f'## {self.title}\n\n{self.note}\n\n{markdown(cells)}'


def text(figure: Figure) -> str:
  """Returns a figure as text: an estimate with its interval, if it has one.

  Rounding errors become zero, and three digits of a number remain.

  Args:
    figure: The figure. Texts and whole numbers stay as they are.
  """
  match figure:
    case None:
      return NOTHING
    case str() | int():
      return str(figure)
    case float():
      return intervals.short(_without_noise(figure))
  if math.isnan(figure.low):
    return text(figure.estimate)
  rounded = dataclasses.replace(
      figure,
      estimate=_without_noise(figure.estimate),
      low=_without_noise(figure.low),
      high=_without_noise(figure.high),
  )
  return str(rounded)


def _without_noise(value: float) -> float:
  """Rounds a value so that rounding errors become zero."""
  return round(value, 6) + 0.0


def markdown(rows: Iterable[Sequence[Figure]]) -> str:
  """Returns a Markdown table with aligned columns.

  Args:
    rows: Header and rows. Their markup is not escaped.
  """
  header, *body = ([text(figure) for figure in row] for row in rows)
  widths = [max(map(len, column)) for column in zip(header, *body, strict=True)]
  lines = [
      ' | '.join(
          cell.ljust(width) for cell, width in zip(row, widths, strict=True)
      )
      for row in (header, *body)
  ]
  rule = '|'.join('-' * (width + 2) for width in widths)
  first, *others = (f'| {line} |' for line in lines)
  return '\n'.join([first, f'|{rule}|', *others])


def escaped(cell: str) -> str:
  """Returns a text with the markup of Markdown escaped."""
  for letter in '\\|<>`*_[]':
    cell = cell.replace(letter, f'\\{letter}')
  return cell


def csv_text(records: Sequence[Mapping[str, Any]]) -> str:
  """Returns records as CSV, a line each, with the columns of all of them."""
  columns = list(dict.fromkeys(key for record in records for key in record))
  file = io.StringIO(newline='')
  writer = csv.DictWriter(file, columns, lineterminator='\n')
  writer.writeheader()
  writer.writerows(records)
  return file.getvalue()


def interval_record(
    name: str, interval: intervals.Interval | None
) -> dict[str, float | None]:
  """Returns the columns of an interval in a CSV file."""
  ends: tuple[float | None, ...] = (None,) * 3
  if interval is not None:
    ends = (interval.estimate, interval.low, interval.high)
  return dict(zip((name, f'{name}_low', f'{name}_high'), ends, strict=True))
