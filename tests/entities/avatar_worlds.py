"""An avatar with a register before it, compiled once for all tests."""

import functools

import mujoco
import numpy as np

from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds

SPEED, TURN_RATE = 2.0, 3.0
GRIP_HEIGHT = 0.2
# Where the hand is, before the avatar, metres.
HAND = 0.45


class World:
  """An avatar at the origin and, one metre ahead, blocks."""

  def __init__(
      self,
      kind=registers.BlockPositionRegister,
      barrier=None,
      yaw=0.0,
      **options,
  ):
    self.arena = arenas.OpenRoom()
    if barrier is not None:
      self.arena.add_barrier('barrier', *barrier)
    self.register = kind(
        'register', value_range=(-30, 30), scale=0.1, **options
    )
    self.register.attach_to(self.arena, (1.0, 0.0), yaw)
    self.avatar = avatars.Avatar()
    self.arena.attach(self.avatar)
    self.avatar.make_graspable(self.register.blocks)
    worlds.fit_substeps(self.arena, self.register.blocks)
    self.physics = worlds.compile_world(self.arena)
    self.restart()

  def restart(self):
    worlds.start_episode(self.physics, self.register)

  def place(self, x, y, heading=0.0):
    self.avatar.place(self.physics, (x, y), heading)
    self.physics.forward()

  def act(self, steps, **commands):
    worlds.act(self.avatar, self.physics, steps, **commands)

  def grasp(self):
    """Takes hold of the first block, and waits until it is in the hand."""
    x, y, _ = self.block
    self.place(x - 0.6, y)
    self.act(50, grasp=1.0)
    assert self.holding

  @property
  def block(self):
    return worlds.world_position(self.physics, self.register.blocks[0])

  @property
  def hand(self):
    heading = self.avatar.direction(self.physics)
    place = self.avatar.position(self.physics) + HAND * heading
    return np.array([*place, GRIP_HEIGHT])

  @property
  def holding(self):
    return bool(self.avatar.holding(self.physics))

  @property
  def velocity(self):
    return self.avatar.velocity(self.physics)

  @property
  def fastest(self):
    """The speed of whatever is fastest, metres per second."""
    speeds = [np.linalg.norm(self.velocity[:2])]
    for block in self.register.blocks:
      twist = np.zeros(6)
      mujoco.mj_objectVelocity(
          self.physics.model.ptr,
          self.physics.data.ptr,
          mujoco.mjtObj.mjOBJ_BODY,
          worlds.body_of(self.physics, block),
          twist,
          0,
      )
      speeds.append(np.linalg.norm(twist[3:]))
    return max(speeds)


_compiled = functools.cache(World)


def make(*arguments, **options):
  """Returns the world with these options, at its beginning."""
  world = _compiled(*arguments, **options)
  world.restart()
  return world
