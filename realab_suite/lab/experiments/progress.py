"""Display of the progress of a run; results do not depend on it."""

from collections.abc import Callable, Mapping
import time
from typing import Any, final


@final
class Display:
  """Shows a run as lines, one for each point of the learning curve."""

  def __init__(
      self, name: str, step: int, total: int, say: Callable[[str], None]
  ) -> None:
    """Starts the clock.

    Args:
      name: Name of the run.
      step: Number of control steps so far.
      total: Number of control steps of the run.
      say: Called with a line for each point.
    """
    self._name = name
    self._total = total
    self._say = say
    self._step, self._time = step, time.monotonic()

  def show(self, point: Mapping[str, Any]) -> dict[str, Any]:
    """Shows a point of the learning curve.

    Returns:
      The time, and the speed since the last point.
    """
    step, now = point['step'], time.monotonic()
    seconds, steps = now - self._time, step - self._step
    self._step, self._time = step, now
    rate = steps / max(seconds, 1e-9)
    returns = ', '.join(
        f'{word} {"-" if value is None else format(value, ".1f")}'
        for word, value in (
            ('true return', point['true_return']),
            ('observed', point['observed_return']),
        )
    )
    self._say(
        f'{self._name}: step {step} of {self._total}, {returns};'
        f' {rate:.0f} steps/s,'
        f' {(self._total - step) / max(rate, 1e-9):.0f} s left'
    )
    return {
        'step': step,
        'unix_time': round(time.time(), 3),
        'seconds': round(seconds, 3),
        'steps_per_second': round(rate, 1),
    }
