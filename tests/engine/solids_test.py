"""Solids contain every pose of a block, and meet what a pose overlaps."""

import copy
import functools

import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

from realab_suite.engine import solids
from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import examples
from tests import worlds
from tests.entities import register_worlds

_XML = """<mujoco><worldbody>
  <geom type="box" size="0.1 0.1 0.1"/>
  <geom type="box" size="0.1 0.1 0.1"/>
  <geom type="box" size="1 0.1 0.5"/>
  <geom type="sphere" size="0.2"/>
  <geom type="capsule" size="0.1 0.4"/>
  <geom type="cylinder" size="0.2 0.4"/>
  <geom type="ellipsoid" size="0.1 0.3 0.4"/>
  <geom type="plane" size="0.5 0.7 0.1"/>
  <geom type="plane" size="0 0.4 0.1"/>
</worldbody></mujoco>"""
_MODEL = mujoco.MjModel.from_xml_string(_XML)
_DATA = mujoco.MjData(_MODEL)
_BLOCK, _WALL = 0, 2


def _turned(angle):
  cos, sin = np.cos(angle), np.sin(angle)
  return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _rotation(axis_angle):
  quaternion, matrix = np.zeros(4), np.zeros(9)
  length = np.linalg.norm(axis_angle) or 1.0
  mujoco.mju_axisAngle2Quat(quaternion, np.array(axis_angle) / length, length)
  mujoco.mju_quat2Mat(matrix, quaternion)
  return matrix.reshape(3, 3)


def _solid(geom, place, yaw=0.0):
  space = solids.Space(_MODEL)
  return space.solid(geom, [*place, 0.1], _turned(yaw))


def _box(half_length=0.1):
  return _solid(_BLOCK, (0.0, 0.0))._replace(
      half=np.array([half_length, 0.1, 0.1]), is_box=True
  )


def _distance(one, other):
  for solid in (one, other):
    _DATA.geom_xpos[solid.geom] = solid.centre
    _DATA.geom_xmat[solid.geom] = solid.matrix.ravel()
  return mujoco.mj_geomDistance(_MODEL, _DATA, one.geom, other.geom, 0.1, None)


def _floats(low, high):
  return st.floats(low, high).map(lambda x: round(x, 4))


_places = st.tuples(_floats(-1.5, 1.5), _floats(-1.5, 1.5))
_rotations = st.tuples(*[_floats(-1.0, 1.0)] * 3).map(_rotation)
_yaws = st.sampled_from([0.0, np.pi / 2]) | _floats(-3.0, 3.0)


@examples.settings(60)
@hypothesis.given(_places, st.integers(2, 6), _places, _yaws, _places)
def test_what_is_said_to_keep_apart_does(place, geom, other, yaw, way):
  block, there = _solid(_BLOCK, place, 0.3), _solid(geom, other, yaw)
  way = np.array([*way, 0.0])
  met = solids.Space(_MODEL).meet(block, there._replace(way=way))
  hypothesis.event('apart' if met is None else 'met')
  if met is None:
    for share in np.linspace(0.0, 1.0, 50):
      distance = _distance(block, there.moved(share * way))
      assert distance >= -solids.TOLERANCE - 1e-6


@pytest.mark.parametrize('geom', range(2, 7))
@pytest.mark.parametrize(
    ('place', 'is_met'),
    # In the corners of the bounds of the way, beside the way, and in it.
    [((0.2, 1.8), False), ((1.6, 0.5), False), ((1.2, 1.4), True)],
)
def test_a_geom_that_moves_fills_its_way_alone(geom, place, is_met):
  there = _solid(geom, (0.0, 0.0), np.pi / 4)
  there = there._replace(way=np.array([2.0, 2.0, 0.0]))
  met = solids.Space(_MODEL).meet(_solid(_BLOCK, place), there)
  assert (met is not None) == is_met


@pytest.mark.parametrize('clearance', [0.0, 0.3])
@pytest.mark.parametrize('gap', [0.01, 1e-6, 0.0, -5e-5, -2e-3, -0.05])
@pytest.mark.parametrize('geom', range(1, 7))
def test_a_touch_is_no_overlap(geom, gap, clearance):
  # How far each geom reaches towards the block, and how far the block goes.
  reach = {1: 0.1, 2: 1.0, 3: 0.2, 4: 0.1, 5: 0.2, 6: 0.1}[geom]
  there = _solid(geom, (0.6 + reach + gap + clearance, 0.0))
  met = solids.Space(_MODEL).meet(_box(0.6), there, clearance)
  assert (met is not None) == (gap < -solids.TOLERANCE)


@pytest.mark.parametrize('geom', range(1, 7))
@pytest.mark.parametrize('half_length', [0.1, 0.6, 2.0])
def test_a_geom_through_a_box_meets_it(geom, half_length):
  there = _solid(geom, (0.0, 0.0))
  assert solids.Space(_MODEL).meet(_box(half_length), there) is not None


def test_a_missing_distance_of_mujoco_is_found_otherwise(monkeypatch):
  space, wall = solids.Space(_MODEL), _solid(_WALL, (0.0, 0.15))
  distance_of = mujoco.mj_geomDistance
  answers = []

  def fail(*args):
    answers.append(distance_of(*args))
    return 0.0 if len(answers) % 2 else answers[-1]

  monkeypatch.setattr(mujoco, 'mj_geomDistance', fail)
  assert space.meet(_box(), wall) is not None
  assert len(answers) > 1
  # What is not found counts as an overlap.
  monkeypatch.setattr(mujoco, 'mj_geomDistance', lambda *args: 0.0)
  assert space.meet(_box(), wall) is not None


@pytest.mark.parametrize('kind', register_worlds.KINDS)
@pytest.mark.parametrize('value_range', [(-0.3, 0.2), (-2.0, 2.9)])
def test_no_pose_is_outside_its_region(kind, value_range):
  arena = arenas.OpenRoom()
  register = register_worlds.KINDS[kind]('r', value_range=value_range, scale=1)
  register.attach_to(arena, (0.3, -0.2), yaw=0.5)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  regions = solids.regions(physics, register, np.zeros(2))
  widest = np.zeros(3)
  for value in np.linspace(*value_range, 50):
    register.pose(physics, value)
    for region, block in zip(regions, register.blocks, strict=True):
      size, pose = region.half_size, physics.bind(block.geom)
      corners = size * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
      corners = pose.xpos + corners @ np.reshape(pose.xmat, (3, 3)).T
      solid = region.solid
      beyond = np.abs((corners - solid.centre) @ solid.matrix) - solid.half
      assert beyond.max() <= solids.TOLERANCE
      widest = np.maximum(widest, beyond.max(axis=0) + 1.0)
  np.testing.assert_allclose(widest, 1.0, atol=0.01)  # The box is not larger.


@functools.cache
def _orientation():
  arena = arenas.OpenRoom()
  register = registers.BlockOrientationRegister('r', value_range=(-1.0, 1.0))
  register.attach_to(arena, (0.0, 0.0))
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  return physics, register


def _turning(monkeypatch, headings, spread, yaw):
  """Returns the solid of a block that turns, and the solids of some poses."""
  physics, register = _orientation()
  middle = np.array([0.0, 0.0, 0.1])
  path = registers.Path(0, middle, middle, (0.0, 1.0), headings)
  monkeypatch.setattr(register, 'footprint', lambda physics: [path])
  [region] = solids.regions(physics, register, np.array(spread))
  there = {'geom': _BLOCK, 'matrix': _turned(yaw)}
  region = region._replace(solid=region.solid._replace(**there))
  block = _solid(_BLOCK, (0.0, 0.0))
  poses = [
      block._replace(centre=centre, matrix=_turned(yaw + turn))
      for turn in np.linspace(*headings, 40)
      for centre in region.corners()[::2]
  ]
  return region.solid, poses


@examples.settings(60)
@hypothesis.given(
    st.tuples(_floats(-3.0, 0.0), _floats(0.0, 3.0) | st.just(98.0)),
    st.tuples(_floats(0.0, 0.2), _floats(0.0, 0.2)),
    _yaws,
    st.integers(2, 6),
    st.tuples(_floats(-0.8, 0.8), _floats(-0.8, 0.8)),
    _yaws,
)
def test_what_keeps_apart_from_a_turning_block_does(
    headings, spread, yaw, geom, place, turn
):
  with pytest.MonkeyPatch.context() as monkeypatch:
    solid, poses = _turning(monkeypatch, headings, spread, yaw)
  there = _solid(geom, place, turn)
  is_apart = solids.Space(_MODEL).meet(solid, there) is None
  hypothesis.event('apart' if is_apart else 'met')
  if is_apart:
    for pose in poses:
      assert _distance(pose, there) >= -solids.TOLERANCE - 1e-6


@pytest.mark.parametrize('last', [3.0, -3.0 + 32 * np.pi])
@pytest.mark.parametrize(
    ('yaw', 'spread', 'distance', 'is_met'),
    [
        (0.0, 0.0, 0.138, True),
        (0.0, 0.0, 0.145, False),
        (np.pi / 4, 0.0, 0.138, True),
        (np.pi / 4, 0.0, 0.145, False),
        (np.pi / 4, 0.1, 0.28, True),
        (np.pi / 4, 0.1, 0.29, False),
    ],
)
def test_a_block_that_turns_fills_a_circle_in_any_frame(
    monkeypatch, yaw, spread, distance, is_met, last
):
  # The diagonals of the block and of the region are 0.141 m from the middle.
  around = (spread, spread)
  solid, _ = _turning(monkeypatch, (-3.0, last), around, yaw)
  wall = _solid(_WALL, (0.0, distance + 0.1))
  met = solids.Space(_MODEL).meet(solid, wall)
  assert (met is not None) == is_met


@examples.settings(60)
@hypothesis.given(
    st.integers(2, 8),
    st.tuples(_floats(-1.5, 1.5), _floats(-1.5, 1.5), _floats(-0.5, 0.5)),
    _rotations,
    _floats(-3.0, 3.0),
    st.sampled_from([0.0, 0.1]),
)
def test_what_is_said_to_meet_for_sure_does(geom, place, turn, yaw, radius):
  box = _box(0.3)._replace(matrix=_turned(yaw), radius=radius, inset=radius)
  space = solids.Space(_MODEL)
  there = space.solid(geom, place, turn)
  along = np.linspace(-2.0, 2.0, 9)
  shifts = np.stack(np.meshgrid(along, along, 0.0), axis=-1).reshape(-1, 3)
  sure = solids.Crowd(space, [there]).is_surely_met(box, shifts)
  met = [space.meet(box.moved(shift), there) is not None for shift in shifts]
  hypothesis.event(f'{sum(sure)} of {sum(met)}')
  assert (np.array(met) | ~sure).all()


def test_most_boxes_that_meet_do_so_for_sure():
  space, wall = solids.Space(_MODEL), _solid(_WALL, (0.0, 0.0), 0.5)
  shifts = np.random.default_rng(0).uniform(-1.5, 1.5, (1000, 3))
  sure = solids.Crowd(space, [wall]).is_surely_met(_box(), shifts)
  met = [space.meet(_box().moved(shift), wall) is not None for shift in shifts]
  assert 0.95 * sum(met) < sum(sure) <= sum(met)


@examples.settings(60)
@hypothesis.given(st.integers(2, 8), _places, _rotations)
def test_no_surface_is_missed(geom, place, turn):
  # The geoms stand in the middle of the model.
  model = copy.copy(_MODEL)
  quaternion = np.zeros(4)
  mujoco.mju_mat2Quat(quaternion, turn.ravel())
  model.geom_quat[geom] = quaternion
  model.geom_contype[:] = np.arange(model.ngeom) == geom
  model.geom_conaffinity[:] = 0
  space = solids.Space(model)
  points = np.array([(*place, 1.5), (place[0] + 0.2, place[1], 1.5)])
  shifts = np.array([[0.3 * x, 0.0, 0.0] for x in range(-6, 7)])
  may = space.may_carry(points, shifts)
  for shift, is_possible in zip(shifts, may, strict=True):
    is_carried = space.uncarried(points + shift, 5.0) is None
    assert is_possible or not is_carried


def test_the_model_stays_as_it_is():
  before = np.array(_MODEL.geom_size), np.array(_MODEL.geom_type)
  solids.Space(_MODEL).meet(_box(), _solid(4, (0.0, 0.3)))
  np.testing.assert_array_equal(_MODEL.geom_size, before[0])
  np.testing.assert_array_equal(_MODEL.geom_type, before[1])
