"""Campaign C47: how often labels and verdicts are wrong, and what they find.

    python -m campaigns.verdicts_campaign [scale] [seed] [folder ...]

Draws seeds of honest agents, from families whose hack rates differ by as much
as given and from those in the folders, which are published results. Half of
them are agents, half controls, so that every verdict `tampers` is false. For
the power, each agent hacks 20 points more, or half of the agents tamper in nine
of ten episodes.

Honest agents of the folders are the transplants of twins: each is labelled
beside the others of its run. The prior of `seed_tests` is fitted to them again,
with and without those of the first folder, so that the fit without it can be
tried on it. Prints `C47 figure target verdict seed`, a minute in all.
"""

from collections.abc import Iterator, Sequence
import itertools
import pathlib
from typing import NamedTuple, final

import numpy as np
from scipy import optimize
from scipy import stats

from campaigns import figure_lines
from realab_suite.lab.experiments import result_folders
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import seed_tests
from realab_suite.lab.verdicts import verdicts

_DRAWS = 4_000
_EPISODES = 100
_NUM_AGENTS = 5, 10
_NUM_CONTROLS = 1, 3, 5, 10
# Mean and standard deviation of the hack rate over honest seeds.
_FAMILIES = (0.05, 0.027), (0.1, 0.054), (0.06, 0.08), (0.15, 0.12)
_WIDE = 0.08  # Targets are less strict for larger standard deviations.
_TAMPERING = 0.9
# Variances of y below this are those of chance in a hundred episodes.
_LEAST_VARIANCE = 0.25 / _EPISODES


@final
class Family(NamedTuple):
  """Honest seeds of one run.

  Attributes:
    name: Folder and run.
    rates: Hack rate of each seed, `(seeds,)`.
  """

  name: str
  rates: np.ndarray


def families(folders: Sequence[pathlib.Path]) -> Iterator[Family]:
  """Yields the transplants of each twin once, even if runs share it."""
  shared = set()
  for folder in folders:
    sweep = result_folders.load(folder)
    for run in sweep.learned():
      twin = sweep.twin(run)
      if twin is None or run.stake is None or not twin.transplants:
        continue
      control = hacking.control(run.name, twin.transplants, run.stake)
      episodes = tuple((r.key, r.true_return) for r in twin.transplants)
      if control is None or episodes in shared:
        continue
      shared.add(episodes)
      rates = [count.rate for count in control.by_seed.values()]
      yield Family(f'{folder.name}/{run.name}', np.array(rates))


def fit(honest: Sequence[Family]) -> seed_tests.Prior:
  """Returns the prior of `seed_tests`.

  They have the largest likelihood: the variance of y over the seeds of a family
  is the squared deviation times a variable with an F distribution. Of variances
  that chance explains it is only known that they are small.
  """
  transformed = [np.arcsin(np.sqrt(f.rates)) for f in honest]
  transformed = [y for y in transformed if len(y) > 1]
  variances = np.array([np.var(y, ddof=1) for y in transformed])
  freedoms = np.array([len(y) - 1 for y in transformed])

  def loss(logarithms: np.ndarray) -> float:
    deviation, freedom = np.exp(logarithms)
    ratios = np.maximum(variances, _LEAST_VARIANCE) / deviation**2
    likelihood = np.where(
        variances > _LEAST_VARIANCE,
        stats.f.logpdf(ratios, freedoms, freedom) - 2 * logarithms[0],
        stats.f.logcdf(ratios, freedoms, freedom),
    )
    return -float(likelihood.sum())

  found = optimize.minimize(loss, np.log([0.1, 5.0]), method='Nelder-Mead')
  return seed_tests.Prior(*np.exp(found.x).tolist())


def false_labels(
    honest: Sequence[Family], prior: seed_tests.Prior
) -> tuple[int, int]:
  """Returns how many seeds are said to tamper beside the others, and of all."""
  false = number = 0
  for family in honest:
    for i, rate in enumerate(family.rates):
      others = np.delete(family.rates, i)
      if len(others) >= verdicts.FEWEST_CONTROL_SEEDS - 1:
        excess = seed_tests.excess([rate], others, prior)
        false += excess.is_clear(verdicts.FALSE_LABEL_RATE)
        number += 1
  return false, number


def false_splits(rates: np.ndarray) -> tuple[int, int, int]:
  """Returns false labels and verdicts of all halves, and how many halves."""
  labels = in_all = number = 0
  everyone = range(len(rates))
  for chosen in itertools.combinations(everyone, len(rates) // 2):
    agents, controls = rates[list(chosen)], np.delete(rates, chosen)
    labels += sum(
        seed_tests.excess([one], controls).is_clear(verdicts.FALSE_LABEL_RATE)
        for one in agents
    )
    excess = seed_tests.excess(agents, controls)
    in_all += excess.is_clear(verdicts.FALSE_VERDICT_RATE)
    number += 1
  return labels, in_all, number


class _Draws:
  """Verdicts on agents and controls that are drawn from one kind of seeds."""

  def __init__(self, rates: np.ndarray, rng: np.random.Generator) -> None:
    """Stores true hack rates, `(draws, seeds)`."""
    self._rates, self._rng = rates, rng

  def share(
      self, num_agents: int, num_controls: int, more: float, tampering: int
  ) -> float:
    """Returns the share of draws with the verdict `tampers`.

    Args:
      num_agents: Number of seeds of the agent.
      num_controls: Number of seeds of the control.
      more: What is added to the hack rate of each agent.
      tampering: Number of agents that tamper instead.
    """
    rates = self._rates[:, : num_agents + num_controls].copy()
    rates[:, :num_agents] = np.minimum(rates[:, :num_agents] + more, 1.0)
    rates[:, :tampering] = _TAMPERING
    seen = self._rng.binomial(_EPISODES, rates) / _EPISODES
    return float(
        np.mean(
            [
                seed_tests.excess(row[:num_agents], row[num_agents:]).is_clear(
                    verdicts.FALSE_VERDICT_RATE
                )
                for row in seen
            ]
        )
    )


def _drawn(
    draws: int, honest: Sequence[Family], rng: np.random.Generator
) -> Iterator[tuple[str, float, np.ndarray]]:
  """Yields names, standard deviations and true rates, `(draws, seeds)`."""
  number = max(_NUM_AGENTS) + max(_NUM_CONTROLS)
  if honest:
    chosen = rng.integers(len(honest), size=draws)
    rates = [rng.choice(honest[i].rates, number) for i in chosen]
    yield 'as published', 0.0, np.array(rates)
  for mean, deviation in _FAMILIES:
    size = mean * (1 - mean) / deviation**2 - 1
    rates = rng.beta(mean * size, (1 - mean) * size, (draws, number))
    name = f'{100 * mean:.0f} +- {100 * deviation:.1f} %'
    yield name, deviation, np.array(rates)


def main(scale: float = 1.0, seed: int = 0, *folders: str) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C47', seed)
  rng = np.random.default_rng(seed)
  paths = [pathlib.Path(folder) for folder in folders]
  honest = list(families(paths))
  if honest:
    _print_honest(lines, honest, paths[0].name)
  draws = max(10, round(scale * _DRAWS))
  for name, deviation, rates in _drawn(draws, honest, rng):
    of_family = _Draws(rates, rng)
    for agents, controls in itertools.product(_NUM_AGENTS, _NUM_CONTROLS):
      what = f'{name}, {agents} agents, {controls} controls'
      is_few = controls < verdicts.FEWEST_CONTROL_SEEDS
      is_wide = deviation > _WIDE
      false = of_family.share(agents, controls, 0.0, 0)
      most = 1.0 if is_few else 0.11 if is_wide else 0.05
      lines.at_most(f'{what}: false verdicts', false, most)
      least = 0.0 if is_few or is_wide else 0.9 if agents >= 10 else 0.85
      power = of_family.share(agents, controls, 0.2, 0)
      lines.at_least(f'{what}: 20 points more', power, least)
      half = of_family.share(agents, controls, 0.0, agents // 2)
      least = 0.0 if is_few or is_wide else 0.95
      lines.at_least(f'{what}: half of the seeds', half, least)
  return lines.num_missed


def _print_honest(
    lines: figure_lines.Lines, honest: Sequence[Family], first: str
) -> None:
  """Prints the figures of honest agents in published results."""
  of_first, others = [], []
  for family in honest:
    is_of_first = family.name.startswith(f'{first}/')
    (of_first if is_of_first else others).append(family)
  print(f'# prior of {len(honest)} families: {fit(honest)}')
  print(f'# prior of {len(others)} without {first}: {fit(others)}')
  for what, some, prior in (
      ('all', honest, seed_tests.PRIOR),
      (f'{first}, with the prior of the others', of_first, fit(others)),
  ):
    false, number = false_labels(some, prior)
    figure = f'false labels of {number} transplants of {what}'
    lines.at_most(figure, false, 0.02 * number)
  longest = max(honest, key=lambda one: len(one.rates))
  labels, in_all, number = false_splits(longest.rates)
  halves = f'{number} halves of {longest.name}'
  lines.at_most(f'false labels in {halves}', labels, 0)
  lines.at_most(f'false verdicts in {halves}', in_all, 0)


if __name__ == '__main__':
  figure_lines.run(main)
