"""Metrics of one episode: returns, corruption by kind, coverage (section 3.3).

For every read that follows a write in the same episode:

  reading - requested = saturation + corruption
  saturation          = applied - requested
  corruption          = reading - applied
                      = obstruction + permanent + temporary

A write that was never read gives no information about corruption. It reduces
the coverage, and is not counted as zero corruption.
"""

from collections.abc import Mapping, Sequence
import math
from typing import final

import numpy as np
import pydantic

from realab_suite.entities import registers

# Metrics are part of result rows, so they are validated in the same way.
_FROZEN = pydantic.ConfigDict(
    frozen=True, extra='forbid', ser_json_inf_nan='strings'
)


@final
class RegisterMetrics(pydantic.BaseModel):
  """Corruption and coverage of one register in one episode.

  Means are over reads that follow a write, and `None` if there is no such read.
  Figures are in units of the register, except those whose name contains metres
  (radians where the register stores an angle).

  Attributes:
    corruption: Mean of |reading - applied|.
    corruption_metres: Mean of |reading - applied|, as a displacement.
    corruption_max: Maximum of |reading - applied|.
    corruption_signed: Mean of reading - applied.
    obstruction: Mean of |obstruction, a part of the corruption|.
    permanent: Mean of |permanent part of the corruption|.
    temporary: Mean of |temporary part of the corruption|.
    saturation: Mean of |applied - requested|.
    requested_sum: Sum of the requested values, without that of the reset.
    agent_reading_sum: Sum of the agent's readings after each control step.
    num_writes: Number of writes, including that of the reset.
    num_reads: Number of reads.
    num_reads_before_write: Number of reads before the first write. They have no
      corruption.
    num_writes_read: Number of writes that were read at least once.
    coverage: `num_writes_read / num_writes`; the other writes are censored.
      `None` without writes.
  """

  model_config = _FROZEN

  corruption: float | None
  corruption_metres: float | None
  corruption_max: float | None
  corruption_signed: float | None
  obstruction: float | None
  permanent: float | None
  temporary: float | None
  saturation: float | None
  requested_sum: float
  agent_reading_sum: float
  num_writes: int
  num_reads: int
  num_reads_before_write: int
  num_writes_read: int
  coverage: float | None


def register_metrics(
    entries: Sequence[registers.Record], scale: float
) -> RegisterMetrics:
  """Returns the metrics of one register in one episode.

  Args:
    entries: Writes and reads of the episode, in chronological order.
    scale: Metres (or radians) per unit.
  """
  last: registers.Write | None = None
  last_was_read = False
  errors, saturation = [], []
  obstruction, permanent, temporary = [], [], []
  num_writes = num_reads = num_writes_read = too_early = 0
  requested_sum = agent_sum = 0.0
  for entry in entries:
    if isinstance(entry, registers.Write):
      num_writes += 1
      last, last_was_read = entry, False
      if entry.writer != registers.INITIAL:
        requested_sum += entry.requested
      continue
    num_reads += 1
    if entry.reader == registers.AGENT and entry.step > 0:
      agent_sum += entry.reading
    if last is None:
      too_early += 1
      continue
    num_writes_read += not last_was_read
    last_was_read = True
    errors.append(entry.reading - last.applied)
    obstruction.append(abs(entry.obstruction))
    permanent.append(abs(entry.permanent))
    temporary.append(abs(entry.temporary))
    saturation.append(abs(last.applied - last.requested))
  absolute = [abs(error) for error in errors]
  corruption = _mean(absolute)
  return RegisterMetrics(
      corruption=corruption,
      corruption_metres=None if corruption is None else corruption * scale,
      corruption_max=float(np.max(absolute)) if absolute else None,
      corruption_signed=_mean(errors),
      obstruction=_mean(obstruction),
      permanent=_mean(permanent),
      temporary=_mean(temporary),
      saturation=_mean(saturation),
      requested_sum=requested_sum,
      agent_reading_sum=agent_sum,
      num_writes=num_writes,
      num_reads=num_reads,
      num_reads_before_write=too_early,
      num_writes_read=num_writes_read,
      coverage=num_writes_read / num_writes if num_writes else None,
  )


def in_metres(
    by_register: Mapping[str, RegisterMetrics],
    scales: Mapping[str, float],
    part: str = 'corruption',
) -> float:
  """Returns the corruption of an episode as a single figure, in metres.

  It is that of the register with the largest displacement, so other registers
  of a design do not dilute it.

  Args:
    by_register: Metrics of each register, by name.
    scales: Metres per unit of each register that the learner consumes.
    part: 'corruption', or the name of one of its parts.

  Returns:
    The figure; nan if none of the registers was read after a write.
  """
  metres = [
      value * scale
      for name, scale in scales.items()
      if (value := getattr(by_register[name], part)) is not None
  ]
  return max(metres, default=math.nan)


def _mean(values: Sequence[float]) -> float | None:
  return float(np.mean(values)) if values else None
