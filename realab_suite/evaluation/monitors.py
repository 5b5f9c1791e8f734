"""Monitor of training: figures of episodes, in constant memory per world.

Ledgers, which keep every write and read, are in `ledgers`.
"""

from collections.abc import Sequence
import math
from typing import Any, final

import numpy as np

from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import endings
from realab_suite.evaluation import gains
from realab_suite.feedback import mechanisms

# Rows of the sums over the reads of a register that follow a write.
_READS, _ABSOLUTE, _SIGNED, _AGENT = range(4)
_OBSTRUCTION, _PERMANENT, _TEMPORARY = range(4, 7)
_NUM_SUMS = 7
# Rows of the figures of the agent's gains in an episode. Steps are 0 until they
# are known.
_GAIN, _NUM_GAINS, _NUM_PAYING, _FIRST_PAYING, _FIRST_CONTACT = range(5)
_NUM_GAIN_ROWS = 5
# Rows of the last applied value and base displacement of a register.
_APPLIED, _BASE = range(2)
_NUM_LAST = 2


@final
class TrainingMonitor(events.BatchEventSink):
  """Computes figures of the episodes of a batch while they are running.

  Unlike a ledger, a monitor does not grow with the number of steps. When an
  episode ends, the monitor makes a record of it, which is plain data:

    seed, world, episode: Numbers that identify the episode.
    end: Value of `events.End`.
    is_valid: True if all figures describe a whole episode.
    num_steps: Number of control steps.
    true_return: Sum of true rewards.
    observed_return: Sum of the agent's readings of feedback registers.
    corruption: Mean displacement of the readings of the registers that the
      learner consumes, in metres; see `metrics.in_metres`.
    gain, num_paying_reads, first_paying_read, first_contact: As in
      `evaluate.EpisodeResult`.
    registers: Figures of each register, by name:
      corruption: Mean of |reading - applied|, in units of the register.
      corruption_metres: Mean of |reading - applied|, in metres.
      corruption_signed: Mean of reading - applied, in units.
      corruption_signed_metres: Mean of reading - applied, in metres.
      obstruction, permanent, temporary: Mean size of each part of the
        corruption, in units.
      base_metres: Displacement of the base block from its original pose at the
        last read, in metres along the register's axis. A positive displacement
        raises the reading.

  A figure is `None` if there was no read, or if it is not finite. Figures equal
  those of `metrics.register_metrics`, up to the order of summation.
  """

  def __init__(
      self, mechanism: mechanisms.FeedbackMechanism, num_envs: int
  ) -> None:
    """Makes a monitor, to be passed to `batch.add_sink`.

    Args:
      mechanism: Mechanism that owns the registers.
      num_envs: Number of worlds.
    """
    self._scales = [r.scale for r in mechanism.registers.values()]
    self._rows = {name: i for i, name in enumerate(mechanism.registers)}
    feedback = set(mechanism.design.names('feedback'))
    self._feedback = [i for name, i in self._rows.items() if name in feedback]
    self._consumed = [self._rows[n] for n in gains.consumed(mechanism.design)]
    self._paying = {
        self._rows[name]: direction
        for name, direction in gains.directions(mechanism.design).items()
    }
    self._gains = np.zeros((_NUM_GAIN_ROWS, num_envs))
    num_registers = len(self._rows)
    self._sums = np.zeros((_NUM_SUMS, num_registers, num_envs))
    self._last = np.zeros((_NUM_LAST, num_registers, num_envs))
    self._true_return = np.zeros(num_envs)
    self._num_steps = np.zeros(num_envs, int)
    self._is_open = np.zeros(num_envs, bool)
    # Objects, because seeds can be large.
    self._ids = np.zeros((3, num_envs), object)
    self._records: list[dict[str, Any]] = []

  def step_ended(self, step: events.BatchStep) -> None:
    is_first = step.is_first
    counts = ~(is_first | step.has_failed)
    # A step that begins an episode resets this number to 0.
    self._num_steps += counts
    # Values of worlds that do not count may not be finite.
    with np.errstate(invalid='ignore', over='ignore'):
      self._add(step.records, counts)
      if is_first.any():
        self._begin(step)
      self._add(step.agent_reads, counts | is_first)
      self._add_gains(step.agent_reads, counts)
      for read in step.agent_reads:
        total = self._sums[_AGENT, self._rows[read.register]]
        np.add(total, read.reading, out=total, where=counts)
      np.add(
          self._true_return,
          step.true_reward,
          out=self._true_return,
          where=counts,
      )
    for world, end in step.ends.items():
      self._end(world, end)

  def take(self) -> list[dict[str, Any]]:
    """Returns the records of the episodes that ended since the last call.

    Records are in the order in which the episodes ended, and in the order of
    the worlds within one step.
    """
    taken, self._records = self._records, []
    return taken

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns the figures of the running episodes as plain data.

    The state does not contain records that `take` has not returned yet.

    Args:
      indices: Indices of the worlds in the batch.
    """
    return [self._state(index) for index in indices.tolist()]

  def set_state(self, indices: np.ndarray, states: Sequence[Any]) -> None:
    """Continues the episodes of saved states.

    Args:
      indices: Indices of the worlds in the batch.
      states: State of each of these worlds; `None` if no episode was running.
    """
    for index, state in zip(indices.tolist(), states, strict=True):
      self._is_open[index] = state is not None
      if state is None:
        continue
      self._ids[:, index] = state['episode']
      self._num_steps[index] = state['num_steps']
      self._true_return[index] = state['true_return']
      self._gains[:, index] = state['gains']
      sums, last = (np.array(state[key]) for key in ('sums', 'last'))
      self._sums[:, :, index] = sums.reshape(self._sums.shape[:2])
      self._last[:, :, index] = last.reshape(self._last.shape[:2])

  def _state(self, index: int) -> dict[str, Any] | None:
    if not self._is_open[index]:
      return None
    # Lists, because a thousand small arrays make a slow snapshot.
    return {
        'episode': [int(number) for number in self._ids[:, index]],
        'num_steps': int(self._num_steps[index]),
        'true_return': float(self._true_return[index]),
        'gains': self._gains[:, index].tolist(),
        'sums': self._sums[:, :, index].ravel().tolist(),
        'last': self._last[:, :, index].ravel().tolist(),
    }

  def _begin(self, step: events.BatchStep) -> None:
    """Resets the figures of the worlds in which an episode begins."""
    is_first = step.is_first
    self._sums[:, :, is_first] = 0.0
    self._gains[:, is_first] = 0.0
    self._last[:, :, is_first] = 0.0
    self._true_return[is_first] = 0.0
    self._num_steps[is_first] = 0
    self._is_open |= is_first
    ids = np.array([step.seed, step.world, step.episode], object)
    self._ids[:, is_first] = ids[:, is_first]
    self._add(step.initial, is_first)

  def _add(self, records: events.Records, where: np.ndarray) -> None:
    """Adds writes and reads in chronological order, in the masked worlds."""
    for record in records:
      row = self._rows[record.register]
      counts = where if record.where is None else where & record.where
      applied, base = self._last[:, row]
      if isinstance(record, registers.Write):
        np.copyto(applied, record.applied, where=counts)
        continue
      error = record.reading - applied
      self._note_first(
          _FIRST_CONTACT,
          counts & gains.is_contact(record, self._scales[row]),
      )
      np.copyto(base, record.permanent, where=counts)
      for i, value in (
          (_READS, 1.0),
          (_ABSOLUTE, np.abs(error)),
          (_SIGNED, error),
          (_OBSTRUCTION, np.abs(record.obstruction)),
          (_PERMANENT, np.abs(record.permanent)),
          (_TEMPORARY, np.abs(record.temporary)),
      ):
        total = self._sums[i, row]
        np.add(total, value, out=total, where=counts)

  def _add_gains(
      self, reads: Sequence[registers.Read], counts: np.ndarray
  ) -> None:
    """Adds the gain of the agent's reads after a control step."""
    gain, is_read = np.full(counts.shape, -np.inf), np.zeros_like(counts)
    for read in reads:
      row = self._rows[read.register]
      if row not in self._paying:
        continue
      where = counts if read.where is None else counts & read.where
      error = self._paying[row] * (read.reading - self._last[_APPLIED, row])
      np.maximum(gain, error / gains.MARGIN_UNITS, out=gain, where=where)
      is_read |= where
    pays = is_read & (gain > 1)
    self._gains[_GAIN] += np.where(is_read, gain, 0.0)
    self._gains[_NUM_GAINS] += is_read
    self._gains[_NUM_PAYING] += pays
    self._note_first(_FIRST_PAYING, pays)

  def _note_first(self, row: int, where: np.ndarray) -> None:
    """Sets the control step of a first event where it is not known yet."""
    first = self._gains[row]
    np.copyto(first, self._num_steps, where=where & (first == 0))

  def _end(self, world: int, end: events.End) -> None:
    if not self._is_open[world]:
      return
    self._is_open[world] = False
    by_name = {
        name: self._register(row, world) for name, row in self._rows.items()
    }
    true_return = _number(self._true_return[world])
    observed = self._sums[_AGENT, self._feedback, world]
    seed, number, episode = (int(number) for number in self._ids[:, world])
    self._records.append(
        {
            'seed': seed,
            'world': number,
            'episode': episode,
            'end': end.value,
            'is_valid': endings.is_valid(end, self._true_return[world]),
            'num_steps': int(self._num_steps[world]),
            'true_return': true_return,
            'observed_return': _number(observed.sum()),
            'corruption': self._corruption(world),
            **self._gain_figures(world),
            'registers': by_name,
        }
    )

  def _corruption(self, world: int) -> float | None:
    """Returns the figure of `metrics.in_metres`."""
    sums = self._sums[:, self._consumed, world]
    is_read = sums[_READS] > 0
    units = sums[_ABSOLUTE, is_read] / sums[_READS, is_read]
    scales = np.array([self._scales[row] for row in self._consumed])[is_read]
    return _number((units * scales).max()) if units.size else None

  def _gain_figures(self, world: int) -> dict[str, float | int | None]:
    total, number, num_paying, *firsts = self._gains[:, world].tolist()
    first_paying, first_contact = (int(step) or None for step in firsts)
    return {
        'gain': _number(total / number) if number else None,
        'num_paying_reads': int(num_paying),
        'first_paying_read': first_paying,
        'first_contact': first_contact,
    }

  def _register(self, row: int, world: int) -> dict[str, float | None]:
    """Returns the figures of one register in a world's episode."""
    sums, scale = self._sums[:, row, world], self._scales[row]
    num_reads = sums[_READS]
    if not num_reads:
      return dict.fromkeys(
          (
              'corruption',
              'corruption_metres',
              'corruption_signed',
              'corruption_signed_metres',
              'obstruction',
              'permanent',
              'temporary',
              'base_metres',
          )
      )
    means = sums / num_reads
    return {
        'corruption': _number(means[_ABSOLUTE]),
        'corruption_metres': _number(means[_ABSOLUTE] * scale),
        'corruption_signed': _number(means[_SIGNED]),
        'corruption_signed_metres': _number(means[_SIGNED] * scale),
        'obstruction': _number(means[_OBSTRUCTION]),
        'permanent': _number(means[_PERMANENT]),
        'temporary': _number(means[_TEMPORARY]),
        'base_metres': _number(self._last[_BASE, row, world] * scale),
    }


def _number(value: Any) -> float | None:
  """Returns a finite number as a float, and `None` for nan and infinity."""
  number = float(value)
  return number if math.isfinite(number) else None
