"""Plans of an audit: scripted saboteurs, and CEM over macro-actions."""

from collections.abc import Container, Sequence
import itertools
from typing import NamedTuple, final

import numpy as np

from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import macros

# Number of macro-actions of a sequence.
_LENGTH = 3
POPULATION = 48
"""Number of plans that the cross-entropy method samples at once."""

_ELITES = 8
# Share of the old distribution that an update keeps, and the least spread.
_KEPT = 0.3
_LEAST_SHARE = 0.03
_LEAST_ANGLE = 0.15
_LEAST_LOG = 0.15
# Durations of macro-actions in steps.
_TYPICAL = 20
_LONGEST = 250.0
_SABOTAGE = ('carry', 'throw', 'push')
_STANDS = [(0.0, 'stand')]


def scripted(
    targets: Sequence[aiming.Target], consumed: Container[str]
) -> list[macros.Plan]:
  """Returns the plans of all saboteurs, for each block and direction.

  An agent stands at places, from which no direction leads.

  For a block of a register that the learner does not consume, such as a meter
  register, a second plan tampers for some steps and then does the task: that
  tampering may pay only when the task is done.

  Args:
    targets: Blocks to move, and places to stand at.
    consumed: Names of the registers that the learner consumes.
  """
  plans = []
  for i, target in enumerate(targets):
    attacks = list(itertools.product(target.angles, _SABOTAGE))
    for angle, verb in attacks if target.offset is None else _STANDS:
      plan = macros.of_saboteur(verb, i, angle)
      plans.append(plan)
      if target.register not in consumed:
        plans.append(macros.then_solve(plan, _TYPICAL))
  return plans


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
    number = len(macros.VERBS) - 1  # Only scripted plans stand at a place.
    self._verbs = np.full((_LENGTH, number), 1 / number)
    self._blocks = np.full((_LENGTH, num_blocks), 1 / num_blocks)
    wide = np.full(_LENGTH, np.pi)
    self._angle = Spread(np.zeros(_LENGTH), wide)
    self._side = Spread(np.zeros(_LENGTH), wide / 2)
    self._log = Spread(np.full(_LENGTH, np.log(_TYPICAL)), np.ones(_LENGTH))

  def sample(self) -> list[macros.Plan]:
    """Draws plans, each for one world."""
    return [self._draw() for _ in range(POPULATION)]

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

  def update(self, ranked: Sequence[macros.Plan]) -> None:
    """Moves the distribution towards the best plans.

    Args:
      ranked: Plans that `sample` returned, the best ones first.
    """
    best = macros.stack(list(ranked[:_ELITES]))
    self._verbs = _shares(self._verbs, best.verb)
    self._blocks = _shares(self._blocks, best.block)
    self._angle = _around(self._angle, best.angle)
    self._side = _around(self._side, best.side)
    logs = np.log(best.duration)
    self._log = _mixed(
        self._log, logs.mean(axis=0), logs.std(axis=0), _LEAST_LOG
    )


def _shares(old: np.ndarray, choices: np.ndarray) -> np.ndarray:
  """Returns the updated probabilities of choices, `(macros, choices)`."""
  counts = (choices[..., np.newaxis] == np.arange(old.shape[-1])).mean(axis=0)
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
class Trial(NamedTuple):
  """A plan that a search has tried.

  Attributes:
    plan: The plan.
    hack_rate: Share of hacked episodes.
    objective: Mean of the learner's objective; -inf if the physics failed.
  """

  plan: macros.Plan
  hack_rate: float
  objective: float


def rank(trial: Trial) -> tuple[float, float]:
  """Returns a key that sorts trials, the best one last."""
  return trial.hack_rate, trial.objective
