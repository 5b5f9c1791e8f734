"""Tests that a meter which is out of reach is not felt."""

import functools

import numpy as np
import pytest

from campaigns import solver_coupling_campaign

_SOLVERS = pytest.mark.parametrize('solver', solver_coupling_campaign.SOLVERS)


# Without moves, and with a meter that measures nothing.
_still = functools.cache(solver_coupling_campaign.play)


def _world(solver: str) -> solver_coupling_campaign.World:
  return solver_coupling_campaign.World(
      options=tuple(solver_coupling_campaign.SOLVERS[solver].items())
  )


@_SOLVERS
def test_moving_a_distant_meter_is_not_felt(solver: str):
  world = _world(solver)
  for move in solver_coupling_campaign.MOVES.values():
    assert solver_coupling_campaign.play(world, move) == _still(world)


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
  found = solver_coupling_campaign.play(world, measure=measure)
  assert found == _still(world)


def test_a_distant_meter_is_felt_with_the_solvers_that_are_refused():
  # The control: this comparison can tell runs apart.
  for options in solver_coupling_campaign.REFUSED.values():
    world = solver_coupling_campaign.World(options=tuple(options.items()))
    lifted = solver_coupling_campaign.play(world, solver_coupling_campaign.lift)
    assert lifted != _still(world)


def test_these_solvers_are_refused_when_a_world_with_meters_is_loaded():
  assert solver_coupling_campaign.refused_by_loader() == [
      *solver_coupling_campaign.REFUSED,
      'PGS',
      'noslip',
  ]


def test_pairs_of_the_campaign_are_counted():
  assert solver_coupling_campaign.differing(4, 0) == (0, 4)


@pytest.mark.parametrize('domain', ['collect_apples', 'unlock_door'])
def test_nothing_touches_a_meter_behind_a_barrier(domain: str):
  assert solver_coupling_campaign.contacts(domain, 120, 0) == 0


def test_contacts_with_a_meter_are_counted():
  # The control: this meter is in the way.
  env = solver_coupling_campaign.suite.load(
      'collect_apples', 'standard', {'random': 0}, design='instantaneous_reward'
  )
  env.reset()
  assert solver_coupling_campaign.num_contacts_of_meters(env) == 0
  block = env.mechanism.registers['score'].blocks[0].geom
  x, y, _ = env.physics.bind(block).xpos
  env.task.avatar.place(env.physics, np.array([x - 0.25, y]), 0.0)
  env.physics.forward()
  assert solver_coupling_campaign.num_contacts_of_meters(env) > 0
