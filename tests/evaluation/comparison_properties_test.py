"""Property tests: changes that must not matter to a comparison do not."""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import random
from typing import Any, final

import hypothesis
from hypothesis import strategies as st

from realab_suite.evaluation import comparison
from tests import examples

_BASELINE = 'baseline'
_MARGIN = 0.5


@final
@dataclasses.dataclass(frozen=True)
class Episode:
  """The part of an episode that `comparison.compare` uses."""

  seed: int
  world: int
  episode: int
  is_valid: bool
  is_given_up: bool
  true_return: float
  observed_return: float
  corruption: float
  max_true_return: float | None

  @property
  def counts(self) -> bool:
    return self.is_valid or self.is_given_up


Runs = Mapping[str, Sequence[Episode]]


@st.composite
def _runs(draw: Any) -> Runs:
  """Draws runs of the same episodes; their figures are eighths."""
  rng = draw(st.randoms(use_true_random=False))
  num_seeds, num_episodes = draw(st.integers(2, 6)), draw(st.integers(1, 4))
  names = (_BASELINE, 'one', 'another')[: draw(st.integers(2, 3))]
  return {
      name: [
          _episode(rng, seed, episode, level)
          for seed in range(num_seeds)
          for episode in range(num_episodes)
      ]
      for name, level in ((name, draw(st.integers(1, 19))) for name in names)
  }


def _episode(
    rng: random.Random, seed: int, episode: int, level: int
) -> Episode:
  # Each seed has a valid episode at least.
  is_censored = episode > 0 and rng.random() < 0.2
  is_given_up = is_censored and rng.random() < 0.5
  figures = (rng.randrange(8 * level) / 8 for _ in range(3))
  top = (None, 20.0)[seed % 2]
  return Episode(seed, 0, episode, not is_censored, is_given_up, *figures, top)


def _compare(runs: Runs, margin: float = _MARGIN) -> dict[str, Any]:
  return comparison.compare(runs, _BASELINE, margin=margin)


def _changed(runs: Runs, change: Callable[[Episode], Episode]) -> Runs:
  return {name: [change(one) for one in run] for name, run in runs.items()}


def _reorder(runs: Runs, rng: random.Random) -> Runs:
  names = rng.sample(sorted(runs), len(runs))
  return {name: rng.sample(runs[name], len(runs[name])) for name in names}


def _merge_shards(runs: Runs, rng: random.Random) -> Runs:
  merged = {}
  for name, run in runs.items():
    seeds = sorted({one.seed for one in run})
    shards = rng.sample(seeds, len(seeds))
    merged[name] = [one for seed in shards for one in run if one.seed == seed]
  return merged


def _repeat(runs: Runs, rng: random.Random) -> Runs:
  return {
      name: [*run, *(one for one in run if rng.random() < 0.3), run[0]]
      for name, run in runs.items()
  }


_CHANGES = (_reorder, _merge_shards, _repeat)


@examples.settings(15)
@hypothesis.given(
    runs=_runs(),
    change=st.sampled_from(_CHANGES),
    rng=st.randoms(use_true_random=False),
)
def test_order_shards_and_repeated_rows_do_not_matter(
    runs: Runs, change: Any, rng: random.Random
):
  assert _compare(change(runs, rng)) == _compare(runs)


@examples.settings(10)
@hypothesis.given(runs=_runs(), shift=st.integers(1, 80))
def test_verdicts_do_not_change_if_all_corruption_grows_alike(
    runs: Runs, shift: int
):
  moved = _changed(
      runs,
      lambda one: dataclasses.replace(
          one, corruption=one.corruption + shift / 8
      ),
  )
  here, there = _compare(runs), _compare(moved)
  assert all(there[name].verdict == here[name].verdict for name in runs)


@examples.settings(10)
@hypothesis.given(runs=_runs())
def test_a_further_run_without_corruption_changes_nothing(runs: Runs):
  idle = [dataclasses.replace(one, corruption=0.0) for one in runs[_BASELINE]]
  found = _compare({**runs, 'idle': idle})
  of_idle = found.pop('idle')
  assert found == _compare(runs)
  assert of_idle.corruption.estimate == 0.0
  assert of_idle.true_return_gained.estimate == 0.0
  assert not of_idle.verdict.words.startswith('tampers')


def _times(interval: Any, factor: float) -> Any:
  return dataclasses.replace(
      interval,
      estimate=interval.estimate * factor,
      low=interval.low * factor,
      high=interval.high * factor,
      bounds=tuple(
          None if bound is None else bound * factor for bound in interval.bounds
      ),
  )


@examples.settings(10)
@hypothesis.given(runs=_runs(), exponent=st.integers(-4, 4))
def test_figures_scale_with_their_units(runs: Runs, exponent: int):
  factor = 2.0**exponent  # Powers of two scale without rounding.

  def rescale(one: Episode) -> Episode:
    top = one.max_true_return
    return dataclasses.replace(
        one,
        true_return=one.true_return * factor,
        observed_return=one.observed_return * factor,
        corruption=one.corruption * factor,
        max_true_return=None if top is None else top * factor,
    )

  here = _compare(runs)
  there = _compare(_changed(runs, rescale), _MARGIN * factor)
  for name in runs:
    assert there[name].reading == here[name].reading
    for figure in ('true_return', 'observed_return', 'corruption'):
      expected = _times(getattr(here[name], figure), factor)
      assert getattr(there[name], figure) == expected
