"""Tests of the ledger: the entries of episodes, and their ends."""

from typing import Any

import numpy as np
import pytest

from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from tests.evaluation import streams


def _write(
    requested: float, applied: float | None = None, **kwargs: Any
) -> Any:
  obstruction = np.array(kwargs.pop('obstruction', 0.0))
  step = kwargs.pop('step', 1)
  kwargs = {'register': 'reward', **kwargs}
  write = streams.write(requested, applied, **kwargs)
  return write._replace(obstruction=obstruction, step=step)


def _read(
    reading: float,
    parts: tuple[float, float, float] = (0.0, 0.0, 0.0),
    step: int = 1,
    **kwargs: Any,
) -> registers.Read:
  kwargs = {'register': 'reward', **kwargs}
  return streams.read(reading, parts=parts, **kwargs)._replace(step=step)


def _start(*records: Any, episode: int = 0) -> events.Start:
  return events.Start(7, 0, episode, records)


def _step(*records: Any, reward: float = 0.0) -> events.Step:
  return events.Step(records, np.zeros(1), np.array(reward))


def test_every_write_and_read_is_kept_in_order_with_its_control_step():
  ledger = ledgers.Ledger()
  ledger.episode_started(
      _start(_write(0.0, writer=registers.INITIAL, step=0), _read(0.0, step=0)),
      None,
  )
  ledger.step_ended(
      _step(
          _read(0.5, reader='p'),
          _write(15.0, 12.0, obstruction=0.5, clean=9.0),
          _read(11.0, (0.5, -2.0, 0.5), clean=9.0),
      ),
      None,
  )
  ledger.step_ended(_step(_write(2.0, register='score', step=2)), None)
  ledger.step_ended(_step(_write(3.0, step=3)), None)
  writer = 'providers[0]:constant'
  assert ledger.last.entries == {
      'reward': [
          registers.Write('reward', 'initial', 0, 0.0, 0.0, 0.0, 0.0),
          registers.Read('reward', 'agent', 0, 0.0, 0.0, 0.0, 0.0, 0.0),
          registers.Read('reward', 'p', 1, 0.5, 0.0, 0.0, 0.0, 0.5),
          registers.Write('reward', writer, 1, 15.0, 12.0, 0.5, 9.0),
          registers.Read('reward', 'agent', 1, 11.0, 0.5, -2.0, 0.5, 9.0),
          registers.Write('reward', writer, 3, 3.0, 3.0, 0.0, 3.0),
      ],
      'score': [registers.Write('score', writer, 2, 2.0, 2.0, 0.0, 2.0)],
  }


def test_an_entry_copies_numbers_out_of_arrays():
  ledger = ledgers.Ledger()
  write = registers.Write('reward', 'p', 1, *map(np.array, (1, 2, 3, 4.0)))
  values = map(np.array, (5, 6, 7, 8, 9.0))
  read, reward = registers.Read('reward', 'agent', 1, *values), np.array(5.0)
  ledger.episode_started(_start(write, read), None)
  ledger.step_ended(events.Step([], np.zeros(1), reward), None)
  for array in (*write[3:-1], *read[3:-1], reward):
    array[...] = -1.0
  assert ledger.last.entries['reward'] == [
      ('reward', 'p', 1, 1.0, 2.0, 3.0, 4.0, None),
      ('reward', 'agent', 1, 5.0, 6.0, 7.0, 8.0, 9.0, None),
  ]
  assert ledger.last.true_rewards == [5.0]
  numbers = [x for entry in ledger.last.entries['reward'] for x in entry[3:-1]]
  assert {type(x) for x in (*numbers, *ledger.last.true_rewards)} == {float}


@pytest.mark.parametrize('bad', [float('nan')])
def test_an_episode_without_a_true_return_is_censored(bad):
  ledger = ledgers.Ledger()
  ledger.episode_started(_start(), None)
  for reward in (1.0, bad, 2.0):
    assert ledger.last.end is None
    ledger.step_ended(_step(reward=reward), None)
  ledger.episode_ended(events.End.TIMEOUT)
  assert ledger.last.is_valid is False
  assert not np.isfinite(ledgers.true_return(ledger.last))
