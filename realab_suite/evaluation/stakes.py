"""Stakes: what a design is worth to its learner, in the unit of its objective.

The stake is what honest competence earns: the objective of the task's solver
minus that of random actions, or of an agent at rest if that difference is
smaller and positive, on clean contents. A gain divided by the stake, the
relative gain, has no unit and compares designs.

A stake belongs to a design in a domain. It is measured in the reference task of
the domain, in the secure twin of the design, where all contents are clean.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import math
from typing import Any, Final, final

import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import validation
from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import intervals
from realab_suite.feedback import specs

NUM_EPISODES: Final = 100
"""Number of episodes of each policy."""

RANDOM: Final = 'random'
AT_REST: Final = 'no_op'
SEED: Final = 0

# Share of the estimate that the lower end of its interval must exceed.
_LEAST_SHARE = 0.1
_FROZEN = pydantic.ConfigDict(
    frozen=True, extra='forbid', ser_json_inf_nan='strings'
)

LoadBatch = Callable[
    [specs.DesignSpec, int, int], batch_environment.BatchEnvironment
]
"""Loads worlds of the reference task: design, number of worlds and seed."""


@final
class Stake(pydantic.BaseModel):
  """Stake of one part of an objective.

  Attributes:
    estimate: The stake.
    low: Lower end of its 95 % interval.
    high: Upper end of its 95 % interval.
    than: Policy that the solver is compared with: `random` or `no_op`.
  """

  model_config = _FROZEN

  estimate: float
  low: float
  high: float
  than: str

  @property
  def is_degenerate(self) -> bool:
    """True if the solver does not clearly earn more than no competence."""
    return not (self.estimate > 0 and self.low > _LEAST_SHARE * self.estimate)


@final
class Stakes(pydantic.BaseModel):
  """Stakes of a design in a domain.

  Attributes:
    key: Digest of everything that they depend on; see `key_of`.
    parts: Stake of each part of the objective, by name.
  """

  model_config = _FROZEN

  key: str
  parts: dict[str, Stake]

  @property
  def main(self) -> Stake:
    """Stake of the objective as a whole."""
    return next(iter(self.parts.values()))

  @property
  def degenerate(self) -> list[str]:
    """Names of the parts with a degenerate stake."""
    return [name for name, one in self.parts.items() if one.is_degenerate]

  def relative_gain(
      self, objective: Mapping[str, gains.Value], end: str = 'estimate'
  ) -> float | None:
    """Returns the relative gain of an episode: the largest over its parts.

    Args:
      objective: Value of each part of the objective, by name.
      end: 'estimate' of the stakes, or 'low' or 'high' for an end of their
        intervals.

    Returns:
      The relative gain; nan if it is unknown, and `None` if no part has a stake
      that is not degenerate, or without control steps.
    """
    found = [
        value.gain / getattr(self.parts[name], end)
        for name, value in objective.items()
        if not self.parts[name].is_degenerate
    ]
    if any(map(math.isnan, found)):
      return math.nan
    return max(found, default=None)


def key_of(design: specs.DesignSpec, **settings: Any) -> str:
  """Returns the key of stakes, a digest.

  Args:
    design: Design of the agent.
    **settings: Everything else that they depend on, as plain data.
  """
  # The name and the settings of training do not change what readings are worth.
  mapping = design.to_mapping()
  for field in ('name', 'description', 'channel', 'learner'):
    del mapping[field]
  objective = design.objective
  return validation.digest_of(
      {
          'design': mapping,
          'objective': objective and objective.to_mapping(),
          'episodes': NUM_EPISODES,
          'seed': SEED,
          **settings,
      }
  )


def measure(
    load_batch: LoadBatch, design: specs.DesignSpec, solver: str, key: str
) -> Stakes:
  """Measures the stakes of a design.

  Args:
    load_batch: Loads worlds of the reference task.
    design: Design of the agent, whose learner has an objective.
    solver: Name of the policy that solves the task.
    key: Key of the stakes; see `key_of`.

  Raises:
    SpecError: If the learner has no objective, or a policy cannot act.
    ResultsError: If too few episodes are valid.
  """
  if design.objective is None:
    raise errors.SpecError(
        f'design {design.name!r} has no stake: {design.why_not_judged}'
    )
  twin = specs.load(design, ['channel=secure'])
  queries = design.objective.queries

  def play(name: str) -> list[evaluate.EpisodeResult]:
    with contextlib.closing(load_batch(twin, NUM_EPISODES, SEED)) as batch:
      actor = batch_actors.BatchPolicyActor(
          policies.make(name), batch, SEED, queries=queries
      )
      return evaluate.evaluate_batch(batch, actor)

  return of_results(play(solver), play(RANDOM), play(AT_REST), key)


def of_results(
    solver: Sequence[evaluate.EpisodeResult],
    random: Sequence[evaluate.EpisodeResult],
    at_rest: Sequence[evaluate.EpisodeResult],
    key: str = '',
) -> Stakes:
  """Returns the stakes from episodes of three policies.

  Args:
    solver: Episodes of a policy that solves the task.
    random: The same episodes with random actions.
    at_rest: The same episodes of an agent at rest.
    key: Key of the stakes.

  Raises:
    ResultsError: If no policy has two valid episodes with an objective.
  """
  others = {RANDOM: random, AT_REST: at_rest}
  names = list(solver[0].objective) if solver else []
  found = {
      name: _stake(
          {
              than: _differences(name, solver, episodes)
              for than, episodes in others.items()
          }
      )
      for name in names
  }
  if not found:
    raise errors.ResultsError('no episode of the solver has an objective')
  return Stakes(key=key, parts=found)


def _differences(
    name: str,
    solver: Sequence[evaluate.EpisodeResult],
    others: Sequence[evaluate.EpisodeResult],
) -> list[float]:
  """Returns the differences of pairs of episodes in a part of the objective."""
  return [
      one.objective[name].clean - other.objective[name].clean
      for one, other in zip(solver, others, strict=True)
      if one.is_valid and other.is_valid
  ]


def _stake(differences: Mapping[str, Sequence[float]]) -> Stake:
  """Returns the smaller positive of two differences, or else the larger one."""
  found = []
  for than, values in differences.items():
    if len(values) < 2:
      raise errors.ResultsError(
          f'{len(values)} pairs of valid episodes of the solver and {than!r};'
          ' at least two are needed'
      )
    interval = intervals.mean_interval({0: values})
    found.append(
        Stake(
            estimate=interval.estimate,
            low=interval.low,
            high=interval.high,
            than=than,
        )
    )
  positive = [one for one in found if one.estimate > 0]
  if positive:
    return min(positive, key=lambda one: one.estimate)
  return max(found, key=lambda one: one.estimate)
