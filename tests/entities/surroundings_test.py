"""Tests of the boxes of movers, which are kept while nothing has turned."""

from dm_control import mjcf
import numpy as np

from realab_suite.entities import rotations
from realab_suite.entities import surroundings

_ORIGIN = np.array([1.0, -2.0, 0.5])
_AXES = surroundings.matrix(rotations.quaternion_of(0.3))


def _movers() -> surroundings.Movers:
  """Returns a mover with two boxes, and one with a cylinder."""
  root = mjcf.RootElement()
  door = root.worldbody.add('body', name='door', mocap='true')
  for i, along in enumerate((-0.5, 0.7)):
    door.add(
        'geom', name=f'leaf{i}', type='box', size=(0.5, 0.1, 0.4),
        pos=(along, 0.2, 0.0),
    )  # fmt: skip
  post = root.worldbody.add('body', name='post', mocap='true')
  post.add('geom', name='post', type='cylinder', size=(0.1, 0.3))
  model = mjcf.Physics.from_mjcf_model(root).model
  return surroundings.Movers(model, [door, post], _ORIGIN, _AXES)


def test_boxes_follow_turns_and_numbers_of_worlds() -> None:
  kept = _movers()
  draw = np.random.default_rng(0)
  straight = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
  turned = np.stack([rotations.quaternion_of(angle) for angle in (0.4, -1.0)])
  both = np.stack([turned, straight])
  one = turned[np.newaxis]
  for quaternions in (
      straight, straight, turned, turned, one, turned, both, both, straight,
  ):  # fmt: skip
    positions = draw.uniform(-3.0, 3.0, (*quaternions.shape[:-1], 3))
    found = kept.at(positions, quaternions)
    expected = _movers().at(positions, quaternions)
    for name in ('centres', 'rotations', 'halves', 'is_exact', 'low', 'high'):
      np.testing.assert_array_equal(
          getattr(found, name), getattr(expected, name), strict=True
      )


def test_boxes_that_were_returned_stay_where_they_were() -> None:
  movers = _movers()
  straight = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
  before = movers.at(np.zeros((2, 3)), straight)
  low = before.low.copy()
  after = movers.at(np.ones((2, 3)), straight)
  np.testing.assert_array_equal(before.low, low)
  np.testing.assert_allclose(after.low - low, (np.ones((3, 3)) @ _AXES))
