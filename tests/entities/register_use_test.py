"""Registers in foreign tasks and in the way of an avatar; their arguments."""

from dm_control import composer
import pytest

from realab_suite import errors
from realab_suite.entities import registers
from tests.entities import register_worlds


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


@pytest.mark.parametrize(
    ('argument', 'value'),
    [
        ('channel', 'secured'),
        ('dof', 'fixed'),
        ('role', 'reward'),
        ('value_range', (1.0, 1.0)),
        ('scale', 0.0),
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
