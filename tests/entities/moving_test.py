"""Parts that go where they are told, and that nothing can push."""

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import moving
from tests import worlds

_STYLE = appearance.geom_style(appearance.DOOR)
_BOX = {'type': 'box', 'size': (0.2, 1.0, 0.5), **_STYLE}


def _world(solid=True):
  arena = arenas.OpenRoom()
  part = moving.MovingPart('part', [dict(_BOX)], solid)
  part.attach_to(arena, (1.0, 0.0, 0.5))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, avatar)
  return physics, part, avatar


def _move(physics, part, position):
  physics.bind(part.frame).mocap_pos = position


def test_an_avatar_cannot_push_a_solid_part():
  physics, part, avatar = _world()
  worlds.act(avatar, physics, 200, forward=1.0)
  np.testing.assert_array_equal(
      physics.bind(part.geoms[0]).xpos, [1.0, 0.0, 0.5]
  )
  assert avatar.position(physics)[0] < 1.0 - 0.2 - 0.2


def test_an_avatar_walks_through_a_part_that_is_not_solid():
  physics, _, avatar = _world(solid=False)
  worlds.act(avatar, physics, 140, forward=1.0)
  assert avatar.position(physics)[0] > 2.0


def test_a_part_moves_on_command_until_a_reset():
  physics, part, _ = _world()
  geom = physics.bind(part.geoms[0])
  worlds.step(physics, 100)  # Gravity does nothing.
  np.testing.assert_array_equal(geom.xpos, [1.0, 0.0, 0.5])
  _move(physics, part, [0.0, 2.0, 0.5])
  worlds.step(physics)
  np.testing.assert_array_equal(geom.xpos, [0.0, 2.0, 0.5])
  with physics.reset_context():
    pass
  np.testing.assert_array_equal(geom.xpos, [1.0, 0.0, 0.5])


def test_a_part_can_only_be_attached_to_the_root_of_a_task():
  arena, cart = composer.Arena('arena'), composer.Arena('cart')
  arena.attach(cart)
  for part in (
      moving.MovingPart('part', [dict(_BOX)]), apple_group.Apples('part')
  ):  # fmt: skip
    with pytest.raises(
        errors.SpecError,
        match=r"^part: .* task, and 'cart' is attached to 'arena'",
    ):
      part.attach_to(cart, (0.0, 0.0, 0.0))
