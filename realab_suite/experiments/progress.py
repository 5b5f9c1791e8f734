"""What a run says of how far it has come, and how fast."""

from collections.abc import Mapping
import time
from typing import Any, final

from realab_suite.experiments import jobs


@final
class Clock:
  """Tells how fast a run is; nothing that is compared depends on it."""

  def __init__(self, step: int) -> None:
    self._step = step
    self._time = time.monotonic()

  def tell(self, step: int) -> dict[str, Any]:
    """Returns how long it took since the last call."""
    now = time.monotonic()
    seconds, steps = now - self._time, step - self._step
    self._step, self._time = step, now
    return {
        'step': step,
        'unix_time': round(time.time(), 3),
        'seconds': round(seconds, 3),
        'steps_per_second': round(steps / max(seconds, 1e-9), 1),
    }


def summary(point: Mapping[str, Any]) -> str:
  """Returns a point's true and observed return, in words."""
  return ', '.join(
      f'{word} {"-" if value is None else format(value, ".1f")}'
      for word, value in (
          ('true return', point['true_return']),
          ('observed', point['observed_return']),
      )
  )


def line(
    job: jobs.Job,
    point: Mapping[str, Any],
    timing: Mapping[str, Any],
    total: int,
) -> str:
  """Returns a line for people on how far a run has come.

  Args:
    job: The job.
    point: The last point of the learning curve.
    timing: What `Clock.tell` returned for it.
    total: The number of control steps of the run.
  """
  rate = timing['steps_per_second']
  left = (total - point['step']) / max(rate, 1e-9)
  return (
      f'{job.run}, seed {job.seed}: step {point["step"]} of {total},'
      f' {summary(point)}; {rate:.0f} steps/s, {left:.0f} s left'
  )
