"""Means over the episodes of a run of what its world counts and measures."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import pandas as pd

from realab_suite.evaluation import results
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import study

_Rows = Sequence[results.EpisodeResult]
# Parts of the corruption of a register, by the ends of their columns.
_PARTS = {
    'corruption_metres': 'corruption',
    'corruption_units': 'units',
    'own_metres': 'own',
    'inherited_metres': 'inherited',
}


def coverage(run: study.Run) -> float | None:
  """Returns the share of writes that were read, or `None` without writes."""
  shares = [
      register.coverage
      for row in counted.of(run.rows)
      for register in row.registers.values()
      if register.coverage is not None
  ]
  return float(np.mean(shares)) if shares else None


def stages(run: study.Run) -> dict[str, intervals.Interval]:
  """Returns the true return of each stage in which an episode counts."""
  true_returns = {}
  for stage in jobs.STAGES:
    rows = [row for row in run.stages if row.info.run.endswith(f'.{stage}')]
    if counted.of(rows):
      true_returns[stage] = comparison.summary(run.name, rows)['true_return']
  return true_returns


def corruption(run: study.Run) -> dict[str, intervals.Interval]:
  """Returns the corruption of registers, by their columns in `tables.csv`.

  It is that of each register that was read, whether the learner consumes it or
  not, and, if episodes were attributed, own corruption of what it consumes by
  movers.
  """
  counting = counted.of(run.rows)
  records = []
  for row in counting:
    record = {
        f'{name}_{column}': getattr(register, part)
        for name, register in row.registers.items()
        for column, part in _PARTS.items()
    }
    if metrics := attribution_metrics.of(row):
      record['agent_metres'] = metrics.agent
      record['world_metres'] = metrics.world
      record['agent_share'] = metrics.agent_share
    records.append(record)
  return _intervals(
      counting,
      records,
      lambda values: (
          intervals.SHARE
          if values.name == 'agent_share'
          else intervals.NOT_NEGATIVE
      ),
  )


def events(run: study.Run) -> dict[str, intervals.Interval]:
  """Returns the mean of each event that the task counts, by its name."""
  valid = [row for row in run.rows if row.is_valid]

  # Rows do not say how often an event can happen, and it may have happened less
  # often than that in each of them.
  def bounds(values: pd.Series) -> intervals.Bounds:
    return intervals.UNBOUNDED if min(values) < 0 else intervals.NOT_NEGATIVE

  return _intervals(valid, [row.facts for row in valid], bounds)


def _intervals(
    rows: _Rows,
    figures: Iterable[Mapping[str, float | None]],
    bounds: Callable[[pd.Series], intervals.Bounds],
) -> dict[str, intervals.Interval]:
  """Returns means over seeds, of figures that are known in an episode.

  Args:
    rows: The episodes.
    figures: Figures of each episode by name; `None` if unknown.
    bounds: Returns the bounds of a figure, given its known values.
  """
  frame = tables.frame(figures)
  frame.index = [row.seed for row in rows]
  return {
      name: intervals.mean_interval(
          {seed: list(values) for seed, values in series.groupby(level=0)},
          bounds=bounds(series),
      )
      for name in frame
      if len(series := frame[name].dropna())
  }
