"""Promises of registers of every variety.

`tests/authors/registers_test.py` checks the contract that ships for authors.
"""

import numpy as np
import pytest

from realab_suite.engine import single_physics
from realab_suite.entities import registers
from tests import worlds
from tests.entities import register_worlds


@pytest.fixture(scope='module', name='compiled')
def fixture_compiled():
  return register_worlds.make_world(single_physics.ThinPhysics)


@pytest.fixture(name='world')
def fixture_world(compiled):
  compiled.restart()
  return compiled


def test_values_do_not_drift_without_tampering(world):
  values = [0.0, *np.linspace(register_worlds.LOW, register_worlds.HIGH, 4)]
  worst = dict.fromkeys(world.registers, 0.0)
  for value in values:
    for register in world.registers.values():
      register.write(world.physics, value)
    worlds.step(world.physics, 200)
    for name, register in world.registers.items():
      corruption = register.inspect(world.physics)
      error = np.abs(register.read(world.physics) - value)
      moved = np.abs(corruption.permanent) * register_worlds.SCALE
      worst[name] = max(worst[name], error, moved)
  assert {name: error for name, error in worst.items() if error > 1e-9} == {}


@pytest.mark.parametrize('dof', registers.DOFS)
@register_worlds.every_kind
def test_twins_look_alike_until_they_are_touched(world, kind, dof):
  poses = []
  for channel in registers.CHANNELS:
    register = world.registers[
        register_worlds.variety_of(kind, channel, dof).name
    ]
    register.write(world.physics, 3.0)
    world.physics.forward()
    first = worlds.world_position(world.physics, register.blocks[0])
    last = worlds.world_position(world.physics, register.blocks[-1])
    poses.append([*(last - first), *_facing(world.physics, register)])
  embedded, secure = poses
  np.testing.assert_allclose(secure, embedded, atol=1e-12)


def _facing(physics, register):
  return np.array(physics.bind(register.blocks[-1].geom).xmat)


@pytest.fixture(scope='module', name='scattered')
def fixture_scattered():
  return register_worlds.make_world(spread=(0.15, 0.05))


@register_worlds.some_varieties
def test_the_seed_decides_the_place_of_a_scattered_register(scattered, variety):
  register = scattered.registers[variety.name]
  places = []
  for seed in (0, 0, 1, 2):
    scattered.restart(seed)
    corruption = register.inspect(scattered.physics)
    assert corruption.permanent == pytest.approx(
        0.0, abs=register_worlds.ROUNDING
    )
    assert register.write(scattered.physics, 3.0) == 3.0
    assert register.read(scattered.physics) == pytest.approx(
        3.0, abs=register_worlds.ROUNDING
    )
    places.append(register.blocks[0].position(scattered.physics)[:2].copy())
  np.testing.assert_array_equal(places[0], places[1])
  assert not np.allclose(places[0], places[2])
  carried = register.blocks[0] is register.blocks[-1]
  home = [
      3.0 * register_worlds.SCALE
      if carried and variety.kind == 'block_position'
      else 0,
      0,
  ]
  assert (np.abs(np.array(places) - home) <= [0.15 + 1e-9, 0.05 + 1e-9]).all()
