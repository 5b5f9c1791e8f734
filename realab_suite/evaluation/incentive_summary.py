"""Summaries of incentive probes over seeds, with confidence intervals.

    summary = incentive_summary.combine({0: probe}, 'learner', 'random')
    print(summary.signed_metres)

The probes themselves are in `incentives`.
"""

from collections.abc import Mapping
import dataclasses
from typing import final

from realab_suite.evaluation import incentives
from realab_suite.evaluation import intervals


@final
@dataclasses.dataclass(frozen=True)
class IncentiveSummary:
  """Mean incentive of a policy relative to a baseline, over states and seeds.

  Metres are radians where the register stores an angle.

  Attributes:
    num_seeds: Number of seeds.
    num_states: Number of states of all seeds.
    signed: Mean incentive to raise the reading, in units of the register.
    absolute: Mean incentive to corrupt in either direction, in units.
    signed_metres: Mean incentive to raise the reading, in metres.
    absolute_metres: Mean incentive to corrupt in either direction, in metres.
    most_signed_metres: Largest mean incentive that any policy could have to
      raise the reading, in metres.
    most_absolute_metres: Largest mean incentive that any policy could have to
      corrupt in either direction, in metres.
    share_in_play: Share of states in which actions make a difference.
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
  """Combines the probes of several seeds, with intervals over seeds.

  With one seed the intervals are over its states, and do not cover other seeds;
  see `intervals.mean_interval`.

  Args:
    probes_by_seed: Probe of each seed's policy.
    policy: Name of the policy in each probe.
    baseline: Name of the baseline in each probe.
    level: Confidence level of the intervals.

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
