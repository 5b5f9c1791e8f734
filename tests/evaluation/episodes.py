"""Made-up episodes for tests of comparisons, hack rates and verdicts."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
from typing import Any

from realab_suite.evaluation import gains
from realab_suite.lab.verdicts import stakes

NAN = float('nan')
SEEDS = range(10)

# Relative gains are gains; at the ends of the interval, 4/5 and 5/4 of them.
STAKE = stakes.Stakes(
    key='made up',
    parts={
        'return': stakes.Stake(estimate=1.0, low=0.8, high=1.25, than='random')
    },
)


@dataclasses.dataclass(frozen=True)
class Episode:
  """The part of an episode that comparisons need, and nothing else."""

  seed: int
  episode: int
  is_valid: bool = True
  true_return: float = 0.0
  observed_return: float = 0.0
  corruption: float | None = 0.0
  world: int = 0
  is_given_up: bool = False
  max_true_return: float | None = None
  gain: float = 0.0
  is_ended_by_tampering: bool = False
  parts: Mapping[str, float] = dataclasses.field(default_factory=dict)
  registers: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  extras: Mapping[str, Any] = dataclasses.field(
      default_factory=lambda: {'stake': STAKE.model_dump()}
  )

  @property
  def key(self) -> tuple[int, int, int]:
    return self.seed, self.world, self.episode

  @property
  def objective(self) -> dict[str, gains.Value]:
    return {
        name: gains.Value(observed=8.0, clean=8.0 - gain)
        for name, gain in {'return': self.gain, **self.parts}.items()
    }


def _number(value: Any, seed: int) -> Any:
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


def gaining(*gains_: float, seed: int = 0, **figures: Any) -> list[Episode]:
  """Returns episodes of a seed with these gains."""
  return [
      Episode(seed, i, gain=gain, **figures) for i, gain in enumerate(gains_)
  ]


def changed(
    run_: Iterable[Episode], *keys: tuple[int, int], **figures: Any
) -> list[Episode]:
  """Returns a run with some episodes changed, all if none is named."""
  return [
      dataclasses.replace(one, **figures)
      if not keys or (one.seed, one.episode) in keys
      else one
      for one in run_
  ]


FAILED = {'is_valid': False, 'true_return': -1e9, 'corruption': 1e9}
GIVEN_UP = {'is_valid': False, 'is_given_up': True}


def noise(size: float, mean: float = 0.0) -> Callable[[int], float]:
  """Up in every other seed, down in the rest."""
  return lambda seed: mean + size * (-1) ** seed
