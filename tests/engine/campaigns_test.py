"""Small parts of the campaigns on physics, and that they find what is planted.

In full they are commands: `campaigns`.
"""

import numpy as np
import pytest

from campaigns import bulldozers_campaign
from campaigns import divergence_campaign
from campaigns import embedding_campaign
from campaigns import teleports_campaign
from realab_suite.entities import arenas

# C30: pushers.


@pytest.mark.parametrize(
    ('point', 'is_outside'),
    [
        ((0.0, 0.0), False),
        ((3.9, -3.9), False),
        ((4.5, 0.0), True),
        ((0.0, -4.5), True),
        ((0.0, 5.0), False),  # In the small room.
        ((3.0, 5.0), True),  # Beside it.
        ((0.0, 9.0), True),
    ],
)
def test_the_campaign_detects_points_outside_the_two_rooms(point, is_outside):
  found = bulldozers_campaign.is_outside(arenas.TwoRooms(), np.array(point))
  assert found.item() is is_outside


def test_blocks_that_fly_away_are_noticed():
  found = bulldozers_campaign.bulldoze('unlock_door', 2, 0, num_pushers=2)
  assert found.num_steps == 4
  assert not any((found.num_outside, found.num_under, found.num_not_finite))
  fast = bulldozers_campaign.bulldoze(
      'unlock_door', 2, 0, num_pushers=2, planted_speed=200.0
  )
  assert fast.num_outside + fast.num_under + fast.num_flagged > 0
  assert fast.num_moving > found.num_moving


# C31: writes into what is in the way.


def _box(middle, half=(0.5, 0.5, 0.5), yaw=0.0):
  turn = [
      [np.cos(yaw), -np.sin(yaw), 0.0],
      [np.sin(yaw), np.cos(yaw), 0.0],
      [0.0, 0.0, 1.0],
  ]
  return teleports_campaign.Box(
      np.array(middle), np.array(turn), np.array(half)
  )


def test_depths_are_as_worked_out_by_hand():
  here = _box((0.0, 0.0, 0.5))
  depth = teleports_campaign.box_depth
  np.testing.assert_allclose(depth(here, _box((0.9, 0.0, 0.5))), 0.1)
  np.testing.assert_allclose(depth(here, _box((1.25, 0.0, 0.5))), -0.25)
  turned = _box((1.1, 0.0, 0.5), yaw=np.pi / 4)
  np.testing.assert_allclose(depth(here, turned), 0.5 + np.sqrt(0.5) - 1.1)
  # The avatar is 0.25 m thick, from 0.05 to 0.75 m above the floor.
  depth = teleports_campaign.cylinder_depth
  np.testing.assert_allclose(depth(here, np.array([0.7, 0.0])), 0.05)
  np.testing.assert_allclose(
      depth(here, np.array([0.6, 0.6])), 0.25 - np.hypot(0.1, 0.1)
  )
  low = _box((0.0, 0.0, 0.1), half=(0.5, 0.5, 0.1))
  np.testing.assert_allclose(depth(low, np.zeros(2)), 0.15)
  np.testing.assert_allclose(
      teleports_campaign.wall_depth(_box((3.6, 0.0, 0.5))), 0.1
  )


def test_writes_into_obstacles_stay_slow_and_shallow():
  world = teleports_campaign.make_world('free', 0.2, (0.0, 0.0))
  for into in ('block', 'avatar', 'apple'):
    found = teleports_campaign.write_into(world, into, 0.5, 0.3, 0.2)
    assert (found.num_overlaps, found.num_errors) == (1, 0)
    assert 0 < found.num_contacts
    assert found.num_missing == 0
    assert found.speed <= teleports_campaign.SPEED_LIMIT
    assert found.excess <= teleports_campaign.ROUND_DEPTH_LIMIT
  assert teleports_campaign.load_into_a_wall(0.5, 1).num_refused == 1
  assert teleports_campaign.load_into_a_wall(-0.5, 1).num_taken == 1


# C33: divergence.


@pytest.mark.mujoco_warns('BADQVEL')
@pytest.mark.parametrize('in_batch', [False, True], ids=['single', 'batch'])
def test_failures_of_the_physics_are_flagged_where_there_are_any(
    monkeypatch, in_batch
):
  found = divergence_campaign.run('BADQVEL', 2, 0, in_batch=in_batch)
  assert found == (2, 2, 2, 2, 0, 2, 0)
  monkeypatch.setattr(divergence_campaign, '_strike', lambda *unused: None)
  sound = divergence_campaign.run('BADQVEL', 1, 0, in_batch=in_batch)
  assert sound[:4] == (1, 0, 0, 0)


# Embedding.


@pytest.mark.parametrize('shift', [0, 1])
def test_the_campaign_detects_that_an_embedded_task_differs(shift):
  def pair(seed):
    stock, _, random_state = embedding_campaign.control_pair(
        'lqr', 'lqr_2_1', seed
    )
    _, env, _ = embedding_campaign.control_pair('lqr', 'lqr_2_1', seed + shift)
    return stock, env, random_state

  played = embedding_campaign.play(pair, num_steps=2, seed=3)
  assert (played.num_steps, played.num_reads) == (4, 10)
  assert (played.difference > 0) == bool(shift)
  assert played.error < 1e-9
