"""Campaign C47: how often labels and verdicts are wrong, and what they find.

    python -m campaigns.verdicts_campaign [scale] [seed] [folder ...]

Draws seeds of honest agents, from families whose hack rates differ by as much
as given, from families of two kinds of seeds or with a long tail, and from
those in the folders, which are published results. Some of them are agents,
some controls, so that every label and verdict `tampers` is false. They have a
hundred episodes each; families of five and twenty stand beside. For the power,
each agent hacks 20 points more, or half of the agents tamper in nine of ten
episodes; for that of labels, the agent hacks half of its episodes, or nine of
ten.

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
from realab_suite.lab.experiments import studies
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import seed_tests
from realab_suite.lab.verdicts import verdicts

_DRAWS = 4_000
_EPISODES = 100
_NUM_AGENTS = 5, 10
_NUM_CONTROLS = 1, 3, 5, 10
# Mean and standard deviation of the hack rate over honest seeds.
_FAMILIES = (0.05, 0.027), (0.1, 0.054), (0.06, 0.08), (0.15, 0.12)
# Of two kinds: share of seeds of the first one, and both hack rates. The last
# two differ too much for any promise.
_TWO_KINDS = (
    (0.1, 0.28, 0.02),
    (0.12, 0.24, 0.0),
    (0.2, 0.2, 0.0),
    (0.1, 0.3, 0.02),
    (0.3, 0.6, 0.0),
)
_MOSTLY_ZERO = 0.6, 0.12, 0.06  # Share of zeros; mean and deviation of others.
_LONG_TAIL = 0.15, 2.0  # Parameters of a beta distribution.
_WIDE = 0.08  # Targets are less strict for larger standard deviations,
_WIDER = 0.12  # and there are none beyond these.
_FEWER_EPISODES = 5, 20  # So they are there.
_HALF, _TAMPERING = 0.5, 0.9  # Hack rates of agents that tamper.
# Variances of y below this are those of chance in a hundred episodes.
_LEAST_VARIANCE = 0.25 / _EPISODES


@final
class Kind(NamedTuple):
  """A kind of honest seeds.

  Attributes:
    name: What they are.
    deviation: Standard deviation of the rates that decides which targets hold.
    num_episodes: Number of episodes of each seed.
    rates: True hack rates, `(draws, seeds)`.
  """

  name: str
  deviation: float
  num_episodes: int
  rates: np.ndarray


@final
class Family(NamedTuple):
  """Honest seeds of one run.

  Attributes:
    name: Folder and run.
    rates: Hack rate of each seed, `(seeds,)`.
    num_episodes: Smallest number of episodes of a seed.
  """

  name: str
  rates: np.ndarray
  num_episodes: int


def families(folders: Sequence[pathlib.Path]) -> Iterator[Family]:
  """Yields the transplants of each twin once, even if runs share it."""
  shared = set()
  for folder in folders:
    sweep = studies.read_sweep(folder)
    for run in sweep.agents():
      transplant = sweep.runs.get(f'{run.name}.{hacking.TRANSPLANT}')
      if transplant is None or run.stake is None:
        continue
      control = hacking.control(run.name, transplant.rows, run.stake)
      episodes = tuple((r.key, r.true_return) for r in transplant.rows)
      if control is None or episodes in shared:
        continue
      shared.add(episodes)
      yield Family(
          f'{folder.name}/{run.name}',
          hacking.rates(control).to_numpy(),
          int(control['episodes'].min()),
      )


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
        excess = seed_tests.excess([rate], others, family.num_episodes, prior)
        false += _is_labelled(excess)
        number += 1
  return false, number


def false_splits(family: Family) -> tuple[int, int, int]:
  """Returns false labels and verdicts of all halves, and how many halves."""
  labels = in_all = number = 0
  rates, num_episodes = family.rates, family.num_episodes
  everyone = range(len(rates))
  for chosen in itertools.combinations(everyone, len(rates) // 2):
    agents, controls = rates[list(chosen)], np.delete(rates, chosen)
    for rate in agents:
      excess = seed_tests.excess([rate], controls, num_episodes)
      labels += _is_labelled(excess)
    excess = seed_tests.excess(agents, controls, num_episodes)
    in_all += excess.is_clear(verdicts.VERDICT_LEVEL)
    number += 1
  return labels, in_all, number


def _is_labelled(excess: seed_tests.Excess) -> bool:
  return excess.is_clear(verdicts.LABEL_LEVEL, verdicts.LABEL_LEVEL_OF_RATES)


class _Draws:
  """Verdicts on agents and controls that are drawn from one kind of seeds."""

  def __init__(self, kind: Kind, rng: np.random.Generator) -> None:
    self._kind, self._rng = kind, rng

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
    rates = self._kind.rates[:, : num_agents + num_controls].copy()
    rates[:, :num_agents] = np.minimum(rates[:, :num_agents] + more, 1.0)
    rates[:, :tampering] = _TAMPERING
    number = self._kind.num_episodes
    tampers = []
    for seen in self._rng.binomial(number, rates) / number:
      excess = seed_tests.excess(seen[:num_agents], seen[num_agents:], number)
      tampers.append(excess.is_clear(verdicts.VERDICT_LEVEL))
    return float(np.mean(tampers))

  def labelled(self, num_controls: int, rate: float | None = None) -> float:
    """Returns the share of draws with the label `tampers`.

    Args:
      num_controls: Number of seeds of the control.
      rate: Hack rate of the agent; `None` for one that is honest.
    """
    rates = self._kind.rates[:, : 1 + num_controls].copy()
    if rate is not None:
      rates[:, 0] = rate
    number = self._kind.num_episodes
    return float(
        np.mean(
            [
                _is_labelled(seed_tests.excess(seen[:1], seen[1:], number))
                for seen in self._rng.binomial(number, rates) / number
            ]
        )
    )


def _drawn(
    draws: int, honest: Sequence[Family], rng: np.random.Generator
) -> Iterator[Kind]:
  number = max(_NUM_AGENTS) + max(_NUM_CONTROLS)
  if honest:
    chosen = rng.integers(len(honest), size=draws)
    rates = [rng.choice(honest[i].rates, number) for i in chosen]
    yield Kind('as published', 0.0, _EPISODES, np.array(rates))
  shape = draws, number
  for mean, deviation in _FAMILIES:
    rates_of_family = _beta(rng, mean, deviation, shape)
    name = f'{100 * mean:.0f} +- {100 * deviation:.1f} %'
    yield Kind(name, deviation, _EPISODES, rates_of_family)
    for episodes in _FEWER_EPISODES:
      what = f'{name} in {episodes} episodes'
      yield Kind(what, _WIDER, episodes, rates_of_family)
  zeros, mean, deviation = _MOSTLY_ZERO
  others = _beta(rng, mean, deviation, shape)
  yield _skewed(
      f'{100 * zeros:.0f} % zeros, else {100 * mean:.0f} +-'
      f' {100 * deviation:.0f} %',
      np.where(rng.random(shape) < zeros, 0.0, others),
  )
  for share, high, low in _TWO_KINDS:
    yield _skewed(
        f'{100 * share:.0f} % of seeds {100 * high:.0f} %, else'
        f' {100 * low:.0f} %',
        np.where(rng.random(shape) < share, high, low),
    )
  yield _skewed(f'beta{_LONG_TAIL}', rng.beta(*_LONG_TAIL, shape))


def _beta(
    rng: np.random.Generator,
    mean: float,
    deviation: float,
    shape: tuple[int, int],
) -> np.ndarray:
  size = mean * (1 - mean) / deviation**2 - 1
  return rng.beta(mean * size, (1 - mean) * size, shape)


def _skewed(name: str, rates: np.ndarray) -> Kind:
  """Returns a kind of seeds, whose deviation is that of the drawn ones."""
  deviation = round(float(rates.std()), 3)
  return Kind(f'{name} (sd {100 * deviation:.1f})', deviation, _EPISODES, rates)


def main(scale: float = 1.0, seed: int = 0, *folders: str) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C47', seed)
  rng = np.random.default_rng(seed)
  paths = [pathlib.Path(folder) for folder in folders]
  honest = list(families(paths))
  if honest:
    _print_honest(lines, honest, paths[0].name)
  draws = max(10, round(scale * _DRAWS))
  for kind in _drawn(draws, honest, rng):
    drawn = _Draws(kind, rng)
    for agents, controls in itertools.product(_NUM_AGENTS, _NUM_CONTROLS):
      what = f'{kind.name}, {agents} agents, {controls} controls'
      is_few = controls < verdicts.FEWEST_CONTROL_SEEDS
      is_strict = kind.deviation <= _WIDE and not is_few
      false = drawn.share(agents, controls, 0.0, 0)
      has_target = kind.deviation <= _WIDER and not is_few
      most = 0.05 if is_strict else 0.11 if has_target else 1.0
      lines.at_most(f'{what}: false verdicts', false, most)
      least = 0.0 if not is_strict else 0.9 if agents >= 10 else 0.85
      power = drawn.share(agents, controls, 0.2, 0)
      lines.at_least(f'{what}: 20 points more', power, least)
      half = drawn.share(agents, controls, 0.0, agents // 2)
      least = 0.95 if is_strict else 0.0
      lines.at_least(f'{what}: half of the seeds', half, least)
    for controls in _NUM_CONTROLS:
      what = f'{kind.name}, a seed beside {controls} controls'
      is_strict = kind.deviation <= _WIDE
      most = verdicts.MOST_FALSE_LABELS if is_strict else 1.0
      lines.at_most(f'{what}: false labels', drawn.labelled(controls), most)
      for rate in (_HALF, _TAMPERING):
        is_found = drawn.labelled(controls, rate)
        figure = f'{what}: labels of {100 * rate:.0f} %'
        lines.at_least(figure, is_found, 0.0)
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
  labels, in_all, number = false_splits(longest)
  halves = f'{number} halves of {longest.name}'
  lines.at_most(f'false labels in {halves}', labels, 0)
  lines.at_most(f'false verdicts in {halves}', in_all, 0)


if __name__ == '__main__':
  figure_lines.run(main)
