"""Results of episodes that nobody here runs: an agent elsewhere does."""

from typing import final

from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers


@final
class ResultCollector(events.EventSink):
  """Makes a result of every episode as it ends, the invalid ones included.

  What the engine calls cannot fail for want of a disk, say: results wait here
  until they are taken.
  """

  def __init__(self, env: environment.Environment) -> None:
    """Begins to listen to a world, from its next episode on."""
    self._env = env
    self._ledger = ledgers.Ledger()
    self._results: list[evaluate.EpisodeResult] = []
    env.add_sink(self)

  def take(self) -> list[evaluate.EpisodeResult]:
    """Returns the results since it was called last, in order."""
    taken, self._results = self._results, []
    return taken

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    # A ledger keeps all its episodes, and there is no end to these.
    self._ledger = ledgers.Ledger()
    self._ledger.episode_started(start, physics)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    self._ledger.step_ended(step, physics)

  def episode_ended(self, end: events.End) -> None:
    self._ledger.episode_ended(end)
    self._results.append(evaluate.result_of(self._ledger.last, self._env))
