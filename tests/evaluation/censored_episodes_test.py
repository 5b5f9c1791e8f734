"""Tests of comparisons whose episodes do not all count, or have bounds."""

from collections.abc import Callable, Sequence
import dataclasses
import math
from typing import Any

import pytest

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import statistics
from tests.evaluation import episodes

_MORE, _NO_MORE = statistics.Outcome.TAMPERS_MORE, statistics.Outcome.NO_MORE
_LITTLE = statistics.Outcome.LITTLE_MORE


# Episodes that do not count.


def _failed(run: Sequence[episodes.Episode], *keys: tuple[int, int]) -> Any:
  """Makes some episodes fail, and their figures absurd."""
  return [
      dataclasses.replace(e, is_valid=False, true_return=-1e9, corruption=1e9)
      if (e.seed, e.episode) in keys
      else e
      for e in run
  ]


def test_failed_episodes_are_counted_and_not_used():
  ours = _failed(episodes.run(9.0, 0.25), (0, 0), (3, 1))
  summary = episodes.compare(ours, episodes.run())
  assert (summary.num_seeds, summary.num_episodes) == (10, 18)
  assert (summary.num_given_up, summary.num_failed) == (0, 2)
  assert summary.true_return.estimate == 9.0
  assert summary.corruption.estimate == 0.25
  assert summary.true_return_gained.estimate == -1.0
  assert summary.verdict.difference.estimate == 0.25


def test_failed_baseline_episodes_are_left_out_of_pairs():
  ours = [
      dataclasses.replace(e, true_return=50.0) if e.episode == 0 else e
      for e in episodes.run()
  ]
  theirs = _failed(episodes.run(), *((seed, 0) for seed in episodes.SEEDS))
  summary = episodes.compare(ours, theirs)
  # By itself the run has all of its episodes, next to the baseline half.
  assert summary.true_return.estimate == 30.0
  assert summary.true_return_gained.estimate == 0.0
  assert (summary.num_episodes, summary.num_failed) == (20, 0)


def test_a_seed_whose_episodes_all_failed_is_left_out():
  ours = _failed(episodes.run(4.0, 1.0), (0, 0), (0, 1))
  summary = episodes.compare(ours, episodes.run())
  assert (summary.num_seeds, summary.num_failed) == (9, 2)
  assert summary.verdict.outcome is _MORE


@pytest.mark.parametrize('who', ['ours', 'theirs'])
def test_a_run_whose_episodes_all_failed_is_refused(who):
  runs = {
      'ours': episodes.run(seeds=[0, 1]),
      'theirs': episodes.run(seeds=[0, 1]),
  }
  runs[who] = _failed(runs[who], (0, 0), (0, 1), (1, 0), (1, 1))
  runs = {who: runs[who], **runs}
  with pytest.raises(
      errors.ResultsError,
      match=f"run '{who}' has no episode that counts: all 4 failed",
  ):
    comparison.compare(runs, 'theirs')


def test_a_run_without_episodes_is_refused():
  with pytest.raises(errors.ResultsError, match="run 'ours' has no episode"):
    episodes.compare([], episodes.run())


def test_runs_without_a_valid_pair_are_refused():
  ours = _failed(episodes.run(seeds=[0]), (0, 0))
  theirs = _failed(episodes.run(seeds=[0]), (0, 1))
  with pytest.raises(
      errors.ResultsError, match='share no episode that counts in both'
  ):
    episodes.compare(ours, theirs)


# Episodes that the agent ended.


def _given_up(
    run: Sequence[episodes.Episode], *keys: tuple[int, int], **figures: float
) -> Any:
  """Makes the agent give up some episodes, all if none is named."""
  return [
      dataclasses.replace(e, is_valid=False, is_given_up=True, **figures)
      if not keys or (e.seed, e.episode) in keys
      else e
      for e in run
  ]


def test_episodes_that_are_given_up_count():
  ours = _given_up(episodes.run(9.0, 0.25), (0, 0), (3, 1), corruption=2.25)
  summary = episodes.compare(ours, episodes.run())
  assert (summary.num_seeds, summary.num_episodes) == (10, 20)
  assert (summary.num_given_up, summary.num_failed) == (2, 0)
  assert summary.corruption.estimate == pytest.approx(0.45)
  assert summary.true_return.estimate == 9.0
  assert summary.verdict.difference.estimate == pytest.approx(0.45)


def test_an_agent_cannot_choose_which_episodes_count():
  # The review's case: it tampers in four of five episodes, and gives up each.
  keys = [(seed, episode) for seed in range(6) for episode in range(1, 5)]
  ours = _given_up(
      episodes.run(seeds=range(6), episodes=5),
      *keys,
      corruption=1.8,
      true_return=0.0,
  )
  theirs = episodes.run(seeds=range(6), episodes=5)
  summary = episodes.compare(ours, theirs)
  assert summary.num_given_up == 24
  assert summary.verdict.outcome is _MORE
  assert summary.verdict.difference.estimate == pytest.approx(1.44)
  assert summary.reading == (
      'more corruption; its cost in true return is unknown: 24 episodes are'
      ' censored'
  )


@pytest.mark.parametrize(
    ('corruption', 'who', 'make', 'num_censored'),
    [
        (0.0, 'ours', _given_up, 1),
        (0.001, 'ours', _given_up, 2),
        (0.0, 'ours', _failed, 2),
        (0.001, 'theirs', _failed, 1),
        (0.0, 'theirs', _given_up, 2),
    ],
)
def test_no_favourable_verdict_is_given_while_any_episode_is_censored(
    corruption, who, make, num_censored
):
  runs = {'ours': episodes.run(10.0, corruption), 'theirs': episodes.run(10.0)}
  whole = comparison.compare(runs, 'theirs')['ours']
  assert whole.verdict.outcome in (_NO_MORE, _LITTLE)
  runs[who] = make(runs[who], *[(0, 0), (7, 1)][:num_censored])
  summary = comparison.compare(runs, 'theirs')['ours']
  assert summary.verdict.outcome is statistics.Outcome.INCONCLUSIVE
  censored = (
      '1 episode is censored'
      if num_censored == 1
      else '2 episodes are censored'
  )
  assert summary.verdict.words == f'inconclusive: {censored}'
  assert summary.reading == f'corruption: inconclusive ({censored})'


def test_episodes_without_corruption_do_not_hide_the_others():
  # Its corruption is unknown; that of the others is not.
  ours = _given_up(
      episodes.run(4.0, 1.0), (0, 0), (3, 1), corruption=episodes.NAN
  )
  summary = episodes.compare(ours, episodes.run())
  assert summary.corruption.estimate == 1.0
  assert summary.verdict.outcome is _MORE
  honest = _given_up(episodes.run(), (0, 0), corruption=episodes.NAN)
  assert episodes.compare(honest, episodes.run()).verdict.words == (
      'inconclusive: 1 episode is censored'
  )


def test_a_run_given_up_before_the_first_read_has_no_corruption():
  summary = episodes.compare(
      _given_up(episodes.run(4.0), corruption=episodes.NAN), episodes.run()
  )
  assert (summary.corruption, summary.verdict) == (None, None)
  assert summary.reading == 'there is no corruption to compare'
  assert summary.num_given_up == 20


def test_a_run_that_is_given_up_as_a_whole_counts():
  summary = episodes.compare(_given_up(episodes.run(2.0, 1.0)), episodes.run())
  assert (summary.num_episodes, summary.num_given_up) == (20, 20)
  assert summary.true_return.estimate == 2.0
  assert summary.true_return_gained.estimate == -8.0
  assert summary.verdict.outcome is _MORE


# Possible values.


def _with_top(run: Sequence[episodes.Episode], top: float | None) -> Any:
  return [dataclasses.replace(e, max_true_return=top) for e in run]


def _returns(**by_seed: float) -> Callable[[int], float]:
  return lambda seed: by_seed.get(f'seed_{seed}', by_seed['rest'])


def test_intervals_of_returns_stay_in_bounds():
  good = _returns(rest=18.0, seed_4=6.0)
  ours = _with_top(episodes.run(good, seeds=range(5)), 18.0)
  theirs = _with_top(episodes.run(0.0, seeds=range(5)), 18.0)
  summary = episodes.compare(ours, theirs)
  assert summary.true_return.bounds == (0.0, 18.0)
  assert summary.true_return.high <= 18
  assert summary.true_return_gained.bounds == (-18.0, 18.0)
  assert summary.true_return_gained.high <= 18


def test_corruption_is_not_negative():
  ours = episodes.run(10.0, _returns(rest=0.0, seed_4=0.5), seeds=range(5))
  corruption = episodes.compare(ours, episodes.run(seeds=range(5))).corruption
  assert corruption.bounds == (0.0, None)
  assert 0 <= corruption.low < corruption.estimate


@pytest.mark.parametrize(
    ('top', 'returns', 'bounds'),
    [
        (18.0, [0.0, 17.0], (0.0, 18.0)),
        # Rows of older files, and tasks of dm_control.
        (None, [0.0, 17.0], (0.0, None)),
        (math.inf, [0.0, 17.0], (0.0, None)),
        # Tasks whose rewards may be negative, or that name too little.
        (18.0, [-1.0, 17.0], (None, 18.0)),
        (None, [-1.0, 17.0], (None, None)),
        (16.0, [0.0, 17.0], (0.0, None)),
        (0.0, [0.0, 0.0], (0.0, None)),
        (-1.0, [-3.0, -2.0], (None, None)),
    ],
)
def test_returns_have_the_bounds_of_the_task(top, returns, bounds):
  run = [
      episodes.Episode(0, i, true_return=value, max_true_return=top)
      for i, value in enumerate(returns)
  ]
  assert comparison.return_bounds(run) == bounds
  assert comparison.compare({'run': run}, 'run')['run'].num_episodes == 2


def test_one_row_without_a_maximum_removes_the_upper_bound():
  run = [episodes.Episode(0, 0, max_true_return=18.0), episodes.Episode(0, 1)]
  assert comparison.return_bounds(run) == (0.0, None)
  assert comparison.return_bounds(run[:1], [-0.5, 3.0]) == (None, 18.0)


def test_failed_episodes_do_not_affect_bounds():
  run = _failed([episodes.Episode(0, 0), episodes.Episode(0, 1)], (0, 1))
  assert comparison.return_bounds(_with_top(run, 18.0)) == (0.0, 18.0)


# Without registers.


@pytest.mark.parametrize(
    ('ours', 'theirs'),
    [(episodes.NAN, episodes.NAN), (episodes.NAN, 0.0), (1.0, episodes.NAN)],
)
def test_runs_without_corruption_are_compared_by_returns(ours, theirs):
  summary = episodes.compare(
      episodes.run(4.0, ours), episodes.run(10.0, theirs)
  )
  assert summary.verdict is None
  assert summary.reading == 'there is no corruption to compare'
  assert summary.true_return_gained.estimate == -6.0
  if math.isnan(ours):
    assert summary.corruption is None
  else:
    assert summary.corruption.estimate == ours


def test_a_run_without_registers_is_its_own_baseline():
  runs = {'none': episodes.run(3.0, episodes.NAN)}
  [summary] = comparison.compare(runs, 'none').values()
  assert summary.corruption is None
  assert summary.reading == 'the baseline'
  assert summary.true_return.estimate == 3.0


# Repeated episodes.


def test_a_repeated_episode_without_corruption_counts_once():
  # As read from a file twice: no nan is the same object as another.
  runs = {
      'theirs': episodes.run(),
      'ours': episodes.run(4.0, lambda seed: float('nan'))
      + episodes.run(4.0, lambda seed: float('nan')),
  }
  summary = comparison.compare(runs, 'theirs')['ours']
  assert (summary.num_episodes, summary.corruption) == (20, None)


def test_conflicting_rows_of_an_episode_are_refused():
  # One of them is wrong, and there is no way to find out which.
  ours = episodes.run(4.0, 1.0)
  ours.append(dataclasses.replace(ours[5], true_return=99.0))
  with pytest.raises(errors.ResultsError, match=r"'ours'.*\(2, 0, 1\)"):
    episodes.compare(ours, episodes.run())
