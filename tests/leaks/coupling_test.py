"""Tests that a meter which is out of reach is not felt."""

import mujoco
import pytest

from tests.leaks import coupling


@pytest.mark.parametrize(
    ('solver', 'dof'), [('NEWTON', 'free'), ('CG', 'planar')]
)
def test_moving_a_distant_meter_is_not_felt(solver: str, dof: str):
  options = {'dof': dof, 'solver': getattr(mujoco.mjtSolver, f'mjSOL_{solver}')}
  still = coupling.play(**options)
  for move in (coupling.lift, coupling.drop):
    assert coupling.play(move, **options) == still


def test_nothing_touches_a_meter_behind_a_barrier():
  assert coupling.contacts('unlock_door', 120) == 0
