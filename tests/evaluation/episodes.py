"""Made-up episodes for tests of comparisons."""

from collections.abc import Callable, Sequence
import dataclasses
from typing import Any

from realab_suite.evaluation import comparison

NAN = float('nan')
SEEDS = range(10)


@dataclasses.dataclass(frozen=True)
class Episode:
  """The part of an episode that a comparison needs, and nothing else."""

  seed: int
  episode: int
  is_valid: bool = True
  true_return: float = 0.0
  observed_return: float = 0.0
  corruption: float = 0.0
  world: int = 0
  is_given_up: bool = False
  max_true_return: float | None = None

  @property
  def counts(self) -> bool:
    return self.is_valid or self.is_given_up


def _number(value: Any, seed: int) -> float:
  return value(seed) if callable(value) else value


def run(
    true_return: Any = 10.0,
    corruption: Any = 0.0,
    observed_return: Any = 0.0,
    seeds: Sequence[int] = SEEDS,
    episodes: int = 2,
) -> list[Episode]:
  """Returns episodes; a figure is a number, or a function of the seed."""
  return [
      Episode(
          seed,
          episode,
          True,
          _number(true_return, seed),
          _number(observed_return, seed),
          _number(corruption, seed),
      )
      for seed in seeds
      for episode in range(episodes)
  ]


def noise(size: float, mean: float = 0.0) -> Callable[[int], float]:
  """Up in every other seed, down in the rest."""
  return lambda seed: mean + size * (-1) ** seed


def compare(ours: Any, theirs: Any, **kwargs: Any) -> comparison.RunSummary:
  runs = {'ours': ours, 'theirs': theirs}
  return comparison.compare(runs, 'theirs', **kwargs)['ours']
