"""Tests of named budgets: what they fix, and what they refuse."""

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import budgets
from realab_suite.lab.experiments import experiment_specs
from realab_suite.launchers import audit
from realab_suite.launchers import sweep
from tests.lab.experiments import small
from tests.launchers import in_process


def _experiment(**changes):
  return experiment_specs.load(
      {**small.EXPERIMENT, 'max_steps': 250, 'seeds': [3], **changes}
  )


@pytest.mark.parametrize(
    ('name', 'num_envs', 'max_steps'),
    [
        ('realab-1M', 128, 250),
        ('realab-1M', 7, 99),
        ('realab-20M', 256, 250),
    ],
)
def test_a_budget_consists_of_whole_episodes(name, num_envs, max_steps):
  free = {'num_envs': num_envs, 'sleep': True}
  before = _experiment(max_steps=max_steps, training=free)
  after = budgets.apply(before, name)
  training, of_round = after.training, num_envs * (max_steps + 1)
  lengths = training.steps, training.checkpoint_every, training.curve_every
  assert [length % of_round for length in lengths] == [0, 0, 0]
  steps = budgets.BUDGETS[name].steps
  assert 0 <= training.steps - steps < of_round
  assert after.seeds == tuple(range(10))
  assert after.evaluation.episodes == 100
  assert training.steps / training.curve_every <= 32
  # Nothing else has changed.
  kept = {'training', 'seeds', 'evaluation'}
  assert before.model_dump(exclude=kept) == after.model_dump(exclude=kept)
  assert (training.num_envs, training.sleep) == (num_envs, True)
  assert budgets.name_of(before) is None
  assert budgets.name_of(after) == name
  assert budgets.apply(after, name) == after


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'training': {'num_envs': 500}}, 'num_envs: 500; .* 1 to 398'),
        ({'max_steps': 200_000}, 'allowed are none'),
        ({'calibration_seeds': [9]}, 'seeds and calibration_seeds: 9 appears'),
        ({'runs': {'a': {'design': 'instantaneous_reward', 'steps': 9}}},
         'runs.a.steps: 9; '),
        ({'runs': {'a': {'design': 'instantaneous_reward', 'num_seeds': 1}}},
         'runs.a.num_seeds: 1; '),
        ({'training': {'tasks': ['unlock_door.far'], 'adaptation': 9}},
         r"training.tasks: \['unlock_door.far'\]"),
    ],
)  # fmt: skip
def test_conflicts_are_refused_in_one_line(changes, problem):
  with pytest.raises(errors.SpecError, match=problem) as raised:
    budgets.apply(_experiment(**changes), 'realab-1M')
  assert '\n' not in str(raised.value)


def test_the_program_refuses_what_is_no_budget(tmp_path):
  arguments = '--experiment=verdict', f'--output={tmp_path}'
  for others, problem in (
      (['--budget=realab-2M'], "budget 'realab-2M': must be one of"),
      (['--budget=40'], "budget '40': must be one of"),
      (['--budget=realab-1M', '--calibration'], 'without --calibration'),
  ):
    assert problem in in_process.complaint(sweep, *arguments, *others)
  for budget in ('realab-1M', '5', ''):
    said = in_process.complaint(audit, f'--budget={budget}')
    assert f'--budget={budget}: must be a number of episodes from 10' in said


def test_the_minutes_are_those_of_agents_and_twins():
  verdict = budgets.apply(experiment_specs.load('verdict'), 'realab-1M')
  said = budgets.summary(verdict)
  assert '1,028,096 control steps for each of 10 seeds of 2 learners' in said
  assert ' 23 minutes' in said
