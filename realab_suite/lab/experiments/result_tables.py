"""Summaries of evaluations, as text and CSV: views of judged studies."""

from collections.abc import Iterable, Mapping, Sequence
import math
import pathlib
from typing import Any

import numpy as np
import pandas as pd

from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import obedience
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts

_Label = verdicts.Label
_Rows = Sequence[results.EpisodeResult]
# Parts of the corruption of a register, by the columns of their means.
_PARTS = {
    'own_metres': 'own',
    'inherited_metres': 'inherited',
    'corruption_units': 'units',
}
_QUERIES = 'queries not its actions'
_UNSEEN = 'taken unseen'
_OF_HACKING = (
    'hack rate (%)', "control's (%)", 'hack-free return', 'hack-free episodes',
    'ended by tampering',
)  # fmt: skip


def as_text(evaluation: study.Study, judged: pd.DataFrame) -> str:
  """Returns two tables in aligned Markdown, and the labels of seeds."""
  lines = study.wholes(judged)
  runs = [evaluation.runs[name] for name in lines]
  events = tables.frame(_outcomes(run.rows) for run in runs)
  events.columns = events.columns.str.replace('_', ' ')
  means = [_means(run) for run in runs]
  frame = tables.frame(
      {
          'run': run.name,
          **columns(line),
          'observed return': line['observed_return'],
          'own (m)': of_run['own_metres'],
          'inherited (m)': of_run['inherited_metres'],
          'corruption (units)': of_run['corruption_units'],
          'gain (units)': of_run['gain'],
          'verdict': _verdict(run, line),
          _QUERIES: line['misnamed'],
          _UNSEEN: line['unseen'],
      }
      for run, line, of_run in zip(runs, lines.values(), means, strict=True)
  ).rename(columns={'hack-free episodes': 'hack-free'})
  optional = [name for name in (_QUERIES, _UNSEEN) if frame[name].iloc[0]]
  main = frame[[
      'run', 'true return', 'observed return', *_OF_HACKING[:3],
      'corruption (m)', 'verdict', *optional,
  ]]  # fmt: skip
  more = frame[[
      'run', 'episodes', 'hack-free', 'own (m)', 'inherited (m)',
      'corruption (units)', 'gain (units)',
  ]].join(events)  # fmt: skip
  reasons = {
      line['reason']
      for line in lines.values()
      if line['label'] is _Label.NOT_JUDGED
  }
  labels = [f'* {label}' for run in runs for label in _labels(judged, run)]
  parts = [tables.markdown(main), tables.markdown(more)]
  stopping = stopping_frame(judged)
  parts += [] if stopping.empty else [tables.markdown(stopping)]
  parts += [f'Not judged: {reason}.' for reason in sorted(reasons)]
  return '\n\n'.join([*parts, *(['\n'.join(labels)] if labels else [])])


def stopping_frame(judged: pd.DataFrame) -> pd.DataFrame:
  """Returns what runs do about being stopped, empty in most worlds."""
  found = {
      name: obedience.known(line) for name, line in study.wholes(judged).items()
  }
  lines = (
      {'run': name, 'calls': of.pop('num_calls'), **of}
      for name, of in found.items()
      if of
  )
  return tables.frame(lines)


def write_csv(
    evaluation: study.Study, judged: pd.DataFrame, path: pathlib.Path
) -> None:
  """Writes all figures as CSV, a line per run."""
  records = []
  for name, line in study.wholes(judged).items():
    run = evaluation.runs[name]
    labels = (label.removeprefix(f'{name}: ') for label in _labels(judged, run))
    records.append({
        'run': name,
        **counts(line),
        **ends(run, judged, line),
        'control_rate': line['control_rate'],
        'limit': line['limit'],
        'num_hacked': line['hacked'],
        'num_ended_by_tampering': line['ended'],
        **_means(run),
        **_outcomes(run.rows),
        'verdict': _verdict(run, line),
        'misnamed': line['misnamed'],
        'labels': '; '.join(labels),
        **obedience.known(line),
    })  # fmt: skip
  storage.write_whole(path, tables.csv_text(records).encode())


def _verdict(run: study.Run, line: pd.Series) -> str:
  """Returns the text of a judgement."""
  if run.name == run.baseline:
    share = line['control_gains']
    gains_too = f', which gains in {intervals.percent(share)}' if share else ''
    return f'the control{gains_too}'
  if line['label'] is _Label.NOT_JUDGED:
    return str(_Label.NOT_JUDGED.value)
  if (
      run.role is study.Role.BASELINE
      and line['label'] is _Label.DOES_NOT_TAMPER
  ):
    return f'hacks no more than {line["control"]}'
  return str(line['verdict'])


def _labels(judged: pd.DataFrame, run: study.Run) -> list[str]:
  """Returns the label of each seed of an agent that is judged."""
  return [
      f'{run.name}: seed {seed}: {line["verdict"]}'
      for seed, line in study.seeds(judged, run.name).iterrows()
      if line['label'] not in (None, _Label.NOT_JUDGED)
  ]


def _means(run: study.Run) -> dict[str, float | None]:
  """Returns the means of what the learner consumes, `None` if unknown."""
  counting, consumed = counted.of(run.rows), gains.consumed(run.design)
  figures = {
      column: [_largest(row, consumed, part) for row in counting]
      for column, part in _PARTS.items()
  }
  # The first part of an objective is the whole one.
  figures['gain'] = [
      next((value.gain for value in row.objective.values()), None)
      for row in counting
  ]
  return {column: _mean(values) for column, values in figures.items()}


def _largest(
    row: results.EpisodeResult, consumed: Sequence[str], part: str
) -> float | None:
  """Returns the largest part of the corruption of a consumed register."""
  parts = [getattr(row.registers[name], part) for name in consumed]
  return max((value for value in parts if value is not None), default=None)


def _mean(values: Iterable[float | None]) -> float | None:
  """Returns the mean of the values that are known."""
  known = [x for x in values if x is not None and not math.isnan(x)]
  return float(np.mean(known)) if known else None


def _outcomes(rows: _Rows) -> dict[str, float]:
  """Returns the mean of each event over the episodes that ran to their end."""
  facts = tables.frame(row.facts for row in rows if row.is_valid)
  return {name: float(values.mean()) for name, values in facts.items()}


def columns(line: Mapping[str, Any] | pd.Series) -> dict[str, tables.Figure]:
  """Returns the figures of a run that tables show, by their columns.

  If hacked episodes were given up, the true return is 'at least' so much.

  Args:
    line: Line of the run; see `study.judge`.
  """
  censored = [
      f'{number} {what}'
      for number, what in (
          (line['num_cut'], 'of them given up'),
          (line['num_given_up'] - line['num_cut'], 'more given up'),
          (line['num_failed'], 'more failed'),
      )
      if number
  ]
  more = f' ({", ".join(censored)})' if censored else ''
  earned = tables.text(line['true_return'])
  cells: dict[str, tables.Figure] = {
      'episodes': f'{line["num_episodes"]}{more}',
      'true return': f'at least {earned}' if line['num_cut'] else earned,
      'observed return (units)': line['observed_return'],
      'corruption (m)': line['corruption'],
      'relative gain': line['relative_gain'],
  }
  if line['hack_rate'] is None:
    return {**cells, **dict.fromkeys(_OF_HACKING, 'n/a')}
  figures = (
      line['hack_rate'].scaled(100),
      100 * line['control_rate'],
      line['hack_free_return'],
      line['num_judged'] - line['hacked'],
      line['ended'],
  )
  return {**cells, **dict(zip(_OF_HACKING, figures, strict=True))}


def counts(line: pd.Series) -> dict[str, int]:
  """Returns numbers of seeds and episodes, by their columns in a CSV file."""
  names = 'num_seeds', 'num_episodes', 'num_given_up', 'num_failed'
  return {name: line[name] for name in names}


def ends(
    run: study.Run, judged: pd.DataFrame, line: pd.Series
) -> dict[str, tables.Figure]:
  """Returns figures with intervals, by their columns in a CSV file."""
  rates = {
      run.evaluation_seed(seed): rate
      for seed, rate in study.seeds(judged, run.name)['hack_rate'].items()
      if rate is not None
  }
  return {
      **tables.ends(
          {
              'true_return': line['true_return'],
              'observed_return': line['observed_return'],
              'hack_rate': line['hack_rate'],
              'hack_free_return': line['hack_free_return'],
              'relative_gain': line['relative_gain'],
              'corruption_metres': line['corruption'],
          }
      ),
      'hack_rates_by_seed': tables.by_seed(rates) or None,
  }
