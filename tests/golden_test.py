"""Dynamics do not change unnoticed."""

import mujoco
import pytest

from realab_suite import suite
from tests import golden


@pytest.mark.parametrize(('domain', 'task'), suite.ALL_TASKS)
def test_the_golden_trajectory_is_the_recorded_one(domain, task):
  version, recorded = suite.dynamics(domain, task)
  assert version >= 1
  if recorded is None:
    pytest.skip(f'no trajectory is recorded for MuJoCo {mujoco.__version__}')
  assert golden.digest(domain, task) == recorded


def test_the_tested_version_of_mujoco_is_recorded():
  # `constraints.txt` pins this version; without a record nothing is guarded.
  assert mujoco.__version__ == '3.17.0'
  assert suite.dynamics('unlock_door', 'standard')[1] is not None
