"""Streams of writes and reads that tests tell sinks of."""

from collections.abc import Iterator, Sequence
import types
from typing import Any

import numpy as np

from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.feedback import objectives
from realab_suite.feedback import specs

Record = registers.Write | registers.Read
NAN = float('nan')
PROVIDER = 'providers[0]:constant'


def write(
    requested: Any,
    applied: Any = None,
    register: str = 'r',
    writer: str = PROVIDER,
    clean: Any = None,
    where: Any = None,
) -> registers.Write:
  """Returns a write, of which nothing was obstructed; `tell` numbers steps."""
  applied = requested if applied is None else applied
  clean = applied if clean is None else clean
  values = np.broadcast_arrays(requested, applied, 0.0, clean)
  return registers.Write(register, writer, 1, *values, where)


def read(
    reading: Any,
    clean: Any = None,
    register: str = 'r',
    reader: str = registers.AGENT,
    parts: Any = (0.0, 0.0, 0.0),
    where: Any = None,
) -> registers.Read:
  """Returns a read; `parts` are obstruction, permanent and temporary."""
  clean = reading if clean is None else clean
  values = np.broadcast_arrays(reading, *parts, clean)
  return registers.Read(register, reader, 1, *values, where)


def initial(value: Any, register: str = 'r') -> registers.Write:
  return write(value, register=register, writer=registers.INITIAL)


def tell(
    sink: Any,
    steps: Sequence[Sequence[Record]],
    end: events.End | None = events.End.TIMEOUT,
    actions: Sequence[Any] = (),
    true_reward: float = 0.0,
    episode: int = 0,
) -> None:
  """Tells a sink of an episode; the first of the steps is the reset."""
  steps = [
      [record._replace(step=number) for record in records]
      for number, records in enumerate(steps)
  ]
  sink.episode_started(events.Start(0, 0, episode, steps[0]), None)
  for i, records in enumerate(steps[1:]):
    action = np.asarray(actions[i] if actions else 0.0)
    sink.step_ended(events.Step(records, action, np.array(true_reward)), None)
  if end is not None:
    sink.episode_ended(end)


def monitor(
    design: specs.DesignSpec,
    objective: objectives.ObjectiveSpec | None = None,
) -> monitors.Monitor:
  """Returns a monitor of a world that is nothing but its design."""
  mechanism = types.SimpleNamespace(design=design, queries=[])
  env = types.SimpleNamespace(
      mechanism=mechanism, task=None, physics=None, num_substeps=1
  )
  return monitors.Monitor(env, objective)


def pairs(
    episodes: Sequence[ledgers.EpisodeLedger],
) -> Iterator[tuple[registers.Write, registers.Read]]:
  """Yields each read with the write before it in the same episode."""
  for episode in episodes:
    for entries in episode.entries.values():
      last = None
      for entry in entries:
        if isinstance(entry, registers.Write):
          last = entry
        elif last is not None:
          yield last, entry


class Made:
  """Episodes of a batch at random; values are eighths, so sums are exact."""

  def __init__(
      self, design: specs.DesignSpec, seed: int, num_envs: int
  ) -> None:
    self._design = design
    self._rng = np.random.default_rng(seed)
    self._num_envs = num_envs
    self.names = list(design.registers)
    self.lengths = self._rng.integers(1, 6, num_envs)
    self.actions = self._rng.integers(0, 4, (6, num_envs, 2)).astype(float)
    self.steps = [self._step(i) for i in range(6)]

  def _eighths(self, count: int) -> np.ndarray:
    return self._rng.integers(-40, 40, (count, self._num_envs)) / 8

  def _mask(self) -> np.ndarray:
    return self._rng.random(self._num_envs) < 0.6

  def _step(self, number: int) -> list[Record]:
    made: list[Record] = []
    for name in self.names:
      if not number:
        made.append(initial(np.clip(self._eighths(1)[0], -4, 4), name))
      for who in ('p', 'p2')[: self._rng.integers(3)]:
        where = self._mask() if self._rng.random() < 0.5 else None
        if self._rng.random() < 0.5 and number:
          requested, clean = self._eighths(2)
          applied = np.clip(requested, -4, 4)
          made.append(write(requested, applied, name, who, clean, where))
        else:
          made.append(self._read(name, who, where))
    for name in self.names:
      if self._design.registers[name].role in ('feedback', 'signal'):
        made.append(self._read(name, registers.AGENT))
    return [record._replace(step=np.full(self._num_envs, number))
            for record in made]  # fmt: skip

  def _read(self, name: str, who: str, where: Any = None) -> registers.Read:
    reading, clean, *parts = self._eighths(5)
    clean = np.where(self._mask(), clean, reading)
    return read(reading, clean, name, who, parts, where)

  def episode(self, world: int) -> list[list[Record]]:
    """Returns the steps of the episode of a world."""
    return [
        [kept for record in step
         if (kept := registers.of_world(record, world)) is not None]
        for step in self.steps[: self.lengths[world] + 1]
    ]  # fmt: skip
