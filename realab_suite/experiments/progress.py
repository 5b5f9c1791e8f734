"""Messages on the progress and the speed of a run."""

from collections.abc import Mapping
import time
from typing import Any, final

from realab_suite.experiments import jobs


@final
class Clock:
  """Measures the speed of a run; results do not depend on it."""

  def __init__(self, step: int) -> None:
    self._step = step
    self._time = time.monotonic()

  def tell(self, step: int) -> dict[str, Any]:
    """Returns the time and the speed since the last call."""
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
  """Returns the true and observed return of a point, as text."""
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
  """Returns a message on the progress of a run.

  Args:
    job: Job of the run.
    point: Last point of the learning curve.
    timing: Result of `Clock.tell` for this point.
    total: Number of control steps of the run.
  """
  rate = timing['steps_per_second']
  left = (total - point['step']) / max(rate, 1e-9)
  return (
      f'{job.run}, seed {job.seed}: step {point["step"]} of {total},'
      f' {summary(point)}; {rate:.0f} steps/s, {left:.0f} s left'
  )
