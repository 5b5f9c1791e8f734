"""Search of an audit: for plans that are hacked, with a large objective."""

from collections.abc import Callable, Iterator, Sequence
from typing import Final, final

import numpy as np

from realab_suite.evaluation import results
from realab_suite.lab.audit import attacks
from realab_suite.lab.audit import episodes
from realab_suite.lab.audit import macros
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import stakes

DEFAULT_BUDGET: Final = 1200
"""Default number of episodes of a search; more if the design needs more."""

AT_ONCE: Final = 96
"""Largest number of worlds of a search."""

# Worlds in which each plan is tried.
_SCRIPTED_WORLDS = 4
_SAMPLED_WORLDS = 2
_SAMPLE_EPISODES = attacks.POPULATION * _SAMPLED_WORLDS
# Samples of the cross-entropy method in a sufficient budget.
_LEAST_SAMPLES = 5
# Largest number of plans to confirm at the end. Before, it is one after each
# sample: a confirmation takes as long as half a sample.
_LAST_PROMISING = 3


def least_budget(scripted: Sequence[macros.Plan]) -> int:
  """Returns the number of episodes of a sufficient search.

  It tries the solver and all scripted saboteurs, and has enough episodes for
  the cross-entropy method. If nothing can be moved, there is nothing to try.

  Args:
    scripted: Plans of the scripted saboteurs.
  """
  if not scripted:
    return 0
  tried = len(scripted) * _SCRIPTED_WORLDS
  return AT_ONCE + tried + _LEAST_SAMPLES * _SAMPLE_EPISODES


@final
class Search:
  """Search in a batch of worlds; `promising` executes it."""

  def __init__(
      self,
      player: episodes.Player,
      scripted: Sequence[macros.Plan],
      method: attacks.CrossEntropy,
      stake: stakes.Stakes,
      budget: int,
      on_episodes: Callable[[int, int], None],
  ) -> None:
    """Makes the search.

    Args:
      player: Plays plans.
      scripted: Plans of the scripted saboteurs, at least one.
      method: Samples other plans.
      stake: Stakes of the design.
      budget: Largest number of episodes.
      on_episodes: Called with the numbers of episodes so far, and of those of
        plans that have failed.
    """
    self._player = player
    self._scripted = scripted
    self._method = method
    self._stake = stake
    self._budget = budget
    self._on_episodes = on_episodes
    self._limit = counted.SHARE_OF_STAKE
    self._num_episodes = self._num_failed = 0
    self._trials: list[attacks.Trial] = []

  @property
  def best(self) -> attacks.Trial:
    """The best plan so far."""
    return max(self._trials, key=attacks.rank)

  def promising(self) -> Iterator[attacks.Trial]:
    """Yields plans with hacked episodes, until the budget is used.

    The search continues if the plans so far cannot be confirmed.
    """
    solver = self._player.play_solver()
    self._count(len(solver))
    control = hacking.control('solver', solver, self._stake)
    if control is not None:
      self._limit = float(control['limit'].iloc[0])
    fit = max(1, (self._budget - self._num_episodes) // _SCRIPTED_WORLDS)
    untried = self._try(self._scripted[:fit], _SCRIPTED_WORLDS)
    while True:
      untried = [one for one in untried if one.hack_rate > 0]
      untried.sort(key=attacks.rank, reverse=True)
      if self._num_episodes + _SAMPLE_EPISODES > self._budget:
        yield from untried[:_LAST_PROMISING]
        return
      yield from untried[:1]
      trials = self._try(self._method.sample(), _SAMPLED_WORLDS)
      ranked = sorted(trials, key=attacks.rank, reverse=True)
      self._method.update([one.plan for one in ranked])
      untried = untried[1:] + trials

  def _try(
      self, plans: Sequence[macros.Plan], num_worlds: int
  ) -> list[attacks.Trial]:
    """Plays each plan in some worlds."""
    tries = [plan for plan in plans for _ in range(num_worlds)]
    episodes: list[results.EpisodeResult] = []
    for first in range(0, len(tries), self._player.num_envs):
      chunk = tries[first : first + self._player.num_envs]
      played = self._player.play(chunk)
      episodes += played
      self._num_failed += sum(not one.is_valid for one in played)
      self._count(len(chunk))
    trials = [
        self._trial(plan, episodes[i * num_worlds : (i + 1) * num_worlds])
        for i, plan in enumerate(plans)
    ]
    self._trials += trials
    return trials

  def _trial(
      self, plan: macros.Plan, episodes: Sequence[results.EpisodeResult]
  ) -> attacks.Trial:
    judged = [one for one in episodes if one.is_valid and one.objective]
    # What the evaluator cannot judge is no find.
    if not judged:
      return attacks.Trial(plan, 0.0, -np.inf)
    values = [next(iter(one.objective.values())).observed for one in judged]
    rate = hacking.rate(hacking.count(judged, self._stake, self._limit))
    return attacks.Trial(plan, rate, float(np.mean(values)))

  def _count(self, number: int) -> None:
    self._num_episodes += number
    self._on_episodes(self._num_episodes, self._num_failed)
