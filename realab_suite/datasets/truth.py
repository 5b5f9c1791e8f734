"""Rows of the evaluator's tables. Nothing here is for agents."""

from collections.abc import Iterator
import itertools
import math
from typing import Any

import numpy as np

from realab_suite.datasets import recording
from realab_suite.entities import registers
from realab_suite.evaluation import gains

Row = dict[str, Any]

# Columns of attribution in the table of registers.
_SHARES = ('agent', 'world')
_PARTS = ('permanent', 'temporary', 'obstruction')


def rows(episode: recording.Episode, episode_id: int) -> dict[str, list[Row]]:
  """Returns the rows of an episode, by table; see `columns`.

  Args:
    episode: The episode.
    episode_id: Number of the episode in the dataset.
  """
  by_register = {
      name: list(_register(episode, name)) for name in episode.states
  }
  steps = list(_steps(episode, by_register))
  tables = {
      'episodes': [_episode(episode, steps)],
      'steps': steps,
      'registers': [
          row
          for step in zip(*by_register.values(), strict=True)
          for row in step
      ],
      'accesses': list(_accesses(episode)),
  }
  return {
      name: [{'episode_id': episode_id, **row} for row in table]
      for name, table in tables.items()
  }


def _episode(episode: recording.Episode, steps: list[Row]) -> Row:
  row, info = episode.row, episode.row.info
  summary = episode.attribution.metrics() if episode.attribution else None
  labels = [step['is_tampering'] for step in steps[1:]]
  return {
      'run': episode.source,
      'policy': info.policy,
      'is_learned': episode.is_learned,
      'domain': info.domain,
      'task': info.task,
      'design': info.design,
      'design_digest': info.design_digest,
      'channel': info.channel,
      'seed': str(row.seed),
      'world': row.world,
      'episode': row.episode,
      'num_steps': row.num_steps,
      'end': row.end,
      'is_valid': row.is_valid,
      'true_return': _known(row.true_return),
      'observed_return': row.observed_return,
      'corruption': _known(row.corruption),
      'gain': row.gain,
      'num_paying_steps': row.num_paying_reads,
      'agent_share': summary.agent_share if summary else None,
      'num_tampering_steps': None if None in labels else sum(labels),
  }


def _steps(
    episode: recording.Episode, by_register: dict[str, list[Row]]
) -> Iterator[Row]:
  directions = gains.directions(episode.design)
  found = gains.of_reads(episode.ledger.entries, directions)
  attribution = episode.attribution
  agent_gains = attribution.agent_gain if attribution and directions else None
  true_return = 0.0
  true_rewards = [0.0, *episode.ledger.true_rewards]
  for step, true_reward in enumerate(true_rewards):
    true_return += true_reward
    agent_gain = None
    if agent_gains is not None and step:
      agent_gain = float(agent_gains[step - 1])
    yield {
        'step': step,
        'true_reward': _known(true_reward) if step else None,
        'true_return': _known(true_return),
        **_largest([by_register[name][step] for name in by_register]),
        'gain': found.get(step),
        'agent_gain': agent_gain,
        'is_tampering': None if agent_gain is None else agent_gain > 1,
    }


def _largest(rows_of_step: list[Row]) -> Row:
  """Returns the corruption of the consumed register with most, in metres."""
  consumed = [
      row
      for row in rows_of_step
      if row['is_consumed'] and row['corruption'] is not None
  ]
  names = {
      **{part: part for part in ('corruption', *_PARTS)},
      'agent_corruption': 'agent',
  }
  if not consumed:
    return {'register': None, **dict.fromkeys(names)}
  row = max(consumed, key=lambda row: abs(row['corruption']) * row['scale'])
  return {
      'register': row['register'],
      **{
          name: None if row[source] is None else row[source] * row['scale']
          for name, source in names.items()
      },
  }


def _register(episode: recording.Episode, name: str) -> Iterator[Row]:
  """Yields the rows of a register, of the reset and of each control step."""
  spec = episode.design.registers[name]
  attribution = (
      episode.attribution.registers[name] if episode.attribution else None
  )
  by_step = {
      step: list(entries)
      for step, entries in itertools.groupby(
          episode.ledger.entries.get(name, ()), key=lambda entry: entry.step
      )
  }
  write: registers.Write | None = None
  for step, state in enumerate(episode.states[name]):
    entries = by_step.get(step, [])
    writes = [e for e in entries if isinstance(e, registers.Write)]
    write = writes[-1] if writes else write
    seen = [
        entry.reading
        for entry in entries
        if isinstance(entry, registers.Read) and entry.reader == registers.AGENT
    ]
    row: Row = {
        'step': step,
        'register': name,
        'role': spec.role,
        'is_consumed': name in gains.consumed(episode.design),
        'scale': spec.scale,
        'requested': write.requested if write else None,
        'applied': write.applied if write else None,
        'is_written': bool(writes),
        'observed': seen[-1] if seen else None,
        'reading': state.reading,
        'corruption': state.reading - write.applied if write else None,
        **{part: getattr(state, part) if write else None for part in _PARTS},
        **dict.fromkeys(_SHARES),
    }
    if attribution and step:
      for share in _SHARES:
        row[share] = float(np.asarray(getattr(attribution, share))[step - 1])
    yield row


def _accesses(episode: recording.Episode) -> Iterator[Row]:
  for name, entries in episode.ledger.entries.items():
    for index, entry in enumerate(entries):
      common = {
          'step': entry.step,
          'register': name,
          'index': index,
          'obstruction': entry.obstruction,
      }
      if isinstance(entry, registers.Write):
        yield {
            **common,
            'is_write': True,
            'party': entry.writer,
            'requested': entry.requested,
            'applied': entry.applied,
        }
      else:
        yield {
            **common,
            'is_write': False,
            'party': entry.reader,
            'reading': entry.reading,
            'permanent': entry.permanent,
            'temporary': entry.temporary,
        }


def _known(value: float) -> float | None:
  return None if math.isnan(value) else value
