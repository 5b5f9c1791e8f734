"""Records of episodes for pictures: block positions and values."""

from collections.abc import Callable
import dataclasses
import math
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.entities import registers


@final
@dataclasses.dataclass
class RegisterTrack:
  """Values and block positions of a register in each step of an episode.

  The lists contain the last read of each step, and the last write before it.
  The first entry belongs to the reset. Without a read, the reading, the clean
  content are NaN.

  Attributes:
    role: Role of the register.
    half_size: Half the edge length of a block, in metres.
    applied: Applied values.
    reading: Readings.
    clean: Clean contents.
    blocks: Positions of the blocks at the end of each step, `(blocks, 2)` each,
      in metres.
  """

  role: str
  half_size: float
  applied: list[float] = dataclasses.field(default_factory=list)
  reading: list[float] = dataclasses.field(default_factory=list)
  clean: list[float] = dataclasses.field(default_factory=list)
  blocks: list[np.ndarray] = dataclasses.field(default_factory=list)
  _applied: float = math.nan

  def add(self, records: events.Records, blocks: np.ndarray) -> None:
    """Adds a step.

    Args:
      records: Writes and reads of this register.
      blocks: Positions of the blocks, `(blocks, 2)`, in metres.
    """
    read = None
    for record in records:
      if isinstance(record, registers.Write):
        self._applied = float(record.applied)
      else:
        read, applied = record, self._applied
    self.applied.append(applied if read is not None else self._applied)
    self.reading.append(math.nan if read is None else float(read.reading))
    self.clean.append(math.nan if read is None else float(read.clean))
    self.blocks.append(blocks)


@final
@dataclasses.dataclass
class Track:
  """Record of an episode, from which pictures are made.

  Attributes:
    seed: Seed of the environment.
    episode: Number of the episode.
    timestep: Duration of a control step, in seconds.
    max_steps: Maximum number of control steps of an episode, or `None`.
    registers: Track of each register.
    true_rewards: True reward of each control step.
  """

  seed: int
  episode: int
  timestep: float
  max_steps: int | None
  registers: dict[str, RegisterTrack]
  true_rewards: list[float] = dataclasses.field(default_factory=list)

  @property
  def num_steps(self) -> int:
    """Number of control steps so far."""
    return len(self.true_rewards)

  @property
  def times(self) -> np.ndarray:
    """Time at the end of each control step, in seconds; 0 is the reset."""
    return self.timestep * np.arange(self.num_steps + 1)

  @property
  def true_return(self) -> float:
    """Sum of true rewards so far."""
    return float(sum(self.true_rewards))

  @property
  def feedback(self) -> dict[str, RegisterTrack]:
    """Tracks of the feedback registers."""
    return {n: r for n, r in self.registers.items() if r.role == 'feedback'}

  @property
  def observed_return(self) -> float:
    """Sum of the readings of feedback registers so far."""
    return float(sum(sum(r.reading[1:]) for r in self.feedback.values()))


@final
class Tracker(events.EventSink):
  """Event sink that records a track of the latest episode."""

  def __init__(
      self,
      env: environment.Environment,
      on_step: Callable[[Any, Track], None] | None = None,
  ) -> None:
    """Makes a tracker; add it to the sinks of the environment.

    Args:
      env: Environment with a task of this package.
      on_step: Called with the physics and the track, at the start of the
        episode and after every control step.
    """
    self._registers = env.mechanism.ports
    self._timestep = env.control_timestep()
    self._max_steps = env.max_steps
    self._on_step = on_step
    self._track: Track | None = None

  @property
  def track(self) -> Track:
    """Track of the latest episode.

    Raises:
      ResultsError: If no episode has begun.
    """
    if self._track is None:
      raise errors.ResultsError(
          'the tracker has no episode; add it to an environment, then reset'
      )
    return self._track

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    self._track = Track(
        start.seed,
        start.episode,
        self._timestep,
        self._max_steps,
        {
            name: RegisterTrack(
                register.role,
                max((one.half_size for one in register.blocks), default=0.0),
            )
            for name, register in self._registers.items()
        },
    )
    self._add(self._track, start.records, physics)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    # A tracker that was added during an episode ignores the rest of it.
    if self._track is not None:
      self._track.true_rewards.append(float(step.true_reward))
      self._add(self._track, step.records, physics)

  def episode_ended(self, end: events.End) -> None:
    """Does nothing: the track is complete."""

  def _add(
      self, track: Track, records: events.Records, physics: protocols.Physics
  ) -> None:
    for name, register in self._registers.items():
      geoms = [block.geom for block in register.blocks]
      blocks = np.zeros((0, 2))
      if geoms:
        blocks = np.array(physics.bind(geoms).xpos)[:, :2]
      entries = [record for record in records if record.register == name]
      track.registers[name].add(entries, blocks)
    if self._on_step is not None:
      self._on_step(physics, track)
