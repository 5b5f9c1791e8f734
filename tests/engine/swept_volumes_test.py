"""Sweeps that are said to keep apart do; those that are not have met."""

import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

from realab_suite.engine import swept_volumes
from tests import examples

_XML = """<mujoco><worldbody>
  <geom type="box" size="0.1 0.1 0.1"/>
  <geom type="box" size="0.1 0.1 0.1"/>
  <geom type="box" size="1 0.1 0.5"/>
  <geom type="sphere" size="0.2"/>
  <geom type="capsule" size="0.1 0.4"/>
  <geom type="cylinder" size="0.2 0.4"/>
  <geom type="ellipsoid" size="0.1 0.3 0.4"/>
</worldbody></mujoco>"""
_MODEL = mujoco.MjModel.from_xml_string(_XML)
_DATA = mujoco.MjData(_MODEL)
_BLOCK, _OTHER_BLOCK, _WALL, _BALL = 0, 1, 2, 3
_UPRIGHT = np.eye(3)


def _floats(low, high):
  return st.floats(low, high).map(lambda x: round(x, 4))


def _sweep(geom, centre, yaw=0.0, shifts=(), turn=0.0, **kwargs):
  """Shifts are in the frame of the geom."""
  matrix = swept_volumes.turned(_UPRIGHT, yaw)
  motions = [[*(matrix @ [*shift, 0.0]), 0.0, 0.0] for shift in shifts]
  if turn:
    motions.append([0.0, 0.0, 0.0, turn, 1.0])
  return swept_volumes.Sweep(
      geom,
      np.array([*centre, 0.1]),
      matrix,
      np.array(motions).reshape(-1, 5),
      **kwargs,
  )


_anywhere = st.tuples(_floats(-1.5, 1.5), _floats(-1.5, 1.5))
_yaws = st.sampled_from([0.0, np.pi / 2]) | _floats(-3.0, 3.0)
_reaches = st.just(0.0) | _floats(0.0, 1.0)


def _blocks(geom):
  """Sweeps of a block: in a region, and along or about an axis."""
  return st.builds(
      lambda centre, yaw, x, y, turn: _sweep(
          geom, centre, yaw, [(x, 0.0), (0.0, y)], turn
      ),
      _anywhere,
      _yaws,
      _reaches,
      _reaches,
      st.just(0.0) | _floats(0.05, 3.0),
  )


def _stills(geom):
  return st.builds(lambda c, yaw: _sweep(geom, c, yaw), _anywhere, _yaws)


_others = _blocks(_OTHER_BLOCK) | st.sampled_from(range(2, 7)).flatmap(_stills)


def _distance(one, other):
  """Returns the distance between the middle poses, by MuJoCo alone."""
  for sweep in (one, other):
    _DATA.geom_xpos[sweep.geom] = sweep.centre
    _DATA.geom_xmat[sweep.geom] = sweep.matrix.ravel()
  return mujoco.mj_geomDistance(_MODEL, _DATA, one.geom, other.geom, 0.1, None)


def _sampled(one, other, number, seed=0):
  """Returns the least distance of random poses of two swept_volumes."""
  rng = np.random.default_rng(seed)
  return min(
      _distance(*(
          sweep.pose(
              np.clip(rng.uniform(-1.5, 1.5, len(sweep.motions)), -1.0, 1.0)
          )
          for sweep in (one, other)
      ))
      for _ in range(number)
  )  # fmt: skip


@examples.settings(75)
@hypothesis.given(_blocks(_BLOCK), _others)
def test_sweeps_meet_exactly_if_poses_overlap(one, other):
  met = swept_volumes.Space(_MODEL).meet(one, other)
  hypothesis.event('meet' if met else 'keep apart')
  if met is None:
    assert _sampled(one, other, 60) >= -swept_volumes.TOLERANCE
    return
  pose, distance = met
  assert distance < 0.0
  assert not pose.motions.any()
  # The pose is one of the sweep's, and the other one has a pose that meets it.
  assert (np.abs(pose.centre - one.centre) <= one.travel + 1e-9).all()
  assert swept_volumes.Space(_MODEL).meet(pose, other) is not None


@pytest.mark.parametrize('clearance', [0.0, 0.3])
@pytest.mark.parametrize('gap', [0.01, 1e-6, 0.0, -5e-5, -2e-3, -0.05])
@pytest.mark.parametrize('geom', range(1, 7))
def test_a_touch_is_no_overlap(geom, gap, clearance):
  # How far each geom reaches towards the block, and how far the block goes.
  reach = {1: 0.1, 2: 1.0, 3: 0.2, 4: 0.1, 5: 0.2, 6: 0.1}[geom]
  block = _sweep(_BLOCK, (0.0, 0.0), shifts=[(0.5, 0.0), (0.0, 0.2)])
  centre = (0.6 + reach + gap + clearance, 0.0)
  met = swept_volumes.Space(_MODEL).meet(block, _sweep(geom, centre), clearance)
  assert (met is not None) == (gap < -swept_volumes.TOLERANCE)
  if met is not None:
    pose, distance = met
    assert pose.centre[0] == pytest.approx(0.5, abs=0.01)
    assert distance == pytest.approx(clearance + gap, abs=0.01)


@pytest.mark.parametrize('turn', [0.0, 0.1, np.pi / 4, 3.0])
def test_a_block_that_turns_needs_room_for_its_corners(turn):
  widest = 0.1 * (np.cos(min(turn, np.pi / 4)) + np.sin(min(turn, np.pi / 4)))
  block = _sweep(_BLOCK, (0.0, 0.0), turn=turn)
  for gap, is_met in [(0.001, False), (-0.003, True)]:
    wall = _sweep(_WALL, (0.0, 0.1 + widest + gap))
    met = swept_volumes.Space(_MODEL).meet(block, wall)
    assert (met is not None) == is_met


def test_the_corners_of_a_block_that_turns_go_round():
  # A box about all poses would meet the sphere, in its corner.
  block = _sweep(_BLOCK, (0.0, 0.0), turn=3.0)
  radius = 0.1 * np.sqrt(2)
  diagonal = np.array([1.0, 1.0]) / np.sqrt(2)
  for gap, is_met in [(0.001, False), (-0.003, True)]:
    sphere = _sweep(3, diagonal * (radius + 0.2 + gap))
    met = swept_volumes.Space(_MODEL).meet(block, sphere)
    assert (met is not None) == is_met


def test_the_value_of_a_pose_that_meets_is_reported():
  motions = np.array([[1.0, 0.0, 0.0, 0.0, 5.0]])
  block = swept_volumes.Sweep(
      _BLOCK, np.array([0, 0, 0.1]), _UPRIGHT, motions, 2.0
  )
  pose, distance = swept_volumes.Space(_MODEL).meet(
      block, _sweep(_OTHER_BLOCK, (0.9, 0.0))
  )
  assert distance < -0.09
  assert pose.value == pytest.approx(2.0 + 5.0 * pose.centre[0])


def test_slack_counts_as_part_of_a_block():
  wall = _sweep(_WALL, (0.0, 0.25))
  space = swept_volumes.Space(_MODEL)
  assert space.meet(_sweep(_BLOCK, (0.0, 0.0)), wall) is None
  assert space.meet(_sweep(_BLOCK, (0.0, 0.0), slack=0.06), wall) is not None


def test_no_pose_is_outside_the_bounds():
  rng = np.random.default_rng(0)
  block = _sweep(_BLOCK, (0.3, -0.2), 0.5, [(0.4, 0.0), (0.0, 0.7)], turn=0.6)
  low, high = swept_volumes.Space(_MODEL).bounds(block)
  corners = np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, -1)
  for _ in range(200):
    pose = block.pose(rng.uniform(-1, 1, 3))
    points = (pose.matrix @ corners).T + pose.centre
    assert (points >= low).all()
    assert (points <= high).all()


def test_a_missing_distance_of_mujoco_is_found_otherwise(monkeypatch):
  space = swept_volumes.Space(_MODEL)
  distance_of = mujoco.mj_geomDistance
  answers = []

  def fail(*args):
    answers.append(distance_of(*args))
    return 0.0 if len(answers) % 2 else answers[-1]

  monkeypatch.setattr(mujoco, 'mj_geomDistance', fail)
  block, wall = _sweep(_BLOCK, (0.0, 0.0)), _sweep(_WALL, (0.0, 0.15))
  assert space.meet(block, wall) is not None
  assert len(answers) > 1
  monkeypatch.setattr(mujoco, 'mj_geomDistance', lambda *args: 0.0)
  assert space.meet(block, wall) is not None


def test_a_search_that_decides_nothing_ends_with_an_overlap(monkeypatch):
  block = _sweep(_BLOCK, (0.0, 0.0), shifts=[(0.2, 0.0), (0.0, 0.3)], turn=0.1)
  # Next to where a corner of the block can go.
  angle = np.pi / 4 - 0.1
  corner = np.hypot(0.1, 0.1) * np.array([np.cos(angle), np.sin(angle)])
  way = np.array([np.cos(0.3), np.sin(0.3)])
  sphere = _sweep(3, np.array([0.2, 0.3]) + corner + 0.202 * way)
  space = swept_volumes.Space(_MODEL)
  assert space.meet(block, sphere) is None
  monkeypatch.setattr(swept_volumes, '_MAX_PAIRS', 3)
  assert space.meet(block, sphere) is not None


@pytest.mark.parametrize('geom', range(1, 7))
@pytest.mark.parametrize('reach', [0.0, 0.5, 2.0])
def test_a_geom_through_a_block_overlaps_it(geom, reach):
  block = _sweep(_BLOCK, (0.0, 0.0), shifts=[(reach, 0.0), (0.0, reach)])
  pose, distance = swept_volumes.Space(_MODEL).meet(
      block, _sweep(geom, (0.0, 0.0))
  )
  assert np.isfinite(distance)
  assert distance < -0.15
  assert pose.centre[:2] == pytest.approx((0.0, 0.0), abs=0.2)


def test_the_model_stays_as_it_is():
  before = np.array(_MODEL.geom_size), np.array(_MODEL.geom_type)
  space = swept_volumes.Space(_MODEL)
  space.make_box(_BALL, np.ones(3))
  space.meet(_sweep(_BLOCK, (0, 0), turn=1.0), _sweep(_WALL, (0, 0.3)))
  np.testing.assert_array_equal(_MODEL.geom_size, before[0])
  np.testing.assert_array_equal(_MODEL.geom_type, before[1])
