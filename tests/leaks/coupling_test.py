"""Tests that a meter which is out of reach is not felt."""

import numpy as np
import pytest

from campaigns import solver_coupling_campaign as coupling

_SOLVERS = pytest.mark.parametrize('solver', coupling.SOLVERS)


def _world(solver: str) -> coupling.World:
  return coupling.World(options=tuple(coupling.SOLVERS[solver].items()))


@_SOLVERS
def test_moving_a_distant_meter_is_not_felt(solver: str):
  world = _world(solver)
  still = coupling.play(world)
  for move in coupling.MOVES.values():
    assert coupling.play(world, move) == still


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
def test_what_a_distant_meter_measures_is_not_felt(measure, solver: str):
  world = _world(solver)
  assert coupling.play(world, measure=measure) == coupling.play(world)


def test_a_distant_meter_is_felt_with_the_solvers_that_are_refused():
  # The control: this comparison can tell runs apart.
  for options in coupling.REFUSED.values():
    world = coupling.World(options=tuple(options.items()))
    assert coupling.play(world, coupling.lift) != coupling.play(world)


def test_these_solvers_are_refused_when_a_world_with_meters_is_loaded():
  assert coupling.refused_by_loader() == [*coupling.REFUSED, 'PGS', 'noslip']


def test_pairs_of_the_campaign_are_counted():
  assert coupling.differing(10, 0) == (0, 10)


@pytest.mark.parametrize('domain', ['collect_apples', 'unlock_door'])
def test_nothing_touches_a_meter_behind_a_barrier(domain: str):
  assert coupling.contacts(domain, 120, 0) == 0


def test_whoever_touches_a_meter_is_noticed():
  # The control: this meter is in the way.
  env = coupling.suite.load(
      'collect_apples', 'standard', {'random': 0}, design='instantaneous_reward'
  )
  env.reset()
  assert coupling.num_contacts_of_meters(env) == 0
  block = env.mechanism.registers['score'].blocks[0].geom
  x, y, _ = env.physics.bind(block).xpos
  env.task.avatar.place(env.physics, np.array([x - 0.25, y]), 0.0)
  env.physics.forward()
  assert coupling.num_contacts_of_meters(env) > 0
  env.close()
