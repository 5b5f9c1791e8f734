"""Doubts about stakes: payments to the solver alone, or at once.

A jackpot makes a stake as large as its author likes, and beside such a stake no
gain counts. The true return tells it from what competence is worth.
"""

from collections.abc import Iterable
from typing import Final, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.evaluation import gains

DISTRACTION: Final = 0.5
"""Share of random steps of a solver with half of its competence."""

# Least share of a stake that half a solver earns, per share of the true return,
# where that is not too small; and the largest share. Shipped designs: 0.35 or
# more, and up to 1.1.
_LEAST_KEPT, _LEAST_TRUE = 0.25, 0.1
_MOST_KEPT = 1.25
# Largest share of a stake that a fifth of an episode may pay, beyond its share
# of the true return, which feedback follows within a few steps. Shipped
# designs: up to 0.26.
_MOST_AT_ONCE = 1 / 3
_AT_ONCE = 0.2
_DELAY = 10


def doubt(half: np.ndarray, episodes: Iterable[np.ndarray]) -> str | None:
  """Returns why a stake is not confirmed, or `None`.

  Args:
    half: What half a solver earns in each episode, `(2, episodes)`: as a share
      of the stake, and of the true return of the solver.
    episodes: What the solver earns in each step, `(2, steps)`, by episode.
  """
  stake, true = half[:, half[1] > _LEAST_TRUE]
  if len(true) and np.median(stake / true) < _LEAST_KEPT:
    return (
        'a solver that acts at random half of the time earns hardly any of it'
    )
  if len(true) and np.median(stake) > _MOST_KEPT:
    return 'a solver that acts at random half of the time earns more'
  if np.median([_at_once(*steps) for steps in episodes]) > _MOST_AT_ONCE:
    return 'the solver gets much of it at once, for little true return'
  return None


def _at_once(paid: np.ndarray, true: np.ndarray) -> float:
  """Returns the largest payment of a fifth of an episode beyond its worth."""
  # What every step pays is no event.
  paid, true = (
      np.concatenate([[0.0], np.cumsum(one)])
      for one in (paid - np.median(paid), true)
  )
  start, end = np.triu_indices(len(paid), 1)
  is_short = end - start <= max(1, _AT_ONCE * (len(paid) - 1))
  start, end = start[is_short], end[is_short]
  deserved = true[end] - true[np.maximum(start - _DELAY, 0)]
  return float((paid[end] - paid[start] - deserved).max())


@final
class Payments(events.BatchEventSink):
  """Records the first episode in each world of a batch.

  Attributes:
    steps: Terms of the objective in each step, and the true reward, by world.
  """

  def __init__(self, batch: batch_environment.BatchEnvironment) -> None:
    """Makes a sink, to be passed to `batch.add_sink`."""
    number = batch.num_envs
    self.steps: list[list[tuple[dict[str, gains.Value], float]]] = [
        [] for _ in range(number)
    ]
    self._gains = gains.Accumulator(batch.mechanism.design, (number,))
    self._goes_on = np.full(number, True)

  def step_ended(self, step: events.BatchStep) -> None:
    counts = ~(step.is_first | step.has_failed)
    if counts.any():
      self._gains.add(step.agent_reads, step.action, counts)
    for world in np.flatnonzero(counts & self._goes_on).tolist():
      terms = self._gains.terms(world)
      self.steps[world].append((terms, float(step.true_reward[world])))
    self._gains.begin(step.is_first)
    self._goes_on[list(step.ends)] = False
