"""Caveats of a report: conclusions that the results do not support."""

from collections.abc import Iterable, Mapping
import math

import pandas as pd

from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import episode_means

_Lines = Mapping[str, pd.Series]


def caveats(sweep: study.Study, judged: pd.DataFrame) -> list[str]:
  """Returns the caveats of a sweep, one to three sentences each."""
  lines = {
      name: line
      for name, line in study.wholes(judged).items()
      if name in sweep.without_controls
  }
  return [
      *_on_completeness(sweep, lines),
      *_on_seeds(lines),
      *_on_data(sweep, lines),
      'Intervals are over training seeds, for one task and one setting of each'
      ' learner. They do not cover other tasks, longer training or other'
      ' settings.',
      'Of honest seeds, up to'
      f' {intervals.percent(verdicts.MOST_FALSE_LABELS)} are said to tamper if'
      ' their hack rates have a standard deviation of at most 8 points, and'
      ' more if they differ by more.',
      'A design that tampers here should not be trusted elsewhere. A design'
      ' that does not tamper here has only passed a unit test (REALab paper,'
      ' section 4.5).',
  ]


def awaited(sweep: study.Study) -> list[tuple[str, int]]:
  """Returns unfinished runs and seeds; if published, of published runs."""
  return [
      (run, seed)
      for run, seed in sweep.unfinished
      if sweep.has_traces or sweep.runs[run].is_done
  ]


def _on_completeness(sweep: study.Study, lines: _Lines) -> Iterable[str]:
  if sweep.is_calibration:
    yield (
        'These are calibration seeds, which were used to choose settings. Do'
        ' not report them as results.'
    )
  if len(codes := sweep.codes(storage.CODE)) > 1:
    yield f'Different code made the results: {", ".join(sorted(codes))}.'
  if not sweep.has_imprints:
    yield f'These are {storage.NO_IMPRINTS}.'
  runs = sweep.without_controls
  done = [name for name, run in runs.items() if run.is_done]
  if not sweep.has_traces and (
      absent := [
          name
          for name, run in runs.items()
          if name not in done and run.family in (name, *done)
      ]
  ):
    yield (
        'The experiment has further runs, which are not among these results:'
        f' {", ".join(absent)}.'
    )
  if unfinished := awaited(sweep):
    seeds_of_run: dict[str, list[str]] = {}
    for run_name, seed in unfinished:
      seeds_of_run.setdefault(run_name, []).append(str(seed))
    missing = ', '.join(
        f'{name} (seed{"s" if len(seeds) > 1 else ""} {", ".join(seeds)})'
        for name, seeds in seeds_of_run.items()
    )
    yield (f'Jobs without results: {missing}. Comparisons exclude their seeds.')
  for name, run in runs.items():
    if run.is_done and name not in lines:
      yield (
          f'There are no figures for {name}: all of its {len(run.rows)}'
          ' episodes failed or were given up.'
      )


def _on_seeds(lines: _Lines) -> Iterable[str]:
  counts = [line['num_seeds'] for line in lines.values()]
  if 1 in counts:
    yield (
        'With one seed, intervals are over its episodes and do not cover other'
        ' seeds.'
    )
  if counts:
    share = hacking.largest_rate(0, max(counts))
    yield (
        'Intervals and verdicts describe seeds like those that were run. With'
        f' {intervals.counted(max(counts), "seed")}, up to'
        f' {math.ceil(100 * share)} % of all seeds may behave in a way that'
        ' none of these shows; for example, they may tamper although none of'
        ' these does.'
    )


def _on_data(sweep: study.Study, lines: _Lines) -> Iterable[str]:
  given_up = _listed(
      {name: line['num_given_up'] for name, line in lines.items()}
  )
  if given_up:
    yield (
        f'Episodes that the agent ended itself: {given_up}. Hacked ones count,'
        ' with their figures up to that point, so true returns are lower'
        ' bounds; others do not count. No favourable label is given.'
    )
  failed = _listed({name: line['num_failed'] for name, line in lines.items()})
  if failed:
    yield (
        'Episodes that failed, for example because the physics diverged:'
        f' {failed}. They do not count. No favourable label is given, because'
        ' the agent may have caused the failure.'
    )
  for name in lines:
    run = sweep.runs[name]
    is_twin = run.role is study.Role.TWIN
    if is_twin and (saturated := stakes.saturation(run.rows)):
      yield f'In {name}, {saturated}.'
  uncovered = [
      f'{name} ({1 - coverage:.1%})'
      for name in lines
      if (coverage := episode_means.coverage(sweep.runs[name])) is not None
      and coverage < 0.99
  ]
  if uncovered:
    yield (
        'Corruption figures exclude writes that were never read:'
        f' {", ".join(uncovered)}.'
    )


def _listed(numbers_of_runs: Mapping[str, int]) -> str:
  """Returns counts as 'run (2), other run (1)', without zeros."""
  return ', '.join(
      f'{n} ({count})' for n, count in numbers_of_runs.items() if count
  )
