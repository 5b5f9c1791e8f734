"""Tables of figures: the one writer of texts, Markdown and CSV."""

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import math
from typing import Any, final

import pandas as pd
import tabulate

from realab_suite.lab.verdicts import intervals

NOTHING = '-'

Figure = intervals.Interval | float | int | str | None
"""Contents of a cell; `None` is a figure that is not known."""


def frame(
    records: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> pd.DataFrame:
  """Returns records as a data frame, a row each.

  Cells are objects: a whole number stays one beside a figure that is `None`.

  Args:
    records: Figures by the names of their columns.
    columns: Columns of the frame; `None` for those of all records.
  """
  records = list(records)
  if columns is None:
    columns = list(dict.fromkeys(name for record in records for name in record))
  rows = [[record.get(name) for name in columns] for record in records]
  return pd.DataFrame(rows, columns=list(columns), dtype=object)


@final
@dataclasses.dataclass(frozen=True)
class Table:
  """A table of figures.

  Attributes:
    title: Title of the table.
    note: Explanation of the columns.
    frame: Figures, with the columns of the table.
    words: Names of the columns that contain words instead of numbers.
  """

  title: str
  note: str
  frame: pd.DataFrame
  words: Sequence[str] = ('run',)

  @property
  def header(self) -> list[str]:
    """Names of the columns."""
    return list(self.frame.columns)

  @property
  def texts(self) -> list[list[str]]:
    """Text of each cell, row by row."""
    return [[text(figure) for figure in row] for row in self.frame.to_numpy()]

  def markdown(self) -> str:
    """Returns the table with its title and its note."""
    cells = [[escaped(x) for x in row] for row in (self.header, *self.texts)]
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
  if math.isnan(figure.low) and not figure.seeds:
    return text(figure.estimate)
  estimate, low, high = (
      _without_noise(value)
      for value in (figure.estimate, figure.low, figure.high)
  )
  return str(dataclasses.replace(figure, estimate=estimate, low=low, high=high))


def _without_noise(value: float) -> float:
  """Rounds a value so that rounding errors become zero."""
  return round(value, 6) + 0.0


def markdown(table: pd.DataFrame | Iterable[Sequence[Figure]]) -> str:
  """Returns a Markdown table with aligned columns.

  Args:
    table: A data frame, or a header and rows. Their markup is not escaped.
  """
  if isinstance(table, pd.DataFrame):
    table = [table.columns, *table.to_numpy()]
  header, *body = ([text(figure) for figure in row] for row in table)
  # Parsed as a number, 1.20 would become 1.2.
  return str(tabulate.tabulate(body, header, 'github', disable_numparse=True))


def escaped(cell: str) -> str:
  """Returns a text with the markup of Markdown escaped."""
  for letter in '\\|<>`*_[]':
    cell = cell.replace(letter, f'\\{letter}')
  return cell


def csv_text(records: Iterable[Mapping[str, Any]]) -> str:
  """Returns records as CSV, a line each, with the columns of all of them."""
  # As texts, because pandas leaves a cell empty for NaN as for `None`.
  cells = frame(records).map(lambda cell: None if cell is None else str(cell))
  return str(cells.to_csv(index=False, lineterminator='\n'))


def ends(
    figures: Mapping[str, intervals.Interval | None],
) -> dict[str, float | None]:
  """Returns intervals as columns of a CSV file: each estimate and its ends.

  Ends in whose place seeds are printed are unknown.
  """
  return {
      f'{name}{suffix}': (
          getattr(interval, end)
          if interval and not (suffix and interval.seeds)
          else None
      )
      for name, interval in figures.items()
      for suffix, end in (('', 'estimate'), ('_low', 'low'), ('_high', 'high'))
  }


def by_seed(values: Mapping[int, float]) -> str:
  """Returns a figure of each seed as a cell of a CSV file."""
  return '; '.join(f'{seed}: {value:.6g}' for seed, value in values.items())
