"""Learning curves: means over the training episodes of each interval."""

from collections.abc import Iterable, Mapping, Sequence
import math
import pathlib
from typing import Any, Protocol, final

from realab_suite import errors
from realab_suite.evaluation import monitors
from realab_suite.experiments import requirements


def point(
    step: int,
    episodes: Sequence[Mapping[str, Any]],
    metrics: Mapping[str, float],
) -> dict[str, Any]:
  """Returns a point of a learning curve.

  Args:
    step: Number of control steps so far.
    episodes: Records of the episodes that have ended since the last point; see
      `record`.
    metrics: Metrics of the learner.

  Returns:
    Plain data. Means over valid episodes are `None` if there are no values.
  """
  valid = [episode for episode in episodes if episode['is_valid']]
  names = list(valid[0]['own']) if valid else []
  return {
      'step': step,
      'num_episodes': len(episodes),
      'num_invalid': len(episodes) - len(valid),
      **{
          key: _mean(episode[key] for episode in valid)
          for key in ('true_return', 'observed_return', 'corruption')
      },
      'gain': _mean(_gain(episode) for episode in valid),
      'own': {
          name: _mean(episode['own'][name] for episode in valid)
          for name in names
      },
      'learner': {
          name: float(value) if math.isfinite(value) else None
          for name, value in metrics.items()
      },
  }


def record(step: int, episode: monitors.Episode) -> dict[str, Any]:
  """Returns the record of a training episode, as plain data.

  Args:
    step: Number of control steps of all worlds at its end.
    episode: The episode.
  """
  figures = episode.figures
  return {
      'step': step,
      'seed': episode.seed,
      'world': episode.world,
      'episode': episode.episode,
      'end': episode.end.value,
      'is_valid': episode.is_valid,
      'num_steps': figures.num_steps,
      'true_return': _number(figures.true_return),
      'observed_return': _number(figures.observed_return),
      'corruption': figures.corruption,
      # Observed and clean value of each part.
      'objective': {
          name: [_number(value.observed), _number(value.clean)]
          for name, value in figures.objective.items()
      },
      'is_ended_by_tampering': figures.is_ended_by_tampering,
      'own': {name: one.own for name, one in figures.registers.items()},
  }


class Board(Protocol):
  """Display of a learning curve during training."""

  def add(self, point: Mapping[str, Any]) -> None:
    """Adds a point."""

  def close(self) -> None:
    """Completes its files."""


@final
class NoBoard:
  """A board without a display."""

  def add(self, point: Mapping[str, Any]) -> None:
    """Does nothing."""

  def close(self) -> None:
    """Does nothing."""


@final
class TensorBoard:
  """Writes points to event files of TensorBoard; needs the extra `tb`."""

  def __init__(self, folder: pathlib.Path, step: int) -> None:
    """Opens the folder.

    Args:
      folder: Folder of the event files.
      step: First step to write. Later points of an interrupted run are hidden.

    Raises:
      SpecError: If tensorboardX is not installed.
    """
    check_tensorboard()
    import tensorboardX

    self._writer = tensorboardX.SummaryWriter(str(folder), purge_step=step)

  def add(self, point: Mapping[str, Any]) -> None:
    for name, value in _flat(point):
      if value is not None and name != 'step':
        self._writer.add_scalar(name, value, point['step'])
    self._writer.flush()

  def close(self) -> None:
    self._writer.close()


def check_tensorboard() -> None:
  """Raises a `SpecError` if tensorboardX is not installed."""
  if problem := requirements.missing('tensorboardX', extra='tb'):
    raise errors.SpecError(f'--tensorboard: {problem}')


def _flat(tree: Mapping[str, Any], prefix: str = '') -> Iterable[Any]:
  for key, value in tree.items():
    if isinstance(value, Mapping):
      yield from _flat(value, f'{prefix}{key}/')
    else:
      yield f'{prefix}{key}', value


def _gain(record: Mapping[str, Any]) -> float | None:
  """Returns the gain of an episode in the whole objective, or `None`."""
  values = next(iter(record['objective'].values()), (None, None))
  observed, clean = values
  return None if observed is None or clean is None else observed - clean


def _number(value: float) -> float | None:
  return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
  known = [value for value in values if value is not None]
  return sum(known) / len(known) if known else None
