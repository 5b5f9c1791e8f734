"""Footprints of kinds that declare none: few lines, which miss no pose."""

import itertools

import numpy as np
import pytest

from realab_suite.entities.registers import footprints

_SEGMENTS = footprints.NUM_VALUES - 1


class _Block:
  """A block whose pose is any function of the value."""

  def __init__(self, pose_of):
    self._pose_of = pose_of
    self.put(0.0)

  def put(self, value):
    self._pose = np.array(self._pose_of(value), float)

  def position(self, physics):
    return self._pose[:3]

  def heading(self, physics):
    return np.arctan2(np.sin(self._pose[3]), np.cos(self._pose[3]))


_MOTIONS = {
    'a line': (lambda x: (0.3 + 0.1 * x, -0.7 * x, 0.1, 0.5), 1),
    'rest': (lambda x: (1.0, 2.0, 0.1, 0.5), 1),
    'turns on the spot': (lambda x: (1.0, 2.0, 0.1, 2.0 * x), 1),
    'to and fro': (lambda x: (abs(x), 0.0, 0.1, 0.0), 2),
    'a line, then rest': (lambda x: (min(x, 0.0), 0.0, 0.1, 0.0), 2),
    'turns and moves': (lambda x: (x, 0.0, 0.1, 0.3 * x), _SEGMENTS),
    'a circle': (lambda x: (np.cos(x), np.sin(x), 0.1, 0.0), _SEGMENTS),
    'a slow curve': (lambda x: (x, 1e-3 * x * x, 0.1, 0.0), _SEGMENTS),
}


@pytest.mark.parametrize(
    ('pose_of', 'num_paths'), _MOTIONS.values(), ids=list(_MOTIONS)
)
def test_steps_along_one_line_are_one_path(pose_of, num_paths):
  block, other = _Block(pose_of), _Block(_MOTIONS['a line'][0])

  def pose(value):
    block.put(value)
    other.put(value)

  paths = footprints.sampled(None, [block, other], (-4.0, 4.0), pose)
  assert [path.block for path in paths] == [0] * num_paths + [1]
  # The paths follow each other, and each pose is where its value is on one.
  for one, following in itertools.pairwise(paths[:-1]):
    assert one.values[1] == following.values[0]
    np.testing.assert_array_equal(one.last, following.first)
  for value in np.linspace(-4.0, 4.0, footprints.NUM_VALUES):
    path = next(p for p in paths if p.values[0] <= value <= p.values[1])
    block.put(value)
    centre, turn = (
        [np.interp(value, path.values, ends) for ends in np.transpose(pair)]
        for pair in (
            [path.first, path.last],
            np.reshape(path.headings, (2, 1)),
        )
    )
    np.testing.assert_allclose(centre, block.position(None), atol=1e-5)
    beside = np.array(turn) - block.heading(None)
    np.testing.assert_allclose(np.sin(beside / 2), 0.0, atol=1e-5)
