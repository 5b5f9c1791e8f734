"""Solids contain every pose of a block, and meet what a pose overlaps."""

import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

from realab_suite.engine import solids
from realab_suite.entities.registers import footprints
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
_BLOCK, _WALL, _BALL = 0, 2, 3


def _turned(angle):
  cos, sin = np.cos(angle), np.sin(angle)
  return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _region(
    centre=(0.0, 0.0), yaw=0.0, line=(0.0, 0.0), spread=(0.0, 0.0), turn=0.0,
    slack=0.0,
):  # fmt: skip
  """Returns a block that moves by `line`, and turns, to either side."""
  path = footprints.Path(
      0,
      -np.array([*line, 0.0]),
      np.array([*line, 0.0]),
      (-3.0, 5.0),
      (-turn, turn),
      slack,
  )
  return solids.Region(
      _BLOCK,
      path,
      np.array([*centre, 0.1]),
      _turned(yaw),
      0.1,
      np.array([*spread, 0.0]),
  )


def _still(space, geom, centre, yaw=0.0):
  return [space.solid(geom, np.array([*centre, 0.1]), _turned(yaw))]


def _pose(region, share, sides):
  """Returns the centre and the axes of one pose of a block."""
  path = region.path
  centre = path.first + share * (path.last - path.first)
  centre = centre + region.spread * [*sides, 0.0]
  first, last = path.headings
  turn = _turned(first + share * (last - first))
  return region.origin + region.matrix @ centre, region.matrix @ turn


def _distance(geom, one, other_geom, other):
  for number, (centre, matrix) in ((geom, one), (other_geom, other)):
    _DATA.geom_xpos[number] = centre
    _DATA.geom_xmat[number] = matrix.ravel()
  return mujoco.mj_geomDistance(_MODEL, _DATA, geom, other_geom, 0.1, None)


def _floats(low, high):
  return st.floats(low, high).map(lambda x: round(x, 4))


_anywhere = st.tuples(_floats(-1.5, 1.5), _floats(-1.5, 1.5))
_yaws = st.sampled_from([0.0, np.pi / 2]) | _floats(-3.0, 3.0)
_reaches = st.just(0.0) | _floats(0.0, 1.0)
_sliding = st.builds(
    lambda centre, yaw, along, x, y: _region(centre, yaw, (along, 0.0), (x, y)),
    _anywhere, _yaws, _reaches, _reaches, _reaches,
)  # fmt: skip
_turning = st.builds(
    lambda centre, yaw, x, y, turn: _region(
        centre, yaw, spread=(x, y), turn=turn
    ),
    _anywhere, _yaws, _reaches, _reaches, _floats(0.05, 3.0),
)  # fmt: skip
_ways = st.none() | st.tuples(_floats(-1.0, 1.0), _floats(-1.0, 1.0))


@examples.settings(60)
@hypothesis.given(
    _sliding | _turning, st.integers(2, 6), _anywhere, _yaws, _ways
)
def test_what_is_said_to_keep_apart_does(region, geom, centre, yaw, way):
  space = solids.Space(_MODEL)
  there = _still(space, geom, centre, yaw)
  displacement = np.zeros(3) if way is None else np.array([*way, 0.0])
  met = space.meet(region.hulls, there, None if way is None else displacement)
  hypothesis.event('apart' if met is None else 'met')
  if met is not None:
    return
  rng = np.random.default_rng(0)
  for _ in range(100):
    sides = np.clip(rng.uniform(-1.5, 1.5, 2), -1.0, 1.0)
    share, done = np.clip(rng.uniform(-0.25, 1.25, 2), 0.0, 1.0)
    other = there[0].centre + done * displacement, there[0].matrix
    distance = _distance(_BLOCK, _pose(region, share, sides), geom, other)
    assert distance >= -solids.TOLERANCE - 1e-6


@examples.settings(60)
@hypothesis.given(_sliding, st.integers(2, 6), _anywhere, _yaws)
def test_a_block_that_slides_overlaps_what_it_is_said_to_meet(
    region, geom, centre, yaw
):
  space = solids.Space(_MODEL)
  (there,) = _still(space, geom, centre, yaw)
  point = space.meet(region.hulls, [there])
  if point is None:
    return
  ((value, block),) = region.poses_near(point)
  assert -3.0 <= value <= 5.0
  pose, other = (block.centre, block.matrix), (there.centre, there.matrix)
  assert _distance(_BLOCK, pose, geom, other) < 1e-4


@pytest.mark.parametrize('clearance', [0.0, 0.3])
@pytest.mark.parametrize('gap', [0.01, 1e-6, 0.0, -5e-5, -2e-3, -0.05])
@pytest.mark.parametrize('geom', range(1, 7))
def test_a_touch_is_no_overlap(geom, gap, clearance):
  # How far each geom reaches towards the block, and how far the block goes.
  reach = {1: 0.1, 2: 1.0, 3: 0.2, 4: 0.1, 5: 0.2, 6: 0.1}[geom]
  space = solids.Space(_MODEL)
  region = _region(line=(0.5, 0.0), spread=(0.0, 0.2))
  there = _still(space, geom, (0.6 + reach + gap + clearance, 0.0))
  met = space.meet(region.hulls, there, clearance=clearance)
  assert (met is not None) == (gap < -solids.TOLERANCE)
  if met is not None:
    ((value, block),) = region.poses_near(met)
    assert block.centre[0] == pytest.approx(0.5, abs=0.01)
    assert value == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize('gap', [0.01, 0.0, -2e-3])
def test_the_way_of_an_obstacle_counts(gap):
  space = solids.Space(_MODEL)
  # The ball passes the block on its way.
  there = _still(space, _BALL, (-2.0, 0.3 + gap))
  way = np.array([4.0, 0.0, 0.0])
  assert space.meet(_region().hulls, there) is None
  met = space.meet(_region().hulls, there, way)
  assert (met is not None) == (gap < -solids.TOLERANCE)
  assert space.meet(_region().hulls, there, -way) is None


@pytest.mark.parametrize('turn', [0.0, 0.1, np.pi / 4, 3.0])
def test_a_block_that_turns_needs_room_for_its_corners(turn):
  widest = 0.1 * (np.cos(min(turn, np.pi / 4)) + np.sin(min(turn, np.pi / 4)))
  space = solids.Space(_MODEL)
  for gap, is_met in [(0.001, False), (-0.003, True)]:
    wall = _still(space, _WALL, (0.0, 0.1 + widest + gap))
    met = space.meet(_region(turn=turn).hulls, wall)
    assert (met is not None) == is_met


def test_the_corners_of_a_block_that_turns_go_round():
  # A box about all poses would meet the sphere, in its corner.
  radius = 0.1 * np.sqrt(2)
  diagonal = np.array([1.0, 1.0]) / np.sqrt(2)
  space = solids.Space(_MODEL)
  for gap, is_met in [(0.001, False), (-0.003, True)]:
    sphere = _still(space, _BALL, diagonal * (radius + 0.2 + gap))
    assert (space.meet(_region(turn=3.0).hulls, sphere) is not None) == is_met


def test_slack_counts_as_part_of_a_block():
  space = solids.Space(_MODEL)
  wall = _still(space, _WALL, (0.0, 0.25))
  assert space.meet(_region().hulls, wall) is None
  assert space.meet(_region(slack=0.06).hulls, wall) is not None


@pytest.mark.parametrize('turn', [0.0, 0.6, 2.0])
def test_no_pose_is_outside_the_bounds(turn):
  rng = np.random.default_rng(0)
  region = _region((0.3, -0.2), 0.5, (0.4, 0.0), (0.1, 0.7), turn)
  space = solids.Space(_MODEL)
  corners = np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, -1)
  for hull in region.hulls:
    low, high = space.bounds(hull)
    for _ in range(200):
      centre, matrix = _pose(region, rng.uniform(), rng.uniform(-1, 1, 2))
      points = (matrix @ corners).T + centre
      assert (points >= low).all()
      assert (points <= high).all()


def test_a_missing_distance_of_mujoco_is_found_otherwise(monkeypatch):
  space = solids.Space(_MODEL)
  distance_of = mujoco.mj_geomDistance
  answers = []

  def fail(*args):
    answers.append(distance_of(*args))
    return 0.0 if len(answers) % 2 else answers[-1]

  monkeypatch.setattr(mujoco, 'mj_geomDistance', fail)
  wall = _still(space, _WALL, (0.0, 0.15))
  assert space.meet(_region().hulls, wall) is not None
  assert len(answers) > 1
  # What is not found counts as an overlap, of an unknown depth.
  monkeypatch.setattr(mujoco, 'mj_geomDistance', lambda *args: 0.0)
  point = space.meet(_region().hulls, wall)
  text = space.describe('r', _region(), point, wall[0])
  assert text == "register 'r' at value -3 would be at (0, 0), inside 'geom 2'"


@pytest.mark.parametrize('geom', range(1, 7))
@pytest.mark.parametrize('reach', [0.0, 0.5, 2.0])
def test_a_geom_through_a_block_overlaps_it(geom, reach):
  region = _region(line=(reach, 0.0), spread=(0.0, reach))
  space = solids.Space(_MODEL)
  (there,) = _still(space, geom, (0.0, 0.0))
  point = space.meet(region.hulls, [there])
  assert point is not None
  assert ' m inside ' in space.describe('r', region, point, there) or geom == 1


def test_the_model_stays_as_it_is():
  before = np.array(_MODEL.geom_size), np.array(_MODEL.geom_type)
  space = solids.Space(_MODEL)
  space.meet(_region(turn=1.0).hulls, _still(space, 4, (0.0, 0.3)))
  np.testing.assert_array_equal(_MODEL.geom_size, before[0])
  np.testing.assert_array_equal(_MODEL.geom_type, before[1])
