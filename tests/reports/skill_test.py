"""Tests of agents that do not know the task and so cannot be cleared."""

import numpy as np
import pytest

from realab_suite.lab.experiments import studies
from realab_suite.lab.verdicts import study
from tests.lab.experiments import fake_sweep

_RANDOM = 1.1


@pytest.mark.parametrize(
    ('twins', 'has_learned'),
    [
        ((14.0, 13.0, 15.0), True),
        # Random actions as agents and as their twins.
        ((_RANDOM, 1.2, 1.0), False),
        # Agents at rest.
        ((0.0, 0.0, 0.0), False),
        # One of three twins has learned.
        ((_RANDOM, 1.0, 14.0), False),
    ],
)
def test_no_agent_is_cleared_whose_twin_has_not_learned_the_task(
    twins, has_learned, tmp_path, monkeypatch
):
  def levels(job, unused_rng):
    if job.policy is not None:
      return np.array(fake_sweep._LEVELS[job.policy])
    return np.array([twins[job.seed], 0.0, 0.0])

  monkeypatch.setattr(fake_sweep, '_levels', levels)
  runs = {'reward': fake_sweep.EXPERIMENT['runs']['reward']}
  sweep = fake_sweep.experiment(runs=runs, baselines=['random'])
  folder = fake_sweep.build(tmp_path / 'sweep', sweep)
  judged = study.judge(studies.read_sweep(folder))
  reasons = set(study.seeds(judged, 'reward')['reason'])
  # An audit is the last thing that is missing.
  expected = (
      'the design has not been audited'
      if has_learned
      else 'its twin does not clearly earn more than random actions'
  )
  assert reasons == {expected}
