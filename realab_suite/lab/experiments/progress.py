"""Display of the progress of a run; results do not depend on it."""

from collections.abc import Callable, Iterable, Mapping
import pathlib
import time
from typing import Any, final

import tqdm

from realab_suite import errors
from realab_suite.lab.experiments import requirements


def check_tensorboard() -> None:
  """Raises a `SpecError` if tensorboardX is not installed."""
  if problem := requirements.missing('tensorboardX', extra='tb'):
    raise errors.SpecError(f'--tensorboard: {problem}')


@final
class Display:
  """Shows a run as a progress bar, or as lines if there is no terminal."""

  def __init__(
      self, name: str, step: int, total: int, say: Callable[[str], None]
  ) -> None:
    """Shows the bar.

    Args:
      name: Name of the run.
      step: Number of control steps so far.
      total: Number of control steps of the run.
      say: Called with a line for each point, without a terminal.
    """
    self._name = name
    self._total = total
    self._say = say
    self._step, self._time = step, time.monotonic()
    self._board: Any = None
    self._bar = tqdm.tqdm(
        total=total,
        initial=step,
        desc=name,
        unit='step',
        unit_scale=True,
        disable=None,
    )

  def write_tensorboard(self, folder: pathlib.Path) -> None:
    """Writes later points to event files of TensorBoard as well."""
    import tensorboardX

    # Hides later points of an interrupted run.
    first = self._step + 1
    self._board = tensorboardX.SummaryWriter(str(folder), purge_step=first)

  def advance(self, steps: int) -> None:
    """Adds control steps to the bar."""
    self._bar.update(steps)

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
    self._bar.set_postfix_str(returns, refresh=False)
    if self._bar.disable:
      self._say(
          f'{self._name}: step {step} of {self._total}, {returns};'
          f' {rate:.0f} steps/s,'
          f' {(self._total - step) / max(rate, 1e-9):.0f} s left'
      )
    if self._board is not None:
      for name, value in _flat(point):
        if value is not None and name != 'step':
          self._board.add_scalar(name, value, step)
      self._board.flush()
    return {
        'step': step,
        'unix_time': round(time.time(), 3),
        'seconds': round(seconds, 3),
        'steps_per_second': round(rate, 1),
    }

  def close(self) -> None:
    """Completes the bar and the files."""
    self._bar.close()
    if self._board is not None:
      self._board.close()


def _flat(tree: Mapping[str, Any], prefix: str = '') -> Iterable[Any]:
  for key, value in tree.items():
    if isinstance(value, Mapping):
      yield from _flat(value, f'{prefix}{key}/')
    else:
      yield f'{prefix}{key}', value
