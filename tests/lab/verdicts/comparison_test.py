"""Summaries of runs, and differences of true returns in pairs of episodes."""

import math

import pytest

from realab_suite import errors
from realab_suite.lab.verdicts import comparison
from tests.evaluation import episodes

_RUN = episodes.run()


def _summary(run):
  return comparison.summary('ours', run)


def _gained(ours, theirs=_RUN):
  return comparison.gained('ours', ours, theirs)


def test_figures_are_means_over_seeds_of_their_own_kind():
  noise = episodes.noise
  run = episodes.run(noise(1.0, 5.0), noise(0.1, 1.0), noise(2.0, 30.0))
  found = _summary(run)
  assert (found['num_seeds'], found['num_episodes']) == (10, 20)
  assert (found['num_given_up'], found['num_failed']) == (0, 0)
  for interval, mean in (
      (found['true_return'], 5.0),
      (found['observed_return'], 30.0),
      (found['corruption'], 1.0),
      (_gained(run), -5.0),
  ):
    assert interval.estimate == pytest.approx(mean)
    assert interval.level == 0.95


def test_failed_episodes_are_not_used_and_given_up_ones_count_if_hacked():
  run = episodes.run(9.0, 0.25)
  found = _summary(episodes.changed(run, (0, 0), (3, 1), **episodes.FAILED))
  numbers = found['num_episodes'], found['num_given_up'], found['num_failed']
  assert numbers == (18, 0, 2)
  assert found['true_return'].estimate == 9.0
  run = episodes.changed(
      run, (0, 0), (3, 1), **episodes.GIVEN_UP, corruption=2.25, gain=0.2
  )
  run = episodes.changed(run, (5, 0), **episodes.GIVEN_UP, gain=0.1)
  found = _summary(run)
  numbers = found['num_episodes'], found['num_given_up'], found['num_cut']
  assert (*numbers, found['num_failed']) == (19, 3, 2, 0)
  assert found['corruption'].estimate == pytest.approx(0.45)


@pytest.mark.parametrize('number', [2, 20])
def test_episodes_that_were_not_read_have_no_corruption(number):
  run = episodes.run(4.0, 1.0)
  run[:number] = episodes.changed(run[:number], corruption=None)
  corruption = _summary(run)['corruption']
  assert corruption is None if number == 20 else corruption.estimate == 1.0


@pytest.mark.parametrize(
    ('run', 'failed', 'given_up'),
    [
        ([], 0, 0),
        (episodes.changed(_RUN, **episodes.FAILED), 20, 0),
        (episodes.changed(_RUN, **episodes.GIVEN_UP), 0, 20),
    ],
)
def test_a_run_without_an_episode_that_counts_is_refused(run, failed, given_up):
  message = (
      f"run 'ours' has no episode that counts: {failed} failed, {given_up} were"
      ' given up'
  )
  with pytest.raises(errors.ResultsError, match=message):
    _summary(run)


# Pairs.


def test_differences_pair_episodes_by_number():
  # Episodes differ far more from each other than the two runs do.
  theirs = [
      episodes.Episode(seed, i, true_return=100.0 * i + seed)
      for seed in range(4)
      for i in range(3)
  ]
  ours = [
      episodes.Episode(one.seed, one.episode, true_return=one.true_return - 1)
      for one in theirs
  ]
  found = _gained(ours[::-1], theirs)
  assert (found.estimate, found.low, found.high) == (-1.0, -1.0, -1.0)


def test_an_episode_that_failed_in_one_run_is_left_out_of_pairs():
  ours = episodes.changed(
      _RUN, *((seed, 0) for seed in episodes.SEEDS), true_return=50.0
  )
  theirs = episodes.changed(
      _RUN, *((seed, 0) for seed in episodes.SEEDS), **episodes.FAILED
  )
  assert _gained(ours, theirs).estimate == 0.0


@pytest.mark.parametrize(
    ('ours', 'theirs', 'message'),
    [
        (episodes.run(seeds=[0, 1]), episodes.run(seeds=[0, 2]),
         r'differ in \(seed, world, episode\): \[\(1, 0, 0\), \(1, 0, 1\)'),
        (episodes.run(seeds=[0]), episodes.run(seeds=[0], episodes=1),
         r'\[\(0, 0, 1\)\]; a paired comparison needs the same episodes'),
        (episodes.changed(episodes.run(seeds=[0]), (0, 0), **episodes.FAILED),
         episodes.changed(episodes.run(seeds=[0]), (0, 1), **episodes.FAILED),
         'share no episode that counts in both'),
    ],
)  # fmt: skip
def test_runs_without_pairs_are_refused(ours, theirs, message):
  with pytest.raises(errors.ResultsError, match=message):
    _gained(ours, theirs)


# Bounds.


@pytest.mark.parametrize(
    ('top', 'returns', 'bounds'),
    [
        (18.0, [0.0, 17.0], (0.0, 18.0)),
        (None, [0.0, 17.0], (0.0, None)),
        (math.inf, [0.0, 17.0], (0.0, None)),
        # Tasks whose rewards may be negative, or that name too little.
        (18.0, [-1.0, 17.0], (None, 18.0)),
        (None, [-1.0, 17.0], (None, None)),
        (16.0, [0.0, 17.0], (0.0, None)),
        (0.0, [0.0, 0.0], (0.0, None)),
    ],
)
def test_returns_have_the_bounds_of_the_task(top, returns, bounds):
  run = [
      episodes.Episode(0, i, true_return=value, max_true_return=top)
      for i, value in enumerate(returns)
  ]
  assert comparison.return_bounds(run) == bounds
  found = comparison.return_bounds(
      [*run, episodes.Episode(0, 9, **episodes.FAILED, max_true_return=1e3)]
  )
  assert found == bounds
  assert comparison.return_bounds(run, [-2.0])[0] is None
