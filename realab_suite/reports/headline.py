"""Headline of a report: in words, which agents tamper and at what cost."""

from collections import Counter
from collections.abc import Mapping, Sequence
import dataclasses
from typing import final

from realab_suite.evaluation import gains
from realab_suite.evaluation import intervals
from realab_suite.evaluation import labels
from realab_suite.evaluation import statistics
from realab_suite.experiments import result_tables
from realab_suite.reports import numbers
from realab_suite.reports import seed_figures
from realab_suite.reports import sweep_results

_Label = labels.Label

_ONE_SEED = {
    _Label.TAMPERS: 'tampers',
    _Label.DOES_NOT_TAMPER: 'does not tamper',
    _Label.INCONCLUSIVE: 'may tamper',
    _Label.NEVER_FOUND_OUT: 'never found out how to tamper',
    _Label.NOT_AUDITED: (
        'does not tamper, perhaps because it never found out how (the design'
        ' is not audited)'
    ),
}
# Words for some of several seeds.
_SOME_SEEDS = {
    **_ONE_SEED,
    _Label.NOT_AUDITED: 'perhaps never found out how (not audited)',
}


@final
@dataclasses.dataclass(frozen=True)
class Headline:
  """Headline of a report.

  Attributes:
    runs: Names of the learned runs, those that tamper first.
    sentences: A sentence on each of them.
    note: Strength of this evidence.
  """

  runs: Sequence[str]
  sentences: Sequence[str]
  note: str


def headline(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    seeds: Mapping[str, Sequence[seed_figures.Seed]],
) -> Headline | None:
  """Returns the headline, or `None` if no learned agent has figures.

  Args:
    sweep: The sweep.
    figures: Figures of its runs.
    seeds: Figures of the seeds of its learned runs.
  """
  runs = [run for run in sweep.learned() if run.name in figures]
  if not runs:
    return None
  # Sorting keeps the order of the experiment otherwise.
  runs.sort(key=lambda run: -_share(seeds[run.name], _Label.TAMPERS))
  return Headline(
      [run.name for run in runs],
      [_sentence(sweep, figures, run, seeds[run.name]) for run in runs],
      _note([figures[run.name].summary.num_seeds for run in runs]),
  )


def _share(ones: Sequence[seed_figures.Seed], label: _Label) -> float:
  return sum(one.label is label for one in ones) / len(ones)


def _sentence(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    run: sweep_results.Run,
    ones: Sequence[seed_figures.Seed],
) -> str:
  one = figures[run.name]
  mean = ' on average,' if len(ones) > 1 else ''
  earned = f'earns {_return(one)}'
  if any(seed.label is _Label.TAMPERS for seed in ones):
    observed = number(one.summary.observed_return.estimate)
    earned = f'observes {observed} and {earned}'
  twin = sweep.twin(run)
  its_twin = figures.get(twin.name) if twin is not None else None
  twins = ''
  if its_twin is not None:
    earns = number(its_twin.summary.true_return.estimate)
    twins = f'; its secure twin earns {earns}'
  text = f'{run.name} {_labels(run, ones)}:{mean} it {earned}{twins}.'
  verdict = one.paired and one.paired.verdict
  if verdict is not None and not verdict.has_too_few_seeds:
    text += f' Verdict: {verdict.words}.'
  return text


def _labels(run: sweep_results.Run, ones: Sequence[seed_figures.Seed]) -> str:
  """Returns the labels of the seeds of a run, as a predicate."""
  counts = Counter(one.label for one in ones)
  if _Label.NONE in counts:
    if gains.directions(run.design):
      return 'has no label, because there is no baseline'
    return 'has no label, because its feedback has no direction that pays'
  if len(counts) == 1:
    [label] = counts
    many = f' in all {len(ones)} seeds' if len(ones) > 1 else ''
    # The second half of the longest words is a clause of its own.
    first, comma, rest = _ONE_SEED[label].partition(',')
    return f'{first}{many}{comma}{rest}'
  parts: list[str] = []
  for label, words in _SOME_SEEDS.items():
    if label in counts:
      of = f' of {len(ones)} seeds' if not parts else ''
      parts.append(f'{words} in {counts[label]}{of}')
  return ' and '.join([', '.join(parts[:-1]), parts[-1]])


def _note(num_seeds: Sequence[int]) -> str:
  fewest, needed = min(num_seeds), statistics.fewest_seeds(numbers.LEVEL)
  if fewest >= needed:
    return ''
  what = 'One seed is' if fewest == 1 else f'{fewest} seeds are'
  return (
      f'{what} a demonstration, not a verdict: a verdict on a design'
      f' {statistics.needed_seeds(fewest, needed)}.'
  )


def _return(one: numbers.Figures) -> str:
  """Returns the true return of a run, with the largest possible one."""
  interval: intervals.Interval = one.summary.true_return
  largest = interval.bounds[1]
  of = '' if largest is None else f' of {largest:g}'
  least = 'at least ' if one.summary.num_given_up else ''
  return f'{least}{number(interval.estimate)}{of}'


def number(value: float) -> str:
  """Returns a number for a sentence: '8,769', '10.9' or '-0.3'."""
  if abs(value) >= 100:
    return f'{value:,.0f}'
  text = result_tables.number_text(round(value, 1))
  return text if '.' in text else f'{float(text):.1f}'
