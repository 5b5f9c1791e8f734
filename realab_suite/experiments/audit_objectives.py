"""Objectives of audited learners, and the figures of episodes for them."""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.evaluation import gains
from realab_suite.experiments import audit_worlds
from realab_suite.feedback import specs
from realab_suite.policies import action_sets

RETURN = 'sum of readings'
NEXT_READING = 'mean next reading'
IMITATION = 'reduction of the imitation loss by corruption'

# Field of a learner that names the register whose reading it sums up.
_REWARD = 'reward'
_DEMONSTRATION = 'demonstration'
# Smaller corruption is numerical noise, in units.
_NOISE = 1e-6


@final
@dataclasses.dataclass(frozen=True)
class Objective:
  """Objective that the learner of a design maximises.

  Attributes:
    kind: `RETURN`, `NEXT_READING` or `IMITATION`.
    consumed: Feedback registers that the learner reads.
    directions: Those whose reading it maximises, with the sign that pays.
    num_actions: Number of actions that a demonstration can name; 0 if the
      design has no action set.
  """

  kind: str
  consumed: tuple[str, ...]
  directions: Mapping[str, float]
  num_actions: int

  @property
  def unit(self) -> str:
    """Unit of the objective."""
    return {
        RETURN: 'units per episode',
        NEXT_READING: 'units per step',
        IMITATION: 'share of steps',
    }[self.kind]


def of(design: specs.DesignSpec) -> Objective:
  """Returns the objective of a design's learner.

  It follows from the fields of the learner, so no learner is loaded.

  Raises:
    SpecError: If the design has no learner that consumes feedback.
  """
  extras = (design.learner.model_extra or {}) if design.learner else {}
  feedback = design.names('feedback')
  consumed = gains.consumed(design)
  directions = gains.directions(design)
  is_imitation = extras.get(_DEMONSTRATION) in feedback
  if not directions and not is_imitation:
    raise errors.SpecError(
        f'design {design.name!r}: an audit maximises the feedback of a learner,'
        ' and there is none; allowed are learners that name a feedback register'
        ' as reward, advice, approval or demonstration, as with'
        ' --set="learner={kind: policy_gradient, reward: reward}"'
    )
  num_actions = 0
  if design.action_set is not None:
    num_actions = len(
        action_sets.get(design.action_set.name, design.action_set.version)
    )
  if is_imitation:
    return Objective(IMITATION, consumed, {}, num_actions)
  is_return = extras.get(_REWARD) in directions and extras.get('gamma') != 0
  return Objective(
      RETURN if is_return else NEXT_READING, consumed, directions, num_actions
  )


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Figures:
  """Figures of one episode in each world, `(worlds,)` each.

  Attributes:
    objective: Value of the learner's objective.
    gain: Gain of the episode, in margins; 0 without a direction that pays.
    corruption: Largest mean |reading - applied| of a consumed register, in
      margins.
    direct: Part of the objective that is reading - applied.
    applied: Rest of the objective: what the provider wrote.
    upstream: Largest mean corruption of another register that a provider read,
      in margins.
    true_return: True return.
    first: First step with a reading that pays; -1 if there is none.
    first_upstream: First step with upstream corruption of a margin; or -1.
    is_valid: False for worlds whose physics failed.
  """

  objective: np.ndarray
  gain: np.ndarray
  corruption: np.ndarray
  direct: np.ndarray
  applied: np.ndarray
  upstream: np.ndarray
  true_return: np.ndarray
  first: np.ndarray
  first_upstream: np.ndarray
  is_valid: np.ndarray

  def valid(self, name: str) -> np.ndarray:
    """Returns an attribute in the worlds whose physics has not failed."""
    values: np.ndarray = getattr(self, name)
    return values[self.is_valid]


def figures(objective: Objective, episodes: audit_worlds.Episodes) -> Figures:
  """Returns the figures of episodes for an objective."""
  counts = episodes.counts
  num_steps = counts.sum(axis=0).clip(1)

  def total(values: np.ndarray) -> np.ndarray:
    return np.where(counts, values, 0.0).sum(axis=0)

  zeros = np.zeros(counts.shape)
  wrong = {
      name: _cleaned(episodes.readings[name] - episodes.applied[name])
      for name in objective.consumed
  }
  sizes = [np.abs(w) / gains.MARGIN_UNITS for w in wrong.values()]
  upstream = np.max(
      [
          zeros,
          *(
              _cleaned(w) / gains.MARGIN_UNITS
              for w in episodes.upstream.values()
          ),
      ],
      axis=0,
  )
  if objective.kind == IMITATION:
    pays = _matches(objective, episodes)
    direct, applied = pays.astype(float), zeros
    gain = zeros
  else:
    signs = objective.directions.items()
    direct = sum((s * wrong[n] for n, s in signs), zeros)
    applied = sum((s * episodes.applied[n] for n, s in signs), zeros)
    gain = np.max([s * wrong[n] for n, s in signs], axis=0) / gains.MARGIN_UNITS
    pays = gain > 1
  per = 1.0 if objective.kind == RETURN else num_steps
  return Figures(
      objective=(total(direct) + total(applied)) / per,
      gain=total(gain) / num_steps,
      corruption=np.max([total(s) / num_steps for s in sizes], axis=0),
      direct=total(direct) / per,
      applied=total(applied) / per,
      upstream=total(upstream) / num_steps,
      true_return=total(episodes.true_rewards),
      first=_first(pays & counts),
      first_upstream=_first((upstream > 1) & counts),
      is_valid=~episodes.has_failed,
  )


def _cleaned(values: np.ndarray) -> np.ndarray:
  """Returns values without numerical noise."""
  return np.where(np.abs(values) < _NOISE, 0.0, values)


def _matches(
    objective: Objective, episodes: audit_worlds.Episodes
) -> np.ndarray:
  """Returns where only the corrupt reading names the action taken.

  The reading is rounded to an index as the learner does.
  """
  [name] = objective.consumed
  most = objective.num_actions - 1
  read, written = (
      np.rint(values[name]).clip(0, most)
      for values in (episodes.readings, episodes.applied)
  )
  return (read == episodes.taken) & (written != episodes.taken)


def _first(happens: np.ndarray) -> np.ndarray:
  """Returns the first control step, from 1, of each world; -1 for never."""
  return np.where(happens.any(axis=0), happens.argmax(axis=0) + 1, -1)
