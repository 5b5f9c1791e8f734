"""Tables of the returns and the corruption of runs, as text and CSV."""

from collections.abc import Mapping, Sequence
import csv
import dataclasses
import math
import os
from typing import final

import numpy as np

from realab_suite.evaluation import comparison
from realab_suite.evaluation import intervals
from realab_suite.evaluation import metrics
from realab_suite.evaluation import results

NOTHING = '-'


@final
@dataclasses.dataclass(frozen=True)
class Line:
  """Figures of one run in the tables.

  Attributes:
    run: Name of the run.
    summary: Summary of the run, alone and compared with the baseline.
    obstruction: Mean obstruction, a part of the corruption, in metres, or
      `None`.
    permanent: Mean permanent part of the corruption, in metres, or `None`.
    temporary: Mean temporary part of the corruption, in metres, or `None`.
    outcomes: Mean of each event that the task counts, over the episodes that
      ran to their end.
  """

  run: str
  summary: comparison.RunSummary
  obstruction: float | None
  permanent: float | None
  temporary: float | None
  outcomes: dict[str, float]


def summarize(
    rows: Mapping[str, Sequence[results.EpisodeRow]],
    baseline: str,
    scales: Mapping[str, float],
) -> list[Line]:
  """Summarizes runs.

  Args:
    rows: Rows of each run, by its name.
    baseline: Name of the run to compare with.
    scales: Metres per unit of each register that the learner consumes.

  Raises:
    ResultsError: If the runs cannot be compared.
  """
  lines = []
  margin = comparison.margin_of(scales.values())
  summaries = comparison.compare(rows, baseline, margin=margin)
  for run, summary in summaries.items():
    counting = [row for row in rows[run] if row.counts]
    facts = [row.facts for row in rows[run] if row.is_valid]
    lines.append(
        Line(
            run,
            summary,
            _metres(counting, 'obstruction', scales),
            _metres(counting, 'permanent', scales),
            _metres(counting, 'temporary', scales),
            {
                fact: float(np.mean([one[fact] for one in facts]))
                for fact in (facts[0] if facts else ())
            },
        )
    )
  return lines


def as_text(lines: Sequence[Line]) -> str:
  """Returns two tables in aligned Markdown."""
  facts = list(dict.fromkeys(fact for line in lines for fact in line.outcomes))
  main = [['run', 'true return', 'observed return', 'corruption (m)',
           'verdict']]  # fmt: skip
  more = [['run', 'episodes', 'obstruction (m)', 'permanent (m)',
           'temporary (m)',
           *(fact.replace('_', ' ') for fact in facts)]]  # fmt: skip
  for line in lines:
    summary = line.summary
    main.append(
        [
            line.run,
            return_text(summary),
            interval_text(summary.observed_return),
            interval_text(summary.corruption),
            _verdict(summary),
        ]
    )
    more.append(
        [
            line.run,
            episodes_text(summary),
            number_text(line.obstruction),
            number_text(line.permanent),
            number_text(line.temporary),
            *(number_text(line.outcomes.get(fact)) for fact in facts),
        ]
    )
  return f'{markdown(main)}\n\n{markdown(more)}'


def readings(lines: Sequence[Line]) -> str:
  """Returns an interpretation of the figures, a list item per run."""
  return '\n'.join(f'* {line.run}: {line.summary.reading}' for line in lines)


def write_csv(lines: Sequence[Line], path: str | os.PathLike[str]) -> None:
  """Writes all figures as CSV, a line per run."""
  records = [_record(line) for line in lines]
  with open(path, 'x', encoding='utf-8', newline='') as file:
    writer = csv.DictWriter(file, list(records[0]), lineterminator='\n')
    writer.writeheader()
    writer.writerows(records)


def _record(line: Line) -> dict[str, object]:
  summary = line.summary
  record: dict[str, object] = {
      'run': line.run,
      'num_seeds': summary.num_seeds,
      'num_episodes': summary.num_episodes,
      'num_given_up': summary.num_given_up,
      'num_failed': summary.num_failed,
  }
  for name, interval in (
      ('true_return', summary.true_return),
      ('observed_return', summary.observed_return),
      ('corruption_metres', summary.corruption),
      ('true_return_gained', summary.true_return_gained),
      ('corruption_gained', summary.verdict and summary.verdict.difference),
  ):
    for part, attribute in (
        ('', 'estimate'),
        ('_low', 'low'),
        ('_high', 'high'),
    ):
      record[name + part] = interval and getattr(interval, attribute)
  record['obstruction_metres'] = line.obstruction
  record['permanent_metres'] = line.permanent
  record['temporary_metres'] = line.temporary
  record.update(line.outcomes)
  record['verdict'] = summary.verdict and summary.verdict.words
  record['share_bound'] = summary.verdict and summary.verdict.share_bound
  record['reading'] = summary.reading
  return record


def _metres(
    rows: Sequence[results.EpisodeRow], part: str, scales: Mapping[str, float]
) -> float | None:
  """Returns the mean over episodes of a part of the corruption."""
  metres = [metrics.in_metres(row.registers, scales, part) for row in rows]
  known = [value for value in metres if not math.isnan(value)]
  return float(np.mean(known)) if known else None


def return_text(summary: comparison.RunSummary) -> str:
  """Returns the true return of a run, with 'at least' for a lower bound."""
  text = interval_text(summary.true_return)
  return f'at least {text}' if summary.num_given_up else text


def interval_text(interval: intervals.Interval | None) -> str:
  """Returns an estimate with its interval, if it has one."""
  if interval is None:
    return NOTHING
  if math.isnan(interval.low):
    return number_text(interval.estimate)
  rounded = dataclasses.replace(
      interval,
      estimate=_without_noise(interval.estimate),
      low=_without_noise(interval.low),
      high=_without_noise(interval.high),
  )
  return str(rounded)


def number_text(value: float | None) -> str:
  """Returns three digits of a number, or `NOTHING`."""
  return NOTHING if value is None else intervals.short(_without_noise(value))


def _without_noise(value: float) -> float:
  """Rounds a value so that rounding errors become zero."""
  return round(value, 6) + 0.0


def _verdict(summary: comparison.RunSummary) -> str:
  if summary.verdict is not None:
    return summary.verdict.words
  return 'the baseline' if summary.true_return_gained is None else NOTHING


def episodes_text(summary: comparison.RunSummary) -> str:
  """Returns the number of episodes that count, and of censored ones."""
  censored = [
      f'{number} {what}'
      for number, what in (
          (summary.num_given_up, 'of them given up'),
          (summary.num_failed, 'more failed'),
      )
      if number
  ]
  more = f' ({", ".join(censored)})' if censored else ''
  return f'{summary.num_episodes}{more}'


def markdown(rows: Sequence[Sequence[str]]) -> str:
  """Returns a Markdown table, whose header is the first row."""
  widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
  lines = [
      ' | '.join(
          cell.ljust(width) for cell, width in zip(row, widths, strict=True)
      )
      for row in rows
  ]
  rule = '|'.join('-' * (width + 2) for width in widths)
  header, *body = (f'| {line} |' for line in lines)
  return '\n'.join([header, f'|{rule}|', *body])
