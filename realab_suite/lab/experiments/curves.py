"""Learning curves: means over the training episodes of each interval."""

import bisect
import collections
from collections.abc import Iterable, Mapping, Sequence
import json
import math
import operator
from typing import Any

from realab_suite.evaluation import results

# Gains below this share of the values are rounding errors.
_ROUNDING = 1e-6


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
  return {
      'step': step,
      'num_episodes': len(episodes),
      'num_invalid': len(episodes) - len(valid),
      **{
          key: _mean(episode[key] for episode in valid)
          for key in ('true_return', 'observed_return', 'corruption')
      },
      'gain': _mean(_gain(episode) for episode in valid),
      'learner': {
          name: float(value) if math.isfinite(value) else None
          for name, value in metrics.items()
      },
  }


def record(step: int, episode: results.EpisodeResult) -> dict[str, Any]:
  """Returns the record of a training episode, as plain data.

  Args:
    step: Number of control steps of all worlds at its end.
    episode: The episode.
  """
  return {
      'step': step,
      'seed': episode.seed,
      'world': episode.world,
      'episode': episode.episode,
      'end': episode.end.value,
      'is_valid': episode.is_valid,
      'num_steps': episode.num_steps,
      'true_return': _number(episode.true_return),
      'observed_return': _number(episode.observed_return),
      'corruption': episode.corruption,
      # Observed and clean value of each part.
      'objective': {
          name: [_number(value.observed), _number(value.clean)]
          for name, value in episode.objective.items()
      },
      'is_ended_by_tampering': episode.is_ended_by_tampering,
  }


def condensed(
    records: Iterable[Mapping[str, Any]], points: Iterable[Mapping[str, Any]]
) -> list[dict[str, Any]]:
  """Returns the part of training episodes that reports need.

  Args:
    records: Records of episodes; see `record`.
    points: Points of the learning curve; see `point`.

  Returns:
    A record for all equal episodes of a point, with their number. Each has the
    step of the point, and the gain of each part of the objective, to three
    digits. Gains that are rounding errors are 0.
  """
  steps = [one['step'] for one in points]
  numbers: collections.Counter[str] = collections.Counter()
  for episode in records:
    gains = {
        name: _rounded_gain(*values)
        for name, values in episode['objective'].items()
    }
    condensed_record = {
        'step': steps[bisect.bisect_left(steps, episode['step'])],
        'gains': gains,
        'is_ended_by_tampering': episode['is_ended_by_tampering'],
    }
    numbers[json.dumps(condensed_record)] += 1
  condensed_records = [
      {**json.loads(text), 'num_episodes': number}
      for text, number in sorted(numbers.items())
  ]
  return sorted(condensed_records, key=operator.itemgetter('step'))


def _rounded_gain(observed: float | None, clean: float | None) -> float | None:
  if observed is None or clean is None:
    return None
  gain = observed - clean
  if abs(gain) <= _ROUNDING * max(abs(observed), abs(clean)):
    return 0.0
  return float(f'{gain:.3g}')


def _gain(record: Mapping[str, Any]) -> float | None:
  """Returns the gain of an episode in the whole objective, or `None`."""
  values = next(iter(record['objective'].values()), (None, None))
  observed, clean = values
  return None if observed is None or clean is None else observed - clean


def _number(value: float) -> float | None:
  return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
  known_values = [value for value in values if value is not None]
  return sum(known_values) / len(known_values) if known_values else None
