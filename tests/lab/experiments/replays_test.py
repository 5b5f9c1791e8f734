"""Tests of replays: evaluated episodes are played again for pictures."""

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep


@pytest.fixture(scope='module')
def real(tmp_path_factory):
  """A sweep of one run that was really run."""
  folder = tmp_path_factory.mktemp('real')
  one = fake_sweep.experiment(
      runs={'reward': {'design': 'instantaneous_reward'}}, baselines=[],
      seeds=[3], max_steps=15, evaluation={'episodes': 3},
      training={'num_envs': 2, 'steps': 40, 'curve_every': 20},
  )  # fmt: skip
  planned = jobs.plan(one)
  scheduler._describe(one, planned, False, folder)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    for job in planned:
      training.run(job, folder, training.Options(lambda line: None))
  return folder


def test_a_replay_repeats_the_episode(real):
  run = studies.read_sweep(real).runs['reward']
  row = run.rows[2]
  track = replays.replay(run, row)
  assert track.num_steps == row.num_steps
  assert track.true_return == pytest.approx(row.true_return)
  assert track.observed_return == pytest.approx(row.observed_return)


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        ({'observed_return': 77.0}, 'differs from the results'),
        ({'world': 9}, 'has no trace'),
    ],
)
def test_a_replay_that_differs_or_has_no_trace_is_refused(
    real, change, problem
):
  run = studies.read_sweep(real).runs['reward']
  row = run.rows[0].model_copy(update=change)
  with pytest.raises(errors.ResultsError, match=problem):
    replays.replay(run, row)
