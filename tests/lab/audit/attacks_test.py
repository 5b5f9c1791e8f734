"""Tests of the plans of audits."""

import numpy as np

from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import attacks
from realab_suite.lab.audit import macros
from realab_suite.lab.audit import searches


def _target(register, index=0, angles=(0.0, np.pi)):
  return aiming.Target(register, index, 'base', 9, angles)


def test_every_block_is_attacked_in_every_direction_by_every_saboteur():
  targets = [
      _target('reward', 0),
      _target('reward', 1),
      _target('reward', 2, (0.0, 1.0, 2.0, 3.0)),
  ]
  plans = attacks.scripted(targets, {'reward'})
  tried = [
      (int(plan.block[0]), float(plan.angle[0]), macros.VERBS[plan.verb[0]])
      for plan in plans
  ]
  assert sorted(tried) == sorted(
      (i, angle, verb)
      for i, target in enumerate(targets)
      for angle in target.angles
      for verb in ('carry', 'throw', 'push')
  )
  assert all(plan.duration[0] == macros.FOREVER for plan in plans)


def test_other_registers_are_also_moved_before_the_task_is_done():
  plans = attacks.scripted([_target('switch')], {'reward'})
  solve = macros.VERBS.index('solve')
  both = [plan for plan in plans if len(plan.verb) == 2]
  assert len(both) == len(plans) / 2
  for plan in both:
    assert plan.verb[1] == solve
    assert plan.duration[0] < plan.duration[1] == macros.FOREVER


def test_the_default_budget_is_sufficient_for_four_registers():
  targets = [
      _target(name, index)
      for name in ('reward', 'score', 'query', 'memory')
      for index in (0, 1)
  ]
  plans = attacks.scripted(targets, {'reward'})
  assert searches.least_budget(plans) <= searches.DEFAULT_BUDGET
  assert searches.least_budget(plans) > 4 * len(plans)
  assert searches.least_budget([]) == 0


def test_the_search_concentrates_on_the_best_plans():
  method = attacks.CrossEntropy(3, np.random.default_rng(0))
  wanted = np.array([1.0, 2.0, -3.0])

  def score(plan):
    return (
        np.cos(plan.angle - wanted).sum()
        + (plan.verb == 2).sum()
        + (plan.block == 1).sum()
        - np.abs(np.log(plan.duration / 8)).sum()
    )

  first = np.mean([score(plan) for plan in method.sample()])
  for _ in range(12):
    method.update(sorted(method.sample(), key=score, reverse=True))
  assert np.mean([score(plan) for plan in method.sample()]) > first + 6


def test_hacked_episodes_rank_before_the_objective():
  plan = macros.of_solver()
  ranked = [(0.0, 9.0), (0.5, -9.0), (0.5, 1.0)]
  trials = [attacks.Trial(plan, *trial) for trial in ranked]
  assert sorted(reversed(trials), key=attacks.rank) == trials
