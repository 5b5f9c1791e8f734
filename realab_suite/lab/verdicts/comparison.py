"""Summaries of runs, and differences between runs in the same episodes (3.3).

`counted` says which episodes count; `hacking` and `verdicts` what a run says
about tampering.
"""

from collections.abc import Iterable, Sequence
import math
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals

_Episodes = Sequence[results.EpisodeResult]


def summary(name: str, episodes: _Episodes) -> dict[str, Any]:
  """Returns the figures of a run.

  Args:
    name: Name of the run, for messages.
    episodes: Its episodes.

  Returns:
    The figures by their names.

    * num_seeds: Number of seeds.
    * num_episodes: Number of episodes that count.
    * num_given_up: Number of episodes that the agent ended.
    * num_cut: Number of these that count, because they are hacked. They count
      with the return up to their end, so `true_return` is a lower bound where
      rewards are not negative.
    * num_failed: Number of episodes that failed. They do not count.
    * true_return, observed_return: Means and intervals.
    * corruption: Mean and interval, in metres; `None` if no register was read.

  Raises:
    ResultsError: If no episode counts.
  """
  counting = counted.of(episodes)
  num_given_up = sum(episode.is_given_up for episode in episodes)
  num_cut = sum(episode.is_given_up for episode in counting)
  num_failed = len(episodes) - len(counting) - num_given_up + num_cut
  if not counting:
    raise errors.ResultsError(
        f'run {name!r} has no episode that counts: {num_failed} failed,'
        f' {num_given_up} were given up'
    )
  read = [episode for episode in counting if episode.corruption is not None]
  return {
      'num_seeds': len({episode.seed for episode in counting}),
      'num_episodes': len(counting),
      'num_given_up': num_given_up,
      'num_cut': num_cut,
      'num_failed': num_failed,
      'true_return': _mean(counting, 'true_return', return_bounds(counting)),
      'observed_return': _mean(
          counting, 'observed_return', intervals.UNBOUNDED
      ),
      'corruption': (
          _mean(read, 'corruption', intervals.NOT_NEGATIVE) if read else None
      ),
  }


def gained(
    name: str,
    episodes: _Episodes,
    others: _Episodes,
) -> intervals.Interval:
  """Returns the true return of a run minus that of another one, in pairs.

  Args:
    name: Name of the run, for messages.
    episodes: Its episodes.
    others: Episodes of the other run.

  Raises:
    ResultsError: If the runs do not have the same seeds and episodes, or no
      episode counts in both.
  """
  pairs = _pairs(name, episodes, others)
  differences: dict[int, list[float]] = {}
  for episode, counterpart in pairs:
    difference = episode.true_return - counterpart.true_return
    differences.setdefault(episode.seed, []).append(difference)
  low, high = return_bounds(one for pair in pairs for one in pair)
  return intervals.mean_interval(
      differences,
      bounds=(
          intervals.UNBOUNDED
          if low is None or high is None
          else (low - high, high - low)
      ),
  )


def return_bounds(
    episodes: Iterable[results.EpisodeResult], means: Iterable[float] = ()
) -> intervals.Bounds:
  """Returns the possible true returns of an episode.

  The upper bound is the largest true return that the task allows. Rows of older
  files and tasks of dm_control do not contain it, so they have no upper bound.
  The lower bound is 0, unless an episode has a negative return: tasks of this
  package give no negative rewards, but other tasks may.

  Args:
    episodes: Episodes whose returns must be within the bounds.
    means: Mean true returns that must be within the bounds as well.
  """
  counting = counted.of(episodes)
  returns = [*means, *(episode.true_return for episode in counting)]
  largest = max(returns, default=0.0)
  # Ignore a stated maximum that an episode exceeds.
  tops = {
      top
      if (top := episode.max_true_return) is not None and top >= largest
      else math.inf
      for episode in counting
  }
  high = max(tops, default=math.inf)
  return (
      0.0 if min(returns, default=0.0) >= 0 else None,
      high if 0 < high < math.inf else None,
  )


def by_seed(
    episodes: Iterable[results.EpisodeResult], attribute: str
) -> dict[int, list[float]]:
  """Returns a figure of every episode, grouped by seed.

  Args:
    episodes: The episodes.
    attribute: Name of the figure, for example 'true_return'.
  """
  values: dict[int, list[float]] = {}
  for episode in episodes:
    values.setdefault(episode.seed, []).append(getattr(episode, attribute))
  return values


def _pairs(
    name: str,
    episodes: _Episodes,
    others: _Episodes,
) -> list[tuple[results.EpisodeResult, results.EpisodeResult]]:
  """Returns the pairs of episodes that count in both runs."""
  treatment = {episode.key: episode for episode in episodes}
  control = {episode.key: episode for episode in others}
  if treatment.keys() != control.keys():
    only = sorted(treatment.keys() ^ control.keys())[:5]
    raise errors.ResultsError(
        f'run {name!r} and the other one differ in (seed, world, episode):'
        f' {only}; a paired comparison needs the same episodes in both'
    )
  pairs = [(treatment[key], control[key]) for key in sorted(treatment)]
  both = [pair for pair in pairs if len(counted.of(pair)) == 2]
  if not both:
    raise errors.ResultsError(
        f'run {name!r} and the other one share no episode that counts in both'
    )
  return both


def _mean(
    episodes: _Episodes,
    attribute: str,
    bounds: intervals.Bounds,
) -> intervals.Interval:
  return intervals.mean_interval(by_seed(episodes, attribute), bounds=bounds)


def means(rows: Sequence[results.EpisodeResult]) -> dict[str, Any]:
  """Returns the figures of the episodes of a seed that count.

  Args:
    rows: Its episodes.
  """
  counting = counted.of(rows)
  figures: dict[str, Any] = {'num_episodes': len(counting)}
  for name in ('true_return', 'observed_return', 'corruption'):
    values = [x for row in counting if (x := getattr(row, name)) is not None]
    figures[name] = float(np.mean(values)) if values else None
  return figures
