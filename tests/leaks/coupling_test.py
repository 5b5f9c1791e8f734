"""Tests that a meter which is out of reach is not felt."""

import functools

import numpy as np
import pytest

from realab_suite import suite
from tests.leaks import coupling

_SOLVERS = pytest.mark.parametrize('solver', coupling.SOLVERS)


# Without moves, and with a meter that measures nothing.
_still = functools.cache(coupling.play)


def _world(solver: str) -> coupling.World:
  return coupling.World(options=tuple(coupling.SOLVERS[solver].items()))


@_SOLVERS
@pytest.mark.parametrize('dof', ['free', 'planar'])
def test_moving_a_distant_meter_is_not_felt(solver: str, dof: str):
  world = _world(solver)._replace(dof=dof)
  for name, move in coupling.MOVES.items():
    if (name, dof) != ('turn over', 'planar'):  # Planar blocks do not roll.
      assert coupling.play(world, move) == _still(world)


@_SOLVERS
@pytest.mark.parametrize(
    'measure',
    [
        lambda physics: 5.0,
        lambda physics: 10.0 * (physics.time() > 2.0),
        lambda physics: np.floor(3.0 * physics.time()) % 20,
    ],
    ids=['another', 'jumps once', 'jumps all the time'],
)
def test_the_values_of_a_distant_meter_are_not_felt(measure, solver: str):
  world = _world(solver)
  found = coupling.play(world, measure=measure)
  assert found == _still(world)


def test_a_distant_meter_is_felt_with_the_solvers_that_are_refused():
  # The control: this comparison can tell runs apart.
  for options in coupling.REFUSED.values():
    world = coupling.World(options=tuple(options.items()))
    lifted = coupling.play(world, coupling.lift)
    assert lifted != _still(world)


def test_these_solvers_are_refused_when_a_world_with_meters_is_loaded():
  assert coupling.refused_by_loader() == [
      *coupling.REFUSED,
      'PGS',
      'noslip',
  ]


@pytest.mark.parametrize('domain', ['collect_apples', 'unlock_door'])
def test_nothing_touches_a_meter_behind_a_barrier(domain: str):
  assert coupling.contacts(domain, 120, 0) == 0


def test_contacts_with_a_meter_are_counted():
  # The control: this meter is in the way.
  env = suite.load(
      'collect_apples', 'standard', {'random': 0}, design='instantaneous_reward'
  )
  env.reset()
  assert coupling.num_contacts_of_meters(env) == 0
  block = env.mechanism.registers['score'].blocks[0].geom
  x, y, _ = env.physics.bind(block).xpos
  env.task.avatar.place(env.physics, np.array([x - 0.25, y]), 0.0)
  env.physics.forward()
  assert coupling.num_contacts_of_meters(env) > 0
