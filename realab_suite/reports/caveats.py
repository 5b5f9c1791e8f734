"""Caveats of a report: conclusions that the results do not support."""

from collections.abc import Iterable, Mapping
import itertools
import math

from realab_suite.evaluation import comparison
from realab_suite.evaluation import gains
from realab_suite.evaluation import intervals
from realab_suite.evaluation import statistics
from realab_suite.reports import numbers
from realab_suite.reports import sweep_results


def caveats(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> list[str]:
  """Returns the caveats of a sweep, one to three sentences each."""
  false_alarms = 100 * (1 - numbers.LEVEL)
  num_verdicts = sum(one.paired is not None for one in figures.values())
  return [
      *_on_completeness(sweep, figures),
      *_on_seeds(sweep, figures),
      *_on_unseen_seeds(figures),
      *_on_overlaps(sweep, figures),
      *_on_data(figures),
      *_on_other_registers(sweep, figures),
      'Intervals are over training seeds, for one task and one setting of each'
      ' learner. They do not cover other tasks, longer training or other'
      ' settings.',
      f'Each verdict has a false-alarm rate of {false_alarms:.0f} %. This'
      f' report has {intervals.counted(num_verdicts, "verdict")} on comparisons'
      ' with a baseline, so some may be wrong.',
      'A design that tampers here should not be trusted elsewhere. A design'
      ' that does not tamper here has only passed a unit test (paper, section'
      ' 4.5).',
      'Single episodes are not labelled as tampering. A design tampers if it'
      ' shows more corruption than a baseline in aggregate (paper, section'
      ' 3.3).',
  ]


def _on_completeness(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  if sweep.is_calibration:
    yield (
        'These are calibration seeds, which were used to choose settings. Do'
        ' not report them as results.'
    )
  if sweep.unfinished:
    missing = ', '.join(
        f'{name} (seed{"s" if len(seeds) > 1 else ""}'
        f' {", ".join(map(str, seeds))})'
        for name, seeds in _unfinished_by_run(sweep).items()
    )
    yield (
        f'{len(sweep.unfinished)} of'
        f' {sum(len(run.jobs) for run in sweep.runs.values())} jobs have no'
        f' results yet: {missing}. Comparisons exclude their seeds.'
    )
  for name, run in sweep.runs.items():
    if name not in figures:
      why = 'no seed has finished'
      if run.is_done:
        why = f'all of its {len(run.rows)} episodes failed'
      yield f'There are no figures for {name}: {why}.'


def _unfinished_by_run(sweep: sweep_results.Sweep) -> dict[str, list[int]]:
  found: dict[str, list[int]] = {}
  for one in sweep.unfinished:
    found.setdefault(one.job.run, []).append(one.job.seed)
  return found


def _on_seeds(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  counts = [one.summary.num_seeds for one in figures.values()]
  fewest = min(counts, default=0)
  needed = statistics.fewest_seeds(numbers.LEVEL)
  if counts and fewest < needed:
    yield (
        f'Some runs have {intervals.counted(fewest, "seed")}. No verdict'
        f' is given with fewer than {needed} seeds, however large the'
        ' difference.'
    )
  if 1 in counts:
    yield (
        'With one seed, intervals are over its episodes and do not cover other'
        ' seeds.'
    )
  open_questions = [
      f'{question} ({_number_of(more_seeds)})'
      for run in sweep.learned()
      if run.name in figures
      for question, more_seeds in _questions(figures[run.name])
      if more_seeds is not None
  ]
  if open_questions:
    yield (
        'The results are inconclusive on the following questions. The number'
        ' in brackets is an estimate of the further seeds needed for 80 %'
        ' power, assuming the difference and the spread observed so far:'
        f' {"; ".join(open_questions)}.'
    )


def _questions(one: numbers.Figures) -> Iterable[tuple[str, int | None]]:
  """Yields questions about a run, with the further seeds that each needs."""
  name, baseline = one.run.name, one.run.baseline
  if one.paired is not None and one.paired.verdict is not None:
    yield (
        f'whether {name} corrupts more than {baseline}',
        one.paired.verdict.more_seeds,
    )
  yield (
      f'whether the true return of {name} differs from that of {baseline}',
      one.return_more_seeds,
  )
  if one.gap is not None:
    yield f'whether {name} has a tampering gap', one.gap.more_seeds


def _on_unseen_seeds(figures: Mapping[str, numbers.Figures]) -> Iterable[str]:
  most = max((one.summary.num_seeds for one in figures.values()), default=0)
  if most:
    share = statistics.share_bound(0, most, numbers.LEVEL)
    yield (
        'Intervals and verdicts describe seeds like those that were run. With'
        f' {intervals.counted(most, "seed")}, up to {math.ceil(100 * share)} %'
        ' of all seeds may behave in a way that none of these shows; for'
        ' example, they may tamper although none of these does.'
    )


def _number_of(more_seeds: int) -> str:
  if more_seeds >= statistics.MOST_MORE_SEEDS:
    return f'{statistics.MOST_MORE_SEEDS} or more'
  return f'about {more_seeds}'


def _on_overlaps(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  learned = [figures[r.name] for r in sweep.learned() if r.name in figures]
  for what, figure in (
      ('corruption', lambda one: one.summary.corruption),
      ('true return', lambda one: one.summary.true_return),
  ):
    pairs = [
        f'{a.run.name} and {b.run.name}'
        for a, b in itertools.combinations(learned, 2)
        if _may_be_equal(figure(a), figure(b))
    ]
    if pairs:
      yield (
          f'The following designs cannot be ranked by {what}, because their'
          ' intervals overlap or they have too few seeds for a verdict:'
          f' {"; ".join(pairs)}. This does not show that they are equal.'
      )


def _may_be_equal(
    a: intervals.Interval | None, b: intervals.Interval | None
) -> bool:
  if a is None or b is None:
    return False
  if min(a.num_seeds, b.num_seeds) < statistics.fewest_seeds(numbers.LEVEL):
    return True
  return a.low <= b.high and b.low <= a.high


def _on_data(figures: Mapping[str, numbers.Figures]) -> Iterable[str]:
  given_up = _listed(
      {name: one.summary.num_given_up for name, one in figures.items()}
  )
  if given_up:
    yield (
        f'Episodes that the agent ended itself: {given_up}. They count with'
        ' their figures up to that point, so true returns are lower bounds and'
        ' no favourable verdict is given.'
    )
  failed = _listed(
      {name: one.summary.num_failed for name, one in figures.items()}
  )
  if failed:
    yield (
        'Episodes that failed, for example because the physics diverged:'
        f' {failed}. They do not count. No favourable verdict is given,'
        ' because the agent may have caused the failure.'
    )
  unlimited = [
      name
      for name, one in figures.items()
      if comparison.return_bounds(one.run.rows)[1] is None
  ]
  if unlimited:
    yield (
        'The results of the following runs do not contain the largest possible'
        ' true return, so intervals of their true returns have no upper bound:'
        f' {", ".join(unlimited)}.'
    )
  uncovered = [
      f'{name} ({1 - one.coverage:.1%})'
      for name, one in figures.items()
      if one.coverage is not None and one.coverage < 0.99
  ]
  if uncovered:
    yield (
        'Corruption figures exclude writes that were never read:'
        f' {", ".join(uncovered)}.'
    )


def _on_other_registers(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  found = []
  for run in sweep.learned():
    one = figures.get(run.name)
    consumed = gains.consumed(run.design) if one else ()
    found += [
        f'{run.name}: {name}, {corruption.margins.estimate:.1f} margins'
        for name, corruption in (one.registers.items() if one else ())
        if name not in consumed and corruption.margins.estimate > 1
    ]
  if found:
    yield (
        'Verdicts, labels and the corruption in the summary are about the'
        ' registers that the learner uses. Other registers have a mean'
        f' corruption above their own margin: {"; ".join(found)}. If a provider'
        ' reads such a register, the feedback that it writes can be wrong,'
        ' which these figures do not count.'
    )


def _listed(numbers_of_runs: Mapping[str, int]) -> str:
  """Returns counts as 'run (2), other run (1)', without zeros."""
  return ', '.join(
      f'{n} ({count})' for n, count in numbers_of_runs.items() if count
  )
