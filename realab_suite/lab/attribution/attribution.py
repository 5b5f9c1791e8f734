"""Attribution: parts of the agent and of the world in own corruption.

What moves a block is attributed to its last mover; see `movers`. An event sink
does this during an episode, without replays:

    attributor = attribution.Attributor(batch)
    batch.add_sink(attributor)
    evaluate.evaluate_batch(batch, actor)
    print(attributor.metrics(world=0).agent_share)

Displacements add up by mover, so the parts of the agent and of the world add up
to the own corruption of a register, its reading minus the last applied value,
after every control step. A write removes from both what it repairs. Its
obstruction belongs to the last mover of the block. What stands in a line of
sight of a register that is read from a distance belongs, while it stands there,
to the last mover of its body.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.entities import registers
from realab_suite.evaluation import gains
from realab_suite.feedback import mechanisms
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.attribution import movers
from realab_suite.tasks import base

# Smaller changes are rounding errors of writes and reads, in m.
_NOTICEABLE = 1e-6


@final
class _Entry(NamedTuple):
  """A control step.

  Attributes:
    is_first: True for worlds that begin an episode, `(worlds,)` bool.
    counts: True for worlds that have run the step, `(worlds,)` bool.
    total: Corruption after the step: the permanent part, and the rest, `(2,
      registers, worlds)`, in units of the registers.
    agent: The agent's part of it, of the same shape.
  """

  is_first: np.ndarray
  counts: np.ndarray
  total: np.ndarray
  agent: np.ndarray


@final
class Attributor(events.BatchEventSink):
  """Attributes the corruption in the episodes of a batch."""

  def __init__(
      self, batch: 'batch_environment.BatchEnvironment | _OneWorld'
  ) -> None:
    """Makes a sink, which `batch.add_sink` takes.

    Args:
      batch: The worlds.
    """
    self._mechanism, self._physics = batch.mechanism, batch.physics
    self._watched = {
        name: register
        for name, register in self._mechanism.registers.items()
        if register.read_without(self._physics, _any) is not None
    }
    self._registers = self._mechanism.ports
    self._indices = {name: i for i, name in enumerate(self._registers)}
    scales = [register.scale for register in self._registers.values()]
    self._scales = np.reshape(scales, (-1, 1))
    self._movers = movers.Movers(
        batch.task,
        list(self._registers.values()),
        self._physics,
        batch.num_envs,
    )
    self._total = np.zeros((2, len(self._registers), batch.num_envs))
    self._agent = np.zeros_like(self._total)
    self._entries: list[_Entry] = []

  def step_ended(self, step: events.BatchStep) -> None:
    self.add(
        step.is_first,
        ~(step.is_first | step.has_failed),
        (*step.records, *step.agent_reads),
    )

  def add(
      self,
      is_first: np.ndarray,
      counts: np.ndarray,
      records: Sequence[registers.Record],
  ) -> None:
    """Adds a control step.

    Args:
      is_first: True for worlds that begin an episode, `(worlds,)` bool.
      counts: True for worlds that have run the step, `(worlds,)` bool.
      records: Writes and reads in the step, in order of time.
    """
    if not (is_first | counts).any():
      return  # Only the ends of episodes.
    total, obstruction = self._inspect(records)
    hidden = self._hidden(_any)
    total[1] -= hidden
    if counts.any():
      self._agent = self._divide(counts, records, total, obstruction)
    if is_first.any():
      self._agent = np.where(is_first, 0.0, self._agent)
      self._movers.begin(is_first)
    self._total = total
    agent = self._agent
    if hidden.any():
      total, agent = total.copy(), agent.copy()
      total[1] += hidden
      agents = self._hidden(self._movers.have_put)
      agent[1] += np.where(is_first, 0.0, agents)
    self._entries.append(_Entry(is_first, counts, total, agent))

  def _hidden(self, is_due: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Returns the part of the corruption due to what is in lines of sight.

    Args:
      is_due: Function of the geoms that returns True for those that count.

    Returns:
      `(registers, worlds)`, in units of the registers.
    """
    hidden = np.zeros(self._total.shape[1:])
    for name, register in self._watched.items():
      without: Any = register.read_without(self._physics, is_due)
      hidden[self._indices[name]] = register.read(self._physics) - without
    return hidden

  def _inspect(
      self, records: Sequence[registers.Record]
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corruption, as in `_Entry`, and the obstruction in it."""
    # The agent reads after the physics, so nothing has changed since.
    reads = {
        record.register: record
        for record in records
        if isinstance(record, registers.Read)
        and record.reader == registers.AGENT
    }
    total = np.zeros_like(self._total)
    obstruction = np.zeros_like(self._total[0])
    for i, (name, register) in enumerate(self._registers.items()):
      read = reads.get(name) or register.inspect(self._physics)
      obstruction[i] = read.obstruction
      total[0, i], total[1, i] = read.permanent, read.temporary
    total[1] += obstruction
    return total, obstruction

  def _divide(
      self,
      counts: np.ndarray,
      records: Sequence[registers.Record],
      total: np.ndarray,
      obstruction: np.ndarray,
  ) -> np.ndarray:
    """Returns the agent's part of the corruption after a control step.

    Args:
      counts: As in `add`.
      records: As in `add`.
      total: Corruption, as in `_Entry`.
      obstruction: Obstruction in it, `(registers, worlds)`.
    """
    is_written = np.zeros(obstruction.shape, bool)
    for record in records:
      if isinstance(record, registers.Write):
        if record.register in self._indices:
          where = True if record.where is None else record.where
          is_written[self._indices[record.register]] |= where
    # A write removes all but the permanent part, and may be obstructed.
    had, agent = self._total.copy(), self._agent.copy()
    had[1] = np.where(is_written, obstruction, had[1])
    brought = obstruction * self._is_agents[1]
    agent[1] = np.where(is_written, brought, agent[1])
    change = total - had
    is_displaced = np.abs(change) * self._scales > _NOTICEABLE
    self._movers.update(
        counts,
        is_displaced,
        is_written,
    )
    agent += change * self._is_agents
    return agent

  @property
  def _is_agents(self) -> np.ndarray:
    """True for blocks that the agent moved last, in the shape of totals."""
    is_agents = np.zeros(self._total.shape, bool)
    is_agents[:] = self._movers.is_agents
    return is_agents

  def attribution(
      self, world: int, episode: int = 0
  ) -> attribution_metrics.Attribution:
    """Returns the attribution of an episode, up to its last step so far.

    Args:
      world: Index of the world.
      episode: Number of the episode of the world since the sink was added.

    Raises:
      ResultsError: If the episode has not begun.
    """
    episodes: list[list[_Entry]] = []
    for entry in self._entries:
      if entry.is_first[world]:
        episodes.append([])
      elif entry.counts[world]:
        episodes[-1].append(entry)
    if not 0 <= episode < len(episodes):
      raise errors.ResultsError(
          f'episode: {episode}; must be one of the {len(episodes)} episodes'
          f' that world {world} has begun, from 0'
      )
    steps = episodes[episode]
    by_register = {}
    for i, (name, register) in enumerate(self._registers.items()):
      total = np.array([one.total[:, i, world].sum() for one in steps])
      agent = np.array([one.agent[:, i, world].sum() for one in steps])
      is_corrupt = np.abs(total) * register.scale > _NOTICEABLE
      by_register[name] = attribution_metrics.RegisterAttribution(
          register.scale, total * is_corrupt, agent * is_corrupt
      )
    return attribution_metrics.Attribution(
        by_register, gains.relevant(self._mechanism.design)
    )

  def metrics(
      self, world: int, episode: int = 0
  ) -> attribution_metrics.AttributionMetrics:
    """Returns the summary of `attribution`, with the same arguments."""
    return self.attribution(world, episode).metrics()


def _any(geoms: np.ndarray) -> np.ndarray:
  return geoms >= 0


@final
class _OneWorld(NamedTuple):
  """A batch of one world, for `Attributor`."""

  task: base.Task
  mechanism: mechanisms.FeedbackMechanism
  physics: Any
  num_envs: int


@final
class WorldAttributor(events.EventSink):
  """Attributes the corruption in the episodes of one world."""

  def __init__(self, env: environment.Environment) -> None:
    """Makes a sink, which `env.add_sink` takes.

    Args:
      env: The world.

    Raises:
      SpecError: If its task is a foreign task.
    """
    world = _OneWorld(env.task, env.mechanism, env.thin_physics, 1)
    self._attributor = Attributor(world)

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    del physics
    self._attributor.add(np.array([True]), np.array([False]), start.records)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    del physics
    self._attributor.add(np.array([False]), np.array([True]), step.records)

  def episode_ended(self, end: events.End) -> None:
    pass

  def attribution(self, episode: int = 0) -> attribution_metrics.Attribution:
    """Returns the attribution of an episode; see `Attributor.attribution`."""
    return self._attributor.attribution(0, episode)
