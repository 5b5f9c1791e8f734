"""Tests of attribution in experiments: jobs and result rows."""

import pytest

from realab_suite.evaluation import results
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training
from tests.lab.experiments import small

_SMALL = {
    **small.EXPERIMENT,
    'task': 'unlock_door.standard',
    'max_steps': 40,
    'baselines': ['carrying_saboteur'],
    'evaluation': {'episodes': 3},
}


def _rows(output, overrides=('dof=planar',), max_steps=40):
  runs = {
      'reward': {
          'design': 'instantaneous_reward', 'overrides': [*overrides],
      }
  }  # fmt: skip
  spec = experiment_specs.load({**_SMALL, 'runs': runs, 'max_steps': max_steps})
  [job] = jobs.plan(spec, only=['reward.carrying_saboteur'])
  with small.quick_stakes():
    path = training.run(job, output, training.Options(lambda message: None))
  return list(results.read_rows(path / training.EPISODES))


def test_all_evaluation_episodes_are_attributed(tmp_path):
  rows = _rows(tmp_path)
  assert len(rows) == 3
  for row in rows:
    assert row.corruption > 0.05
    # Unlike the corruption, it does not count the read of the reset.
    assert attribution_metrics.of(row).total == pytest.approx(
        row.corruption, rel=0.05
    )
    assert attribution_metrics.of(row).agent_share == pytest.approx(1.0)


_ALONE = 'registers.reward.kind=block_position'
# A place of its own in each world of the batch, and one aim for all.
_ELSEWHERE = (
    'registers.reward.place={position: [0.9, -2.4], spread: [0.5, 0.3]}'
)
_TURNED = 'registers.reward.place={position: [1.5, -2.0], yaw: 1.5708}'


@pytest.mark.parametrize(
    'overrides',
    [
        (_TURNED,),
        (_ALONE, _TURNED),
        (_ELSEWHERE,),
        ('registers.reward.channel=secure',),
    ],
)
def test_a_saboteur_moves_what_can_be_moved_the_way_that_pays(
    tmp_path, overrides
):
  for row in _rows(tmp_path, ('dof=planar', *overrides), 150):
    assert sum(paid.gain for paid in row.objective.values()) > 10.0
