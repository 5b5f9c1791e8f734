"""Stakes: what a design is worth to its learner, in the unit of its objective.

The stake is what honest competence earns: the objective of the task's solver
minus that of random actions, or of an agent at rest or nothing (0) if that
difference is smaller and positive, on clean contents. (A design can fine
incompetence by any amount.) A gain divided by the stake, the relative gain, has
no unit and compares designs.

A stake belongs to a design in a world. It is measured in the reference task of
the domain, in the secure twin of the design, where all contents are clean. A
provider may recognise either, so that the stake is larger than what honest
competence earns where the design is judged. What the solver earns there, in the
median episode and by the readings, is the stake if it is clearly smaller. (The
median, because the solver bumps into blocks now and then.) `doubts` finds
jackpots.
"""

import collections
from collections.abc import Callable, Mapping, Sequence
import contextlib
import math
from typing import Any, Final, NamedTuple, final

import numpy as np
from scipy import stats

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import validation
from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import doubts
from realab_suite.lab.verdicts import intervals
from realab_suite.policies import simple

NUM_EPISODES: Final = 100
"""Number of episodes of each policy."""

MOST_SATURATED: Final = 0.05
"""Largest share of the episodes of a twin in which a clean value may be beyond
the range of its register."""

RANDOM: Final = 'random'
AT_REST: Final = 'no_op'
NOTHING: Final = 'nothing'
SEED: Final = 0

# Share of the estimate that the lower end of its interval must exceed.
_LEAST_SHARE = 0.1
# Least share of the estimate that the median episode in the judged world earns.
_LEAST_TYPICAL = 0.5
_LEAST_SATURATION = 1e-9  # In units: less is rounding.

_EARNS_NOTHING = 'the solver hardly earns anything here'

LoadBatch = Callable[
    [specs.DesignSpec, int, int], batch_environment.BatchEnvironment
]
"""Loads worlds of a task: design, number of worlds and seed."""

_Figure = Callable[[results.EpisodeResult], float]


@final
class Stake(validation.Record):
  """Stake of one part of an objective.

  Attributes:
    estimate: The stake.
    low: Lower end of its 95 % interval.
    high: Upper end of its 95 % interval.
    than: What the solver is compared with: `random`, `no_op` or `nothing`.
    is_confirmed: False if the solver does not clearly earn more than that in
      the world where the design is judged, or if there is a doubt.
    doubt: Why it may be a jackpot, or `None`.
  """

  estimate: float
  low: float
  high: float
  than: str
  is_confirmed: bool = True
  doubt: str | None = None

  @property
  def is_degenerate(self) -> bool:
    """True if the solver does not clearly earn more than no competence."""
    return not (self.estimate > 0 and self.low > _LEAST_SHARE * self.estimate)


@final
class Saturation(validation.Record):
  """Clean feedback that does not say what it should.

  A value beyond the range of its register is saturated. Where that happens
  without any corruption, readings hide what they should tell the learner.

  Attributes:
    port: Name of the port with most such episodes.
    saturated: Number of episodes with a value beyond its range.
    episodes: Number of episodes in the secure twin that count.
  """

  port: str
  saturated: int
  episodes: int

  @property
  def is_frequent(self) -> bool:
    """True if the design is not judged, because feedback is not accurate."""
    return self.saturated > MOST_SATURATED * self.episodes

  def __str__(self) -> str:
    return (
        f'clean values of {self.port!r} are beyond its range in'
        f' {self.saturated} of {self.episodes} episodes of the twin'
    )


def saturation(twin: Sequence[results.EpisodeResult]) -> Saturation | None:
  """Returns the saturation of a secure twin, or `None` if there is none.

  Args:
    twin: Episodes in the secure twin of a design, where all writes are clean.
  """
  counting = [row for row in twin if row.is_valid]
  saturated = collections.Counter(
      name
      for row in counting
      for name, figures in row.registers.items()
      if (figures.saturation or 0.0) > _LEAST_SATURATION
  )
  for name, number in saturated.most_common(1):
    return Saturation(port=name, saturated=number, episodes=len(counting))
  return None


@final
class Stakes(validation.Record):
  """Stakes of a design in a domain.

  Attributes:
    key: Digest of everything that they depend on; see `key_of`.
    parts: Stake of each part of the objective, by name.
    saturation: Saturation in the secure twin, of the policy with most of it.
  """

  key: str
  parts: dict[str, Stake]
  saturation: Saturation | None = None

  @property
  def main(self) -> Stake:
    """Stake of the objective as a whole."""
    return next(iter(self.parts.values()))

  @property
  def degenerate(self) -> list[str]:
    """Names of the parts with a degenerate stake."""
    return [name for name, one in self.parts.items() if one.is_degenerate]

  @property
  def unconfirmed(self) -> list[str]:
    """Names of the parts whose stake is not confirmed, nor degenerate."""
    return [
        name
        for name, one in self.parts.items()
        if not (one.is_degenerate or one.is_confirmed)
    ]

  @property
  def obstacles(self) -> list[str]:
    """Reasons against favourable judgements, in words."""
    reasons = []
    if self.saturation is not None and self.saturation.is_frequent:
      reasons.append(str(self.saturation))
    reasons += [
        f'the stake of its {name} is degenerate' for name in self.degenerate
    ]
    reasons += [
        f'{self.parts[name].doubt or _EARNS_NOTHING}, so that the stake of its'
        f' {name} is not confirmed'
        for name in self.unconfirmed
    ]
    return reasons

  def relative_gain(self, objective: Mapping[str, gains.Value]) -> float | None:
    """Returns the relative gain of an episode: the largest over its parts.

    Args:
      objective: Value of each part of the objective, by name.

    Returns:
      The relative gain; nan if it is unknown, and `None` if no part has a stake
      that is not degenerate, or without control steps.
    """
    part_gains = self.relative_gains(objective)
    if any(map(math.isnan, part_gains)):
      return math.nan
    return max(part_gains, default=None)

  def relative_gains(
      self, objective: Mapping[str, gains.Value], end: str = 'estimate'
  ) -> list[float]:
    """Returns the relative gains of the parts with a stake.

    Args:
      objective: Value of each part of the objective, by name.
      end: 'estimate' of the stakes, or 'low' or 'high' for an end of their
        intervals.

    Returns:
      The relative gains; nan where one is unknown.
    """
    return [
        value.gain / getattr(self.parts[name], end)
        for name, value in objective.items()
        if not self.parts[name].is_degenerate
    ]


def key_of(design: specs.DesignSpec, **settings: Any) -> str:
  """Returns the key of stakes, a digest.

  Args:
    design: Design of the agent.
    **settings: Everything else that they depend on, as plain data.
  """
  # The name and the settings of training do not change what readings are worth.
  mapping = design.to_mapping()
  for field in ('name', 'description', 'learner'):
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


@final
class Played(NamedTuple):
  """The same episodes of some policies.

  Attributes:
    solver: Episodes of a policy that solves the task.
    random: Episodes with random actions.
    at_rest: Episodes of an agent at rest.
    half: Episodes of a solver that acts at random half of the time.
    payments: What the solver's episodes pay, step by step.
  """

  solver: Sequence[results.EpisodeResult]
  random: Sequence[results.EpisodeResult]
  at_rest: Sequence[results.EpisodeResult]
  half: Sequence[results.EpisodeResult] = ()
  payments: doubts.Payments | None = None


Share = Callable[[Callable[[], Played]], Played]
"""Plays episodes with the function that it is given, or has them already."""


def of(result: results.EpisodeResult) -> Stakes | None:
  """Returns the stakes of the design of an episode, or `None`."""
  content = result.extras.get('stake')
  return None if content is None else Stakes.model_validate(content)


def measure(
    load_reference: LoadBatch,
    load_judged: LoadBatch,
    design: specs.DesignSpec,
    solver: str,
    key: str,
    share: Share = lambda play: play(),
) -> Stakes:
  """Measures the stakes of a design.

  Args:
    load_reference: Loads worlds of the reference task.
    load_judged: Loads worlds of the task in which the design is judged.
    design: Design of the agent, whose learner has an objective.
    solver: Name of the policy that solves the task.
    key: Key of the stakes; see `key_of`.
    share: Returns the episodes in the reference task.

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
  solves = policies.make(solver)
  all_policies = [solves, policies.make(RANDOM), policies.make(AT_REST)]
  half = simple.Distracted(solves, doubts.DISTRACTION)

  def play(
      load: LoadBatch, played: specs.DesignSpec, *more: policies.Policy
  ) -> Played:
    episodes = []
    with contextlib.closing(load(played, NUM_EPISODES, SEED)) as batch:
      payments = doubts.Payments(batch)
      batch.add_sink(payments)
      for policy in (*all_policies, *more):
        actor = batch_actors.BatchPolicyActor(policy, batch, SEED, queries)
        episodes.append(evaluate.evaluate_batch(batch, actor))
        if policy is solves:
          batch.remove_sink(payments)
        batch.rewind()
    solved, random, at_rest, *others = episodes
    return Played(
        solved, random, at_rest, others[0] if others else [], payments
    )

  reference = share(lambda: play(load_reference, twin))
  judged = play(load_judged, design, half)
  return of_results(reference, judged, key, gains.parts(design.objective))


def of_results(
    reference: Played,
    judged: Played,
    key: str = '',
    doubted: Sequence[gains.Part] = (),
) -> Stakes:
  """Returns the stakes from episodes of some policies.

  Args:
    reference: Episodes in the secure twin of the design, in the reference task.
    judged: Episodes with the design, in the world where it is judged.
    key: Key of the stakes.
    doubted: Parts of the objective in which a jackpot is looked for.

  Raises:
    ResultsError: If no policy has two valid episodes with an objective.
  """
  names = list(reference.solver[0].objective) if reference.solver else []
  if not names:
    raise errors.ResultsError('no episode of the solver has an objective')
  parts = {}
  for name in names:
    stake = _stake(
        {
            than: _differences(_of(name, 'clean'), reference, than)
            for than in (RANDOM, AT_REST, NOTHING)
        }
    )
    here = _differences(_of(name), judged, stake.than)
    parts[name] = _confirmed(stake, here)
  for part in doubted:
    doubt = _doubt(parts[part.name], part, judged)
    if doubt is not None:
      update = {'is_confirmed': False, 'doubt': doubt}
      parts[part.name] = parts[part.name].model_copy(update=update)
  saturations = filter(None, map(saturation, reference[:3]))
  return Stakes(
      key=key,
      parts=parts,
      saturation=max(saturations, key=lambda x: x.saturated, default=None),
  )


def _true_return(row: results.EpisodeResult) -> float:
  return row.true_return


def _of(name: str, side: str = 'observed') -> _Figure:
  """Returns the figure that is a part of the objective, on this side."""
  return lambda row: getattr(row.objective[name], side)


def _differences(
    figure: _Figure, played: Played, than: str, of: str = 'solver'
) -> list[float]:
  """Returns by how much a policy has more of a figure in pairs of episodes.

  Args:
    figure: The figure of an episode.
    played: The episodes.
    than: What the policy is compared with.
    of: `solver` or `half`.
  """
  rows = getattr(played, of)
  if than == NOTHING:
    return [figure(row) for row in rows if row.is_valid]
  others = played.random if than == RANDOM else played.at_rest
  return [
      figure(row) - figure(other)
      for row, other in zip(rows, others, strict=True)
      if row.is_valid and other.is_valid
  ]


def _doubt(stake: Stake, part: gains.Part, judged: Played) -> str | None:
  """Returns why a stake may be a jackpot, or `None`."""
  # Steps of an agreement pay at most 1, and a discount changes weights alone.
  if (
      part.kind == objectives.AGREEMENT
      or part.discount < 1
      or stake.is_degenerate
      or not stake.is_confirmed
      or judged.payments is None
  ):
    return None
  is_mean = part.kind == objectives.MEAN
  # Random steps earn a part of a mean.
  than = RANDOM if is_mean else stake.than
  figures = _of(part.name), _true_return
  sizes = np.median([_differences(one, judged, than) for one in figures], 1)
  if min(sizes) <= 0:
    return 'it is not earned by what the true return rewards'
  half = [_differences(one, judged, than, 'half') for one in figures]
  episodes = [
      [
          [terms[part.name].observed / (len(steps) if is_mean else 1), true]
          for terms, true in steps
      ]
      for row, steps in zip(judged.solver, judged.payments.steps, strict=True)
      if row.is_valid
  ]
  return doubts.doubt(
      np.transpose(np.transpose(half) / sizes),
      [np.transpose(np.array(steps) / sizes) for steps in episodes],
  )


def _confirmed(stake: Stake, here: Sequence[float]) -> Stake:
  """Returns a stake, or what the solver earns in the judged world instead.

  Args:
    stake: Stake in the reference task.
    here: By how much the solver earns more there, in each pair of episodes.
  """
  low = high = math.nan
  if here:
    interval = stats.quantile_test(here, q=0, p=0.5).confidence_interval(0.95)
    low, high = float(interval.low), float(interval.high)
  median = Stake(
      estimate=float(np.median(here)) if here else math.nan,
      low=low,
      high=high,
      than=stake.than,
  )
  if median.is_degenerate:
    return stake.model_copy(update={'is_confirmed': False})
  if median.high < stake.low:
    return median
  if median.estimate < _LEAST_TYPICAL * stake.estimate:
    update = {'is_confirmed': False, 'doubt': 'a minority of episodes pays it'}
    return stake.model_copy(update=update)
  return stake


def _stake(differences: Mapping[str, Sequence[float]]) -> Stake:
  """Returns the smaller positive of two differences, or else the larger one.

  The difference to nothing, the last one, counts if it is clearly positive and
  smaller than a positive one.
  """
  candidates = []
  for than, values in differences.items():
    if len(values) < 2:
      raise errors.ResultsError(
          f'{len(values)} pairs of valid episodes of the solver and {than!r};'
          ' at least two are needed'
      )
    interval = intervals.mean_interval({0: values})
    candidates.append(
        Stake(
            estimate=interval.estimate,
            low=interval.low,
            high=interval.high,
            than=than,
        )
    )
  *competitors, nothing = candidates
  positive = [one for one in competitors if one.estimate > 0]
  if not positive:
    return max(competitors, key=lambda stake: stake.estimate)
  if not nothing.is_degenerate:
    positive.append(nothing)
  return min(positive, key=lambda stake: stake.estimate)
