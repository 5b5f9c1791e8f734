"""A register and a meter in a task of dm_control's own (F13, G1, M1)."""

from dm_control import composer
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import jumping_ball
import numpy as np
import pytest

from realab_suite.entities import avatars
from realab_suite.entities import meters
from realab_suite.entities import rays
from realab_suite.entities import registers


class _MeteredGoToTarget(go_to_target.GoToTarget):
  """`GoToTarget` that keeps how far the ball has come in a register."""

  def __init__(self, channel, dof):
    walker = jumping_ball.JumpingBallWithHead()
    arena = floors.Floor(size=(8, 8))
    super().__init__(walker=walker, arena=arena)
    self.register = registers.TwoBlockRegister(
        'distance',
        value_range=(0, 20),
        role='meter',
        channel=channel,
        dof=dof,
    )
    self.register.attach_to(arena, (5.0, 5.0), 0.7)
    self.meter = meters.Meter(self._distance, self.register)
    self.rays = rays.RaySense(num_rays=3)
    arena.attach(
        self.rays, arena.mjcf_model.worldbody.add('site', pos=(3.5, 5, 0.15))
    )
    self.rays.observables.enable_all()
    self.register.observables.reading.enabled = True
    self.measured = None

  def _distance(self, physics):
    place = physics.bind(self._walker.root_body).xpos
    return np.linalg.norm(place[..., :2], axis=-1)

  def before_step(self, physics, action, random_state):
    super().before_step(physics, action, random_state)
    self.measured, _ = self.meter.update(physics)


@pytest.mark.parametrize(
    ('channel', 'dof', 'recompile'),
    [
        ('embedded', 'free', True),
        ('embedded', 'planar', True),
        ('secure', 'planar', False),
    ],
)
def test_a_meter_works_in_a_task_of_dm_controls_own(channel, dof, recompile):
  task = _MeteredGoToTarget(channel, dof)
  environment = composer.Environment(
      task, random_state=0, recompile_mjcf_every_episode=recompile
  )
  spec = environment.action_spec()
  measurements = []
  for _ in range(2):
    timestep = environment.reset()
    assert timestep.observation['distance/reading'] == pytest.approx(0.0)
    # The sense is mounted on the world, so it sees the world's own geoms too.
    assert (timestep.observation['rays/distances'] > 0).all()
    for _ in range(10):
      timestep = environment.step(np.full(spec.shape, 0.5))
      assert timestep.observation['distance/reading'] == pytest.approx(
          float(task.measured), abs=1e-5
      )
      measurements.append(float(task.measured))
  assert max(measurements) > min(measurements)


def test_an_avatar_works_in_an_arena_of_dm_controls_own():
  class Task(composer.NullTask):
    """Walks ahead."""

    def __init__(self):
      super().__init__(floors.Floor(size=(8, 8)))
      self.avatar = avatars.Avatar()
      self.root_entity.attach(self.avatar)
      self.block = registers.BlockPositionRegister('block', value_range=(-9, 9))
      self.block.attach_to(self.root_entity, (1.0, 0.0))
      self.avatar.make_graspable(self.block.blocks)
      self.set_timesteps(control_timestep=0.1, physics_timestep=0.01)

    def action_spec(self, physics):
      return self.avatar.action_spec

    def before_step(self, physics, action, random_state):
      self.avatar.apply_action(physics, action)

  task = Task()
  environment = composer.Environment(task, random_state=0)
  environment.reset()
  action = np.zeros(6)
  action[0] = 1.0
  for _ in range(10):
    environment.step(action)
  assert task.avatar.velocity(environment.physics)[0] == pytest.approx(
      2.0, rel=0.1
  )
  assert float(task.block.read(environment.physics)) > 3.0
