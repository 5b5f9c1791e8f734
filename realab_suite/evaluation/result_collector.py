"""Collection of episode results from an environment that others step.

`evaluate` runs policies itself.
"""

from typing import final

from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers


@final
class ResultCollector(events.EventSink):
  """Collects the result of every episode when it ends, including invalid ones.

  Results stay in memory until `take` returns them, because a sink that the
  engine calls must not fail, for example when a disk is full.
  """

  def __init__(self, env: environment.Environment) -> None:
    """Makes a collector and adds it to an environment as a sink.

    Args:
      env: The environment. Collection starts with its next episode.
    """
    self._env = env
    self._ledger = ledgers.Ledger()
    self._results: list[evaluate.EpisodeResult] = []
    env.add_sink(self)

  def take(self) -> list[evaluate.EpisodeResult]:
    """Returns the results since the last call, in order."""
    taken, self._results = self._results, []
    return taken

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    # A new ledger per episode, because a ledger keeps all its episodes.
    self._ledger = ledgers.Ledger()
    self._ledger.episode_started(start, physics)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    self._ledger.step_ended(step, physics)

  def episode_ended(self, end: events.End) -> None:
    self._ledger.episode_ended(end)
    self._results.append(evaluate.result_of(self._ledger.last, self._env))
