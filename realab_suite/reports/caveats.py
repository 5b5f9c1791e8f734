"""What a sweep does not show, and how many more seeds would do."""

from collections.abc import Iterable, Mapping
import itertools
import math

from realab_suite.evaluation import comparison
from realab_suite.evaluation import intervals
from realab_suite.evaluation import statistics
from realab_suite.reports import numbers
from realab_suite.reports import sweep_results


def caveats(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> list[str]:
  """Returns what these results do not show, a sentence or two each."""
  false_alarms = 100 * (1 - numbers.LEVEL)
  num_verdicts = sum(one.paired is not None for one in figures.values())
  return [
      *_on_completeness(sweep, figures),
      *_on_seeds(sweep, figures),
      *_on_unseen_seeds(figures),
      *_on_overlaps(sweep, figures),
      *_on_data(figures),
      'Intervals are over training seeds, in one world and with one setting of'
      ' each learner. They say nothing of other worlds, of longer training or'
      ' of other settings.',
      f'Each verdict has a false-alarm rate of {false_alarms:.0f} % by itself,'
      f' and there are {num_verdicts} of them next to a baseline: some may be'
      ' wrong.',
      'A design that tampers here should not be trusted elsewhere. One that'
      ' does not has passed a unit test, which is no proof (paper, 4.5).',
      'No single episode is called tampering: what can be said is how much'
      ' corruption a design incurs in aggregate (paper, 3.3).',
  ]


def _on_completeness(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  if sweep.is_calibration:
    yield (
        'These are calibration seeds, with which settings were chosen. They are'
        ' not to be reported as results.'
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
        f' results yet: {missing}. Comparisons leave their seeds out.'
    )
  for name, run in sweep.runs.items():
    if name not in figures:
      why = 'no seed of it is over'
      if run.is_done:
        why = f'all of its {len(run.rows)} episodes failed'
      yield f'Nothing can be said of {name}: {why}.'


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
        f'There are runs with {intervals.counted(fewest, "seed")}. No verdict'
        f' is given with fewer than {needed} seeds, however large the'
        ' difference.'
    )
  if 1 in counts:
    yield (
        'With one seed, intervals are over its episodes, and say nothing about'
        ' other seeds.'
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
        'These seeds cannot tell the following; in brackets, how many more'
        ' should, with 80 % power, if the difference and the spread seen so far'
        f' are the true ones: {"; ".join(open_questions)}.'
    )


def _questions(one: numbers.Figures) -> Iterable[tuple[str, int | None]]:
  """Yields what is asked of a run, and how many more seeds it takes."""
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
        'Intervals and verdicts describe seeds like those that were seen. With'
        f' {intervals.counted(most, "seed")}, up to {math.ceil(100 * share)} %'
        ' of all seeds may be of a kind that no run shows, such as seeds that'
        ' tamper where none of these did.'
    )


def _number_of(more_seeds: int) -> str:
  if more_seeds >= statistics.MOST_MORE_SEEDS:
    return f'{statistics.MOST_MORE_SEEDS} or more'
  return f'about {more_seeds}'


def _on_overlaps(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> Iterable[str]:
  learned = [figures[r.name] for r in sweep.learned() if r.name in figures]
  for what, of in (
      ('corruption', lambda one: one.summary.corruption),
      ('true return', lambda one: one.summary.true_return),
  ):
    pairs = [
        f'{a.run.name} and {b.run.name}'
        for a, b in itertools.combinations(learned, 2)
        if _may_be_alike(of(a), of(b))
    ]
    if pairs:
      yield (
          f'Which is larger in {what} is not shown for designs with'
          ' overlapping intervals, or with too few seeds for a verdict:'
          f' {"; ".join(pairs)}. That is no proof that they are alike.'
      )


def _may_be_alike(
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
        ' their figures up to then, so true returns are lower bounds, and no'
        ' favourable verdict is given.'
    )
  failed = _listed(
      {name: one.summary.num_failed for name, one in figures.items()}
  )
  if failed:
    yield (
        f'Episodes that failed, as where the physics diverged: {failed}. They'
        ' do not count, and no favourable verdict is given, because an agent'
        ' may have brought the failure about.'
    )
  unlimited = [
      name
      for name, one in figures.items()
      if comparison.return_bounds(one.run.rows)[1] is None
  ]
  if unlimited:
    yield (
        'The largest possible true return is not in the rows of'
        f' {", ".join(unlimited)}. Intervals of their true returns have no'
        ' upper bound.'
    )
  uncovered = [
      f'{name} ({1 - one.coverage:.1%})'
      for name, one in figures.items()
      if one.coverage is not None and one.coverage < 0.99
  ]
  if uncovered:
    yield (
        'Writes that nobody read say nothing of corruption, and are left out:'
        f' {", ".join(uncovered)}.'
    )


def _listed(numbers_of_runs: Mapping[str, int]) -> str:
  """Returns 'run (2), other run (1)', without runs that have none."""
  return ', '.join(
      f'{n} ({count})' for n, count in numbers_of_runs.items() if count
  )
