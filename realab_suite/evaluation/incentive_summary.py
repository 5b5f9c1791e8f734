"""Incentives to tamper, combined over seeds, with confidence intervals.

Probes of single policies are in `incentives`:

    summary = incentive_summary.combine({0: probe}, 'learner', 'random')
    print(summary.signed_metres)
"""

from collections.abc import Mapping
import dataclasses
from typing import final

from realab_suite.evaluation import incentives
from realab_suite.evaluation import intervals


@final
@dataclasses.dataclass(frozen=True)
class IncentiveSummary:
  """The incentive of a policy next to a baseline's, over states and seeds.

  Attributes:
    num_seeds: How many seeds.
    num_states: How many states, of all seeds.
    signed: Mean incentive in the direction up, in units.
    absolute: Mean incentive to corrupt in either direction, in units.
    signed_metres: As `signed`, as a displacement.
    absolute_metres: As `absolute`, as a displacement.
    most_signed_metres: The mean that was to be had, at most.
    most_absolute_metres: The same, in either direction.
    share_in_play: The share of states in which actions make a difference.
  """

  num_seeds: int
  num_states: int
  signed: intervals.Interval
  absolute: intervals.Interval
  signed_metres: intervals.Interval
  absolute_metres: intervals.Interval
  most_signed_metres: intervals.Interval
  most_absolute_metres: intervals.Interval
  share_in_play: intervals.Interval


def combine(
    probes_by_seed: Mapping[int, incentives.Probe],
    policy: str,
    baseline: str,
    *,
    level: float = 0.95,
) -> IncentiveSummary:
  """Sums up the probes of several seeds, with intervals over seeds.

  With one seed the intervals are over its states, and say nothing about other
  seeds; see `intervals.mean_interval`.

  Args:
    probes_by_seed: The probe of each seed's policy.
    policy: The name that the policy has in each of them.
    baseline: The name of what it is compared with.
    level: Of the intervals.

  Raises:
    ResultsError: If there are no seeds.
    UnknownNameError: If a policy was not probed.
  """
  found = {
      seed: one.incentive(policy, baseline)
      for seed, one in probes_by_seed.items()
  }

  def interval(
      name: str, bounds: intervals.Bounds = intervals.UNBOUNDED
  ) -> intervals.Interval:
    values = {seed: getattr(one, name) for seed, one in found.items()}
    return intervals.mean_interval(values, bounds=bounds, level=level)

  in_play = {
      seed: one.is_in_play.astype(float).tolist()
      for seed, one in probes_by_seed.items()
  }
  return IncentiveSummary(
      num_seeds=len(found),
      num_states=sum(one.signed.size for one in found.values()),
      signed=interval('signed'),
      absolute=interval('absolute'),
      signed_metres=interval('signed_metres'),
      absolute_metres=interval('absolute_metres'),
      most_signed_metres=interval('most_signed_metres', intervals.NOT_NEGATIVE),
      most_absolute_metres=interval(
          'most_absolute_metres', intervals.NOT_NEGATIVE
      ),
      share_in_play=intervals.mean_interval(
          in_play, bounds=intervals.SHARE, level=level
      ),
  )
