"""Tests for classes of objects: their registration, specs and rays."""

import copy
import pickle
from typing import Any

from dm_control import mjcf
from dm_env import specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.tasks import collect_apples
from tests import worlds

_GREY = (0.5, 0.5, 0.5, 1.0)
_RAYS = 'senses/ray_classes'


@pytest.fixture(name='classes')
def fixture_classes(monkeypatch: pytest.MonkeyPatch) -> None:
  """Removes the classes that a test registers."""
  monkeypatch.setattr(appearance, '_CLASSES', dict(appearance._CLASSES))


def _add_rock(arena: arenas.RoomArena) -> None:
  arena.mjcf_model.worldbody.add(
      'geom', type='box', size=(0.1, 1, 1), pos=(2, 0, 0),
      **appearance.geom_style('rock'),
  )  # fmt: skip


@pytest.mark.usefixtures('classes')
def test_a_world_with_a_new_class_has_the_bounds_of_others_and_lists_it():
  assert appearance.register('rock', code=31, rgba=_GREY) == 'rock'
  assert appearance.class_name(31) == 'rock'
  task = collect_apples.CollectApples('near')
  _add_rock(task.root_entity)
  env = suite.embed(task, 'instantaneous_reward', random=0)
  usual = suite.load('collect_apples', 'near', design='instantaneous_reward')
  spec, expected = (one.observation_spec() for one in (env, usual))
  assert spec == expected
  assert spec[_RAYS].codes == (*expected[_RAYS].codes, 31)
  observation = env.reset().observation
  while 31 not in observation[_RAYS]:
    # Turns until the rock is in view.
    observation = env.step(np.array([0, 0, 1, 0, 0, 0.0])).observation
  spec[_RAYS].validate(observation[_RAYS])


@pytest.mark.usefixtures('classes')
def test_a_class_of_a_default_is_listed():
  appearance.register('rock', code=30)
  appearance.register('moss', code=31)
  rocks = mjcf.RootElement(model='rocks')
  rocks.default.geom.user = [30]
  rocks.default.add('default', dclass='moss').geom.user = [31]
  arena = arenas.OpenRoom()
  arena.mjcf_model.attach(rocks)
  usual = appearance.listed_codes(arena.mjcf_model)
  assert usual == tuple(range(11))  # No geom yet.
  for dclass in (None, 'moss'):
    rocks.worldbody.add('geom', size=(0.1,), dclass=dclass)
  physics = worlds.compile_world(arena)
  assert {30, 31} < set(appearance.class_of_geoms(physics.model))
  assert appearance.listed_codes(arena.mjcf_model) == (*usual, 30, 31)


@pytest.mark.parametrize('domain', suite.TASKS_BY_DOMAIN)
def test_the_specs_of_all_worlds_have_the_same_classes(domain: str):
  env = suite.load(domain, suite.TASKS_BY_DOMAIN[domain][0], design=None)
  spec = env.observation_spec()[_RAYS]
  assert (spec.minimum, spec.maximum) == (0, appearance.CAPACITY - 1)
  # Those that each world lists, and then its own.
  assert spec.codes[:11] == tuple(range(11))
  # Rays report nothing else.
  assert set(appearance.class_of_geoms(env.physics.model)) <= set(spec.codes)
  env.close()


@pytest.mark.usefixtures('classes')
@pytest.mark.parametrize(
    ('name', 'code', 'rgba', 'message'),
    [
        ('wall', 31, None, "'wall': registered already, with code 2; must"),
        ('rock', 2, None, r"'rock': code 2 is that of 'wall'; .* \[21, 22, "),
        ('rock', 32, None, r"'rock': code 32; must be one of \[.*, 31\]$"),
        ('rock', True, None, r"'rock': code True; must be one of \["),
        ('rock', [11], None, r"'rock': code \[11\]; must be one of \["),
        ('rock', 21, (1, 1, 1, 2), 'must be four numbers from 0 to 1'),
        (7, 11, None, 'name 7; must be a non-empty string'),
    ],
)
def test_wrong_and_taken_names_codes_and_colours_are_refused(
    name: Any, code: Any, rgba: Any, message: str
):
  before = dict(appearance._CLASSES)
  with pytest.raises(errors.SpecError, match=f'^class of objects.*{message}'):
    appearance.register(name, code=code, rgba=rgba)
  assert appearance._CLASSES == before


def test_unknown_classes_are_refused():
  for find in (appearance.code, appearance.geom_style):
    with pytest.raises(errors.UnknownNameError, match="'rock' is unknown; kno"):
      find('rock')
  with pytest.raises(errors.UnknownNameError, match='code 30: unknown; known'):
    appearance.class_name(30)


def test_a_geom_of_a_class_without_a_colour_needs_one():
  with pytest.raises(errors.SpecError, match="'base_block': rgba None; must"):
    appearance.geom_style('base_block')
  style = appearance.geom_style('base_block', _GREY)
  assert style == {'user': [9], 'rgba': _GREY}


def test_a_spec_of_classes_is_copied_with_its_list():
  spec = appearance.ClassArray((3,), (0, 1, 31), 'rays')
  for same in (
      spec.replace(),
      spec.replace(name='rays'),
      copy.deepcopy(spec),
      pickle.loads(pickle.dumps(spec)),
  ):
    assert isinstance(same, appearance.ClassArray)
    assert repr(same) == repr(spec)
    assert (same.shape, same.dtype) == ((3,), np.int32)
    assert (same.codes, same.name) == ((0, 1, 31), 'rays')
  assert spec == specs.BoundedArray((3,), np.int32, 0, 31)
  assert spec.replace(name='other').name == 'other'
  # Codes that the world lacks are valid as well.
  spec.validate(np.array([0, 7, 31], np.int32))
  with pytest.raises(ValueError, match='not all within bounds'):
    spec.validate(np.array([0, 7, 32], np.int32))


def test_class_codes_never_change():
  # They are part of the observation.
  assert tuple(appearance.class_name(code) for code in range(11)) == (
      'nothing', 'other', 'wall', 'barrier', 'door', 'pad', 'pressed_pad',
      'apple', 'large_apple', 'base_block', 'offset_block',
  )  # fmt: skip
