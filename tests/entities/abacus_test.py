"""Abaci of the package: one bead, and one base block, by hand."""

import numpy as np
import pytest

from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics
from realab_suite.engine import snapshots
from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import worlds

_KINDS = {'abacus_2': registers.Abacus2, 'abacus_4': registers.Abacus4}


def _make(kind, **options):
  arena = arenas.OpenRoom()
  register = _KINDS[kind]('abacus', value_range=(-3, 3), **options)
  register.attach_to(arena, (0.4, -0.2), 0.9)
  physics = worlds.compile_world(arena, single_physics.ThinPhysics)
  worlds.start_episode(physics, register)
  return physics, register


def _moved(physics, block, distance):
  place = np.array(block.position(physics))
  place[..., 0] += distance
  block.put(physics, place)


@pytest.mark.parametrize('dof', ['free', 'planar'])
@pytest.mark.parametrize('scale', [0.1, 0.3])
@pytest.mark.parametrize('kind', _KINDS)
def test_one_bead_moved_by_d_changes_one_component_by_d_per_scale(
    kind, scale, dof
):
  physics, register = _make(kind, scale=scale, dof=dof)
  ports = len(register.PORTS)
  value = np.array([2.0, -1.0, 0.5, -2.5])[:ports]
  for i in range(ports):
    for d in (0.15, -0.06):
      register.write(physics, value)
      _moved(physics, register.blocks[1 + i], d)
      read = register.inspect(physics)
      expected = np.zeros(ports)
      expected[i] = d / scale
      np.testing.assert_allclose(read.reading - value, expected, atol=1e-12)
      np.testing.assert_allclose(read.temporary, expected, atol=1e-12)
      np.testing.assert_array_equal(read.permanent, 0.0)
  register.write(physics, value)
  np.testing.assert_allclose(register.read(physics), value, atol=1e-12)
  # The base block: the same for all, and for good.
  _moved(physics, register.blocks[0], 0.15)
  register.write(physics, -value)
  read = register.inspect(physics)
  np.testing.assert_allclose(read.reading, -value - 0.15 / scale, atol=1e-12)
  np.testing.assert_allclose(read.permanent, -0.15 / scale, atol=1e-12)


@pytest.mark.parametrize('kind', _KINDS)
def test_one_bead_in_one_world_of_a_batch(kind):
  physics, register = _make(kind, scale=0.2)
  register.write(physics, np.ones(len(register.PORTS)))
  states = np.tile(snapshots.get_state(physics), (3, 1))
  batch = batch_physics.BatchPhysics(_make(kind, scale=0.2)[0], 3, 1)
  batch.set_state(np.arange(3), states)
  _moved(batch, register.blocks[2], np.array([0.0, 0.1, 0.0]))
  expected = np.ones((3, len(register.PORTS)))
  expected[1, 1] = 1.5
  np.testing.assert_allclose(register.read(batch), expected, atol=1e-12)
