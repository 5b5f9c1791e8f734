"""Streams of writes and reads, and a second way to compute their figures.

The oracle takes a whole episode from a ledger, and asks of every step and read
what the definitions say, in loops and without sums that are kept up to date.
"""

from collections.abc import Iterator, Mapping, Sequence
import math
import types
from typing import Any

import numpy as np
import pytest

from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.feedback import clean_contents
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


# The oracle.


def figures(
    episode: ledgers.EpisodeLedger,
    design: specs.DesignSpec,
    actions: Sequence[Any] = (),
    objective: objectives.ObjectiveSpec | None = None,
) -> dict[str, Any]:
  """Returns figures of `results.EpisodeResult`, by name."""
  objective = objective or design.objective
  found = {
      name: _of_register(episode, name, spec)
      for name, spec in design.registers.items()
  }
  used = objective.registers if objective else design.names('feedback')
  known = [found[n].corruption for n in used if found[n].corruption is not None]
  return {
      'num_steps': episode.num_steps,
      'true_return': math.fsum(episode.true_rewards),
      'observed_return': math.fsum(
          r.reading
          for name in design.names('feedback')
          for r in _by_agent(episode, name).values()
      ),
      'corruption': max(known, default=None),
      'objective': _objective(episode, design, objective, actions),
      'is_ended_by_tampering': _ended(episode, design),
      'registers': found,
  }


def _by_agent(
    episode: ledgers.EpisodeLedger, name: str
) -> dict[int, registers.Read]:
  """Returns the reads of the agent after control steps, by step."""
  return {
      entry.step: entry
      for entry in episode.entries.get(name, [])
      if isinstance(entry, registers.Read)
      if entry.reader == registers.AGENT and entry.step
  }


def _of_register(
    episode: ledgers.EpisodeLedger, name: str, spec: specs.RegisterSpec
) -> episode_figures.RegisterFigures:
  scale, role = spec.scale, spec.role
  entries = episode.entries.get(name, [])
  writes = [i for i, e in enumerate(entries) if isinstance(e, registers.Write)]
  rows: dict[int, list[float]] = {}
  read_writes = set()
  for i, entry in enumerate(entries):
    before = [k for k in writes if k < i]
    if i in writes or not before:
      continue
    applied = entries[before[-1]].applied
    read_writes.add(before[-1])
    own, *parts = [
        0.0 if x < clean_contents.NEGLIGIBLE_METRES else x
        for x in (
            abs(part) * scale
            for part in (
                entry.reading - applied, entry.obstruction, entry.permanent,
                entry.temporary,
            )
        )
    ]  # fmt: skip
    inherited = abs(applied - entry.clean) * scale
    whole = abs(entry.reading - entry.clean) * scale if own else inherited
    row = [own, whole, inherited, *parts]
    counts = entry.step > 0
    if role in ('feedback', 'signal'):
      counts = counts and entry.reader == registers.AGENT
    else:
      counts = counts and row[0] > rows.get(entry.step, [-1.0])[0]
    if counts:
      rows[entry.step] = row

  def mean(values: Sequence[float]) -> float | None:
    total = math.fsum(values) / len(values) if values else NAN
    return total if math.isfinite(total) else None

  own, corruption, inherited, *parts = (
      mean([row[k] for row in rows.values()]) for k in range(6)
  )
  return episode_figures.RegisterFigures(
      corruption=corruption,
      units=None if corruption is None else corruption / scale,
      own=own,
      inherited=inherited,
      **dict(
          zip(('obstruction', 'permanent', 'temporary'), parts, strict=True)
      ),
      saturation=mean(
          [
              abs(
                  np.clip(entries[k].requested, *spec.range)
                  - entries[k].requested
              )
              for k in writes
          ]
      ),
      num_writes=len(writes),
      coverage=len(read_writes) / len(writes) if writes else None,
      observed=(
          math.fsum(r.reading for r in _by_agent(episode, name).values())
          if role in ('feedback', 'signal')
          else None
      ),
  )


def _crossings(
    episode: ledgers.EpisodeLedger, design: specs.DesignSpec, side: str
) -> set[int]:
  """Returns the steps after which a signal crosses its threshold."""
  return {
      step
      for name, spec in design.registers.items()
      if spec.ends_episode is not None
      for step, entry in _by_agent(episode, name).items()
      if spec.ends_episode.is_crossed(getattr(entry, side))
  }


def _ended(episode: ledgers.EpisodeLedger, design: specs.DesignSpec) -> bool:
  return (
      episode.end is events.End.SIGNAL
      and episode.num_steps in _crossings(episode, design, 'reading')
      and not _crossings(episode, design, 'clean')
  )


def _objective(
    episode: ledgers.EpisodeLedger,
    design: specs.DesignSpec,
    objective: objectives.ObjectiveSpec | None,
    actions: Sequence[Any],
) -> dict[str, gains.Value]:
  if objective is None or not episode.num_steps:
    return {}
  over = min(_crossings(episode, design, 'clean'), default=episode.num_steps)

  def value(weights: Mapping[str, float], discount: float, side: str) -> float:
    total = 0.0
    last = episode.num_steps
    if side == 'clean':
      last = min(last, over)  # The clean episode has no more steps.
    for step in range(1, last + 1):
      values = {
          name: getattr(_by_agent(episode, name)[step], side)
          for name in weights
      }
      term = sum(weights[name] * values[name] for name in weights)
      if objective.kind == 'agreement':
        label = min(max(round(term), 0), 13)
        term = float(label == int(np.ravel(actions[step - 1])[-1]))
      total += discount ** (step - 1) * term
    return total if objective.kind == 'return' else total / last

  parts = {objective.kind: (objective.registers, 1.0)}
  if objective.discount not in (None, 1.0):
    parts[f'discounted {objective.kind}'] = (
        objective.registers, objective.discount,
    )  # fmt: skip
  if len(objective.registers) > 1:
    for name, weight in objective.registers.items():
      parts[f'{objective.kind} of {name}'] = {name: weight}, 1.0
  return {
      name: gains.Value(
          observed=value(*part, 'reading'), clean=value(*part, 'clean')
      )
      for name, part in parts.items()
  }


def check_alike(found: Any, expected: Any) -> None:
  """Compares figures of which one adds in another order."""
  found, other = (
      one.model_dump() if hasattr(one, 'model_dump') else one
      for one in (found, expected)
  )
  if isinstance(found, dict):
    for name, value in found.items():
      check_alike(value, other[name])
  elif found is None or isinstance(found, bool):
    assert found == other
  else:
    assert found == pytest.approx(other, rel=1e-12, abs=1e-12)
