"""Search for exploits: scripted saboteurs, then CEM over macro-actions."""

from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite.experiments import audit_worlds
from realab_suite.policies import macros

# Number of macro-actions of a sequence.
_LENGTH = 3
_POPULATION = 48
_ELITES = 8
# Share of the old distribution that an update keeps, and the least spread.
_KEPT = 0.3
_LEAST_SHARE = 0.03
_LEAST_ANGLE = 0.15
_LEAST_LOG = 0.15
# Durations of macro-actions in steps.
_TYPICAL = 20.0
_LONGEST = 250.0
_SABOTAGE = ('carry', 'throw', 'push')


def scripted(blocks: Sequence[audit_worlds.Target]) -> list[macros.Plan]:
  """Returns the plans of all saboteurs, for each block and both directions.

  Those that raise a reading come first.
  """
  return [
      macros.forever(verb, i, target.angle + turn)
      for turn in (0.0, np.pi)
      for verb in _SABOTAGE
      for i, target in enumerate(blocks)
  ]


@final
class Spread(NamedTuple):
  """Mean and standard deviation, `(macros,)` each."""

  mean: np.ndarray
  deviation: np.ndarray


@final
class CrossEntropy:
  """Cross-entropy method over sequences of macro-actions.

  `sample` draws sequences from a distribution, and `update` moves it towards
  the best of them.
  """

  def __init__(self, num_blocks: int, generator: np.random.Generator) -> None:
    """Makes the method.

    Args:
      num_blocks: Number of blocks that plans may refer to.
      generator: Source of random numbers.
    """
    self._generator = generator
    self._verbs = np.full((_LENGTH, len(macros.VERBS)), 1 / len(macros.VERBS))
    self._blocks = np.full((_LENGTH, num_blocks), 1 / num_blocks)
    wide = np.full(_LENGTH, np.pi)
    self._angle = Spread(np.zeros(_LENGTH), wide)
    self._side = Spread(np.zeros(_LENGTH), wide / 2)
    self._log = Spread(np.full(_LENGTH, np.log(_TYPICAL)), np.ones(_LENGTH))

  def sample(self, number: int = _POPULATION) -> list[macros.Plan]:
    """Draws plans, each for one world."""
    return [self._draw() for _ in range(number)]

  def _draw(self) -> macros.Plan:
    draw = self._generator
    log = draw.normal(*self._log)
    return macros.Plan(
        verb=np.array([draw.choice(len(p), p=p) for p in self._verbs]),
        block=np.array([draw.choice(len(p), p=p) for p in self._blocks]),
        angle=draw.normal(*self._angle),
        side=draw.normal(*self._side),
        duration=np.exp(log).clip(1.0, _LONGEST).round().astype(int),
    )

  def update(self, plans: Sequence[macros.Plan], scores: np.ndarray) -> None:
    """Moves the distribution towards the plans with the highest scores.

    Args:
      plans: Plans that `sample` returned.
      scores: Score of each plan, `(plans,)`.
    """
    order = np.argsort(-scores, kind='stable')[:_ELITES]
    best = macros.stack([plans[i] for i in order])
    self._verbs = _shares(self._verbs, best.verb)
    self._blocks = _shares(self._blocks, best.block)
    self._angle = _around(self._angle, best.angle)
    self._side = _around(self._side, best.side)
    logs = np.log(best.duration)
    self._log = _mixed(
        self._log, logs.mean(axis=0), logs.std(axis=0), _LEAST_LOG
    )


def _shares(old: np.ndarray, chosen: np.ndarray) -> np.ndarray:
  """Returns the updated probabilities of choices, `(macros, choices)`."""
  counts = (chosen[..., np.newaxis] == np.arange(old.shape[-1])).mean(axis=0)
  shares = np.maximum(_KEPT * old + (1 - _KEPT) * counts, _LEAST_SHARE)
  return np.asarray(shares / shares.sum(axis=-1, keepdims=True))


def _around(old: Spread, angles: np.ndarray) -> Spread:
  """Returns the updated distribution of angles, `(elites, macros)`."""
  mean = np.exp(1j * angles).mean(axis=0)
  length = np.abs(mean).clip(1e-6, 1 - 1e-9)
  deviation = np.sqrt(-2 * np.log(length)).clip(0, np.pi)
  # The angle closest to the old mean, so that means of angles can be mixed.
  turn = np.angle(mean * np.exp(-1j * old.mean))
  return _mixed(old, old.mean + turn, deviation, _LEAST_ANGLE)


def _mixed(
    old: Spread, mean: np.ndarray, deviation: np.ndarray, least: float
) -> Spread:
  return Spread(
      _KEPT * old.mean + (1 - _KEPT) * mean,
      np.maximum(_KEPT * old.deviation + (1 - _KEPT) * deviation, least),
  )


@final
class Best:
  """The best plans of a search so far, and the promising ones among them."""

  def __init__(self) -> None:
    self._untried: list[tuple[float, int, macros.Plan]] = []
    self._number = 0
    self._most: tuple[float, float] | None = None
    self._plan: macros.Plan | None = None

  @property
  def plan(self) -> macros.Plan:
    """The plan with the largest promise, then the largest score."""
    if self._plan is None:
      raise errors.ResultsError('the search has tried no plan')
    return self._plan

  def add(
      self,
      plans: Sequence[macros.Plan],
      scores: np.ndarray,
      promises: np.ndarray,
  ) -> None:
    """Adds plans with their scores and promises, `(plans,)` each."""
    for plan, score, promise in zip(
        plans, scores.tolist(), promises.tolist(), strict=True
    ):
      self._number += 1
      if self._most is None or (promise, score) > self._most:
        self._most, self._plan = (promise, score), plan
      if promise > 1:
        self._untried.append((-score, self._number, plan))

  def take(self, number: int) -> list[macros.Plan]:
    """Returns the promising plans with the largest scores, and drops all."""
    taken = [plan for _, _, plan in sorted(self._untried, key=_rank)[:number]]
    self._untried.clear()
    return taken


def _rank(entry: tuple[float, int, macros.Plan]) -> tuple[float, int]:
  return entry[:2]
