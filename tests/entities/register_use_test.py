"""Registers in foreign tasks and in the way of an avatar; their arguments."""

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds
from tests.entities import register_worlds

# ---- In a task from outside the package --------------------------------------


class _WritingTask(composer.NullTask):
  """Writes to registers before each control step."""

  def __init__(self, root, written, values):
    super().__init__(root)
    self._written, self._values = written, iter(values)
    self.value = None
    self.set_timesteps(control_timestep=0.05, physics_timestep=0.005)

  def before_step(self, physics, action, random_state):
    self.value = next(self._values)
    for register in self._written:
      register.write(physics, self.value)


def _plain_arena() -> composer.Arena:
  """An arena of dm_control's own, with its options, and a floor."""
  arena = composer.Arena()
  arena.mjcf_model.worldbody.add('geom', type='plane', size=(9, 9, 0.1))
  return arena


@register_worlds.some_varieties
def test_registers_work_in_a_plain_composer_environment(variety):
  arena = _plain_arena()
  register = register_worlds.make(variety)
  register.attach_to(arena, (0.3, -0.2), 0.7)
  values = [
      0.0,
      register_worlds.LOW,
      register_worlds.HIGH,
      1.1,
      register_worlds.HIGH,
  ]
  task = _WritingTask(arena, [register], values * 2)
  register.observables.reading.enabled = True
  environment = composer.Environment(task, random_state=0)
  key = f'{register.name}/reading'
  for _ in range(2):
    timestep = environment.reset()
    assert timestep.observation[key] == pytest.approx(
        register_worlds.INITIAL, abs=register_worlds.ROUNDING
    )
    for _ in values:
      timestep = environment.step(environment.action_spec().generate_value())
      # Composer steps once with the forces from before the write.
      assert timestep.observation[key] == pytest.approx(task.value, abs=1e-6)


def test_the_reading_is_hidden_by_default():
  arena = _plain_arena()
  for i, variety in enumerate(register_worlds.VARIETIES):
    register_worlds.make(variety).attach_to(
        arena, (0.4 * i - 4.0, 0.0), variety.yaw
    )
  environment = composer.Environment(composer.NullTask(arena), random_state=0)
  assert environment.observation_spec() == {}


# ---- In the way of an avatar -------------------------------------------------


@register_worlds.some_varieties
def test_an_avatar_moves_blocks(variety):
  channel = variety.channel
  arena = arenas.OpenRoom()
  register = register_worlds.make(variety)
  register.attach_to(arena, (0.0, 0.0))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable(register.blocks)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  register.write(physics, 0.0)
  # Off centre, so that a block turns as well as slides.
  avatar.place(physics, (-1.0, 0.08), 0.0)
  worlds.step(physics)
  before = worlds.world_position(physics, register.blocks[0])
  read = register.read(physics)
  worlds.act(avatar, physics, 60, forward=1.0, grasp=1.0)
  moved = worlds.world_position(physics, register.blocks[0]) - before
  assert moved[0] > 0.2
  if channel == 'embedded':
    assert np.abs(register.read(physics) - read) > 0.05
  else:
    assert register.read(physics) == read


# ---- Arguments ---------------------------------------------------------------


@pytest.mark.parametrize(
    ('argument', 'value'),
    [
        ('channel', 'secured'),
        ('dof', 'fixed'),
        ('role', 'reward'),
        ('value_range', (1.0, 1.0)),
        ('value_range', (0.0, np.nan)),
        ('scale', 0.0),
        ('scale', 11.0),
        ('initial', 9.0),
        ('mass', 0.001),
        ('colour', 'red'),
    ],
)
def test_an_argument_that_makes_no_sense_is_refused(argument, value):
  arguments = {'value_range': (0.0, 1.0), argument: value}
  for kind in register_worlds.KINDS.values():
    with pytest.raises(errors.SpecError, match='register_1'):
      kind('register_1', **arguments)


def test_a_range_of_more_than_a_turn_is_rejected():
  with pytest.raises(errors.SpecError, match=r'angle.*\[0.0, 4.0\]'):
    registers.BlockOrientationRegister(
        'angle', value_range=(0.0, 4.0), scale=1.0
    )
