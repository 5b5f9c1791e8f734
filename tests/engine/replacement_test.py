"""Registers are moved out of the way of what an episode puts into the world."""

from typing import Any

from dm_control import composer
import numpy as np
import pytest

from realab_suite.engine import clearance
from tests.engine import helpers

_REGISTER = {
    'kind': 'two_block', 'role': 'feedback', 'initial': 0, 'place': [0.0, 0.0],
    'range': [-2, 4],
}  # fmt: skip
# Middle and half size of a wall.
_ACROSS = ((0.3, 0.0, 0.5), (0.05, 1.5, 0.5))
_ALL_OVER = ((0.0, 0.0, 0.5), (1.9, 1.9, 0.5))
_FAR = ((0.0, 1.8, 0.5), (1.0, 0.1, 0.5))


class _Generated(helpers.PointTask):
  """A task whose arena has other walls in each episode."""

  def __init__(self, *walls: Any, floor: Any = (0.0, 2.0, 0.0)) -> None:
    super().__init__()
    self._walls = list(walls)
    body = self.root_entity.mjcf_model.worldbody
    x, half, height = floor
    body.add('geom', type='plane', size=(half, 2, 1), pos=(x, 0, height))
    self._generated = body.add('body', name='generated')

  def initialize_episode_mjcf(self, random_state: Any) -> None:
    self._generated.geom.clear()
    for middle, half in self._walls.pop(0):
      self._generated.add('geom', type='box', pos=middle, size=half)


def _design(channel: str = 'embedded', **registers: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'd',
      'channel': channel,
      'registers': registers or {'r': _REGISTER},
  }


def _places(env: Any) -> np.ndarray:
  """Returns the positions of all blocks, `(blocks, 3)`, in m."""
  return np.array(
      [
          env.physics.bind(block.geom).xpos
          for register in env.mechanism.registers.values()
          for block in register.blocks
      ]
  )


def _depth(env: Any) -> float:
  """Returns the depth of the deepest contact of a block, in m."""
  contact = env.physics.data.ptr.contact
  own = {
      int(env.physics.bind(block.geom).element_id)
      for register in env.mechanism.registers.values()
      for block in register.blocks
  }
  return max(
      (
          float(-distance)
          for distance, geoms in zip(contact.dist, contact.geom, strict=True)
          if own & set(geoms.tolist())
      ),
      default=0.0,
  )


@pytest.mark.parametrize('channel', ['embedded', 'secure'])
def test_a_register_makes_way_for_a_wall_and_returns(channel: str):
  env, sink = helpers.embed(
      _Generated([], [_ACROSS], [_FAR]), _design(channel), max_steps=3
  )
  found = []
  for _ in range(3):
    readings = [env.reset().observation['registers/r']]
    found.append(_places(env))
    (register,) = env.mechanism.registers.values()
    for value in (-2.0, 4.0):
      register.write(env.physics, value)
      env.physics.forward()
      assert _depth(env) < clearance.TOLERANCE
      np.testing.assert_allclose(register.read(env.physics), value)
      assert register.obstruction(env.physics) == 0.0
    np.testing.assert_allclose(readings, 0.0, atol=1e-9)
  home, moved, back = found
  np.testing.assert_array_equal(back, home)
  shift = moved - home
  # As a whole, and no farther than needed: from beside the wall's face.
  np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape))
  assert 0.0 < np.linalg.norm(shift[0]) < 0.75
  assert shift[0][2] == pytest.approx(0.0, abs=1e-9)
  assert len(sink.starts) == 3


@pytest.mark.parametrize('other', [(-0.85, 0.0), (0.9, 0.0)])
def test_a_register_that_is_moved_does_not_meet_another_one(other: Any):
  wall = ((0.6, 0.0, 0.5), (0.9, 1.7, 0.5))
  second = _REGISTER | {'place': list(other)}
  env, _ = helpers.embed(
      _Generated([wall], floor=(-0.5, 2.2, 0.0)),
      _design(one=_REGISTER, two=second),
  )
  env.reset()
  reaches = []
  for register in env.mechanism.registers.values():
    ends = []
    for value in (-2.0, 4.0):
      register.pose(env.physics, value)
      ends += [env.physics.bind(b.geom).xpos.copy() for b in register.blocks]
    reaches.append((np.min(ends, axis=0) - 0.1, np.max(ends, axis=0) + 0.1))
  (low, high), (other_low, other_high) = reaches
  assert ((high < other_low) | (other_high < low)).any()


def test_a_register_over_a_gap_is_moved_to_a_platform():
  platform = ((-3.0, 0.0, -0.1), (2.0, 2.0, 0.1))
  beside = ((-2.3, -1.0, 0.5), (0.03, 0.4, 0.5))
  env, _ = helpers.embed(
      _Generated([platform, beside], floor=(0.0, 2.0, -9.0)),
      _design(r=_REGISTER | {'range': [-6, 6]}),
      max_steps=3,
  )
  env.reset()
  (register,) = env.mechanism.registers.values()
  for value in (-6.0, 6.0):
    register.write(env.physics, value)
    assert register.obstruction(env.physics) == 0.0
    assert (_places(env)[:, 0] + 0.1 <= -1.0).all()
  # A block that an agent has put in front of a wall is not written into it.
  base, offset = register.blocks
  offset.put(env.physics, [-1.9, -1.0, offset.position(env.physics)[2]])
  in_the_wall = (-2.3 - base.along(env.physics)) / register.scale
  register.write(env.physics, in_the_wall)
  assert abs(float(register.obstruction(env.physics))) > 0.5


def test_an_episode_without_a_clear_place_is_refused_with_the_remedy():
  env, _ = helpers.embed(
      _Generated(*[[_ALL_OVER]] * 10), _design(), max_steps=3
  )
  with pytest.raises(
      composer.EpisodeInitializationError,
      match=r"register 'r' has no clear place .*reduce its range",
  ):
    env.reset()
