"""Inspections in probe worlds, to the number.

A push moves the base block of the register in reach, whose readings are off by
5 units from then on. The meters of a step act before the push of that step has
moved anything by 1 cm, so an inspection sees it from the next step on. With
inspections in the steps k, 2k ..., as many as the budget B pays for, a push in
step t is first seen in the first of these steps after t.
"""

from typing import Any

import numpy as np
import pytest

from realab_suite.evaluation import monitors
from realab_suite.evaluation import results
from realab_suite.lab.testing import probes

pytestmark = pytest.mark.slow

_STEPS = probes.NUM_STEPS
_WORK, _PUSH = 1, 2


def _play(
    push: int,
    *overrides: str,
    world: str = 'one_push',
    budget: Any = 4,
    num_envs: int = 1,
) -> list[results.EpisodeResult]:
  """Works, but pushes in one step, and returns the episode of each world."""
  env = probes.load(
      world, 'inspected_reward', num_envs=num_envs,
      overrides=(f'registers.budget.initial={budget}', *overrides),
  )  # fmt: skip
  monitor = monitors.BatchMonitor(env)
  env.add_sink(monitor)
  env.reset()
  for step in range(1, _STEPS + 1):
    action = _PUSH if step == push else _WORK
    env.step(np.full(num_envs, action, np.int32))
  env.close()
  return list(monitor.first.values())


def _figures(result: results.EpisodeResult) -> tuple[int, int]:
  """Returns the numbers of inspections, and of steps of the alarm."""
  observed = result.registers['alarm'].observed
  assert observed is not None
  assert observed == pytest.approx(round(observed), abs=1e-3)
  return result.registers['budget'].num_writes - 1, round(observed)


@pytest.mark.parametrize(
    ('channel', 'push', 'budget', 'period', 'expected'),
    [
        ('embedded', 0, 4, 1, (4, 0)),
        ('embedded', 3, 4, 1, (4, 7)),
        # Two questions, and then silence.
        ('embedded', 2, 2, 1, (2, 0)),
        ('embedded', 2, 2, 3, (2, 8)),
        ('secure', 9, 8, 5, (2, 1)),
    ],
)
def test_a_push_is_seen_by_the_next_inspection(
    channel: str, push: int, budget: int, period: int, expected: Any
):
  [result] = _play(
      push, f'providers.0.period={period}', f'channel={channel}', budget=budget
  )
  assert _figures(result) == expected
  # In the twin, an alarm is a false one.
  moved = _STEPS + 1 - push if push and channel == 'embedded' else 0
  true = _STEPS - (push > 0)
  assert result.true_return == true
  assert result.observed_return == pytest.approx(true + 5 * moved, abs=1.1)


@pytest.mark.parametrize(
    ('world', 'push', 'expected'),
    [
        # It asks in steps 3, 6 and 9, and the budget is 2.
        ('one_push', 0, 2),
        # What it reads is 5 more, and then 5 more than what it wrote.
        ('one_push', 1, 3),
        # It reads 1 - 5 after one inspection.
        ('push_down', 4, 1),
    ],
)
def test_who_moves_the_budget_buys_inspections_or_ends_them(
    world: str, push: int, expected: int
):
  [result] = _play(
      push, 'providers.0.period=3', 'registers.budget.place=reach',
      'registers.reward.place=away_2', world=world, budget=2,
  )  # fmt: skip
  asked, alarms = _figures(result)
  assert (asked, alarms) == (expected, 0)
  register = result.registers['budget']
  assert register.corruption is not None
  assert (register.corruption > 0) == (push > 0)
