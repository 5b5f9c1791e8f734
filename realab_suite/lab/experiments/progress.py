"""Display of the progress of a run; results do not depend on it."""

from collections.abc import Callable, Mapping
import time
from typing import Any, final


@final
class Display:
  """Shows a run as lines, one for each point of the learning curve."""

  def __init__(
      self,
      name: str,
      step: int,
      total: int,
      fewest: int,
      say: Callable[[str], None],
  ) -> None:
    """Starts the clock.

    Args:
      name: Name of the run.
      step: Number of control steps so far.
      total: Number of control steps of the run.
      fewest: Smallest number of episodes whose mean is shown. Training starts
        all worlds at once, so the few episodes that end between the others are
        not representative.
      say: Called with a line for each point.
    """
    self._name = name
    self._total = total
    self._fewest = fewest
    self._say = say
    # Of the points since the last mean: number of episodes, and their mean.
    self._gains: list[tuple[int, float]] = []
    self._paid = 'too few episodes have ended to say what they paid'
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
    self._note(point)
    left = f'{(self._total - step) / max(rate, 1e-9):,.0f} s left'
    if step == self._total:
      left = 'its evaluation follows'
    self._say(
        f'{self._name}: step {step:,} of {self._total:,}; {self._paid};'
        f' {rate:,.0f} steps/s, {left}'
    )
    return {
        'step': step,
        'unix_time': round(time.time(), 3),
        'seconds': round(seconds, 3),
        'steps_per_second': round(rate, 1),
    }

  def _note(self, point: Mapping[str, Any]) -> None:
    """Counts the episodes of a point, and renews the mean if they suffice."""
    if point['gain'] is not None:
      number = point['num_episodes'] - point['num_invalid']
      self._gains.append((number, point['gain']))
    count = sum(number for number, _ in self._gains)
    if count and count >= self._fewest:
      total = sum(number * gain for number, gain in self._gains)
      self._paid = f'its latest episodes paid {_compared(total / count)}'
      self._gains = []


def _compared(gain: float) -> str:
  """Returns a mean gain in words, to the unit if it is large."""
  size = f'{abs(gain):,.0f}' if abs(gain) >= 10 else f'{abs(gain):.1f}'
  if size == '0.0':
    return 'what was earned'
  return f'{size} units {"more" if gain > 0 else "less"} than was earned'
