"""A task is embedded as a whole, once, or not at all."""

from typing import Any

from dm_control import composer
from dm_control import suite as dm_suite
from dm_control.composer import environment as composer_environment
from dm_control.entities import props
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.tasks import collect_apples
from realab_suite.tasks import unlock_door
from tests.engine import helpers

_TASKS = {
    'a world of the suite': lambda: unlock_door.UnlockDoor('near'),
    'a foreign task': helpers.PointTask,
}
_IDS = [*_TASKS]
_PLACES = {
    'registers.reward.place': '[2, 2]',
    'registers.score.place': '[1.2, -3]',
}
_APART = tuple(f'{key}={value}' for key, value in _PLACES.items())


def _embed(task: Any, *overrides: str) -> Any:
  return suite.embed(
      task,
      'instantaneous_reward',
      random=3,
      max_steps=20,
      overrides=(*_APART, *overrides),
  )


@pytest.mark.parametrize(
    ('name', 'is_closed', 'design'),
    [
        ('a world of the suite', False, 'none'),
        ('a foreign task', True, 'instantaneous_reward'),
    ],
)
def test_a_task_cannot_be_embedded_twice(
    name: str, is_closed: bool, design: str
):
  task = _TASKS[name]()
  first = _embed(task)
  first.reset()
  if is_closed:
    first.close()
  with pytest.raises(errors.SpecError, match='the registers of') as caught:
    suite.embed(task, design, overrides=['channel=secure'])
  assert "design 'instantaneous_reward'" in str(caught.value)
  if not is_closed:
    assert first.step(helpers.no_op(first)).mid()
    first.close()


def test_an_embedded_task_in_another_environment_is_refused():
  env = _embed(helpers.PointTask())
  env.reset()
  composer.Environment(env.task)
  with pytest.raises(errors.SpecError, match='the task is in two environments'):
    env.step(helpers.no_op(env))
  assert env.step(helpers.no_op(env)).first()
  assert env.step(helpers.no_op(env)).mid()


# Problems that come up when the design is attached, connected, compiled and
# placed.
_BAD = {
    'no such place': 'registers.score.place=nowhere',
    'no such measurement': 'meters.0.measures=nothing',
    'no such schedule': 'schedule={meter_substep: 90, provider_substep: 95}',
    "in each other's way": 'registers.score.place=[2, 2]',
    'no such elements': 'action_set={name: dmlab_like, version: 1}',
}


# The worlds of the suite have the elements.
@pytest.mark.parametrize(
    ('name', 'bad', 'twin'),
    [
        (
            _IDS[bad == 'no such elements' or i % 2],
            bad,
            f'channel={("embedded", "secure")[i % 2]}',
        )
        for i, bad in enumerate(_BAD)
    ],
)
def test_a_design_that_is_refused_leaves_nothing_behind(
    name: str, bad: str, twin: str
):
  make = _TASKS[name]
  task = make()
  with pytest.raises(errors.SpecError):
    _embed(task, twin, _BAD[bad])
  env, clean = _embed(task, twin), _embed(make(), twin)
  for action in helpers.random_actions(env, 30):
    expected = helpers.to_bytes(clean.step(action))
    assert helpers.to_bytes(env.step(action)) == expected


# Hooks.


_NEVER = {
    'initialize_episode_mjcf', 'after_compile', 'before_substep',
    'after_substep',
}  # fmt: skip


@pytest.mark.parametrize('make', _TASKS.values(), ids=_TASKS)
def test_an_extra_hook_is_called_or_refused(make: Any):
  env = _embed(make())
  heard = []
  is_ours = isinstance(env.task, unlock_door.UnlockDoor)
  allowed = {*composer_environment.HOOK_NAMES} - (_NEVER if is_ours else set())
  for name in composer_environment.HOOK_NAMES:
    if name in allowed:
      env.add_extra_hook(name, lambda *unused, name=name: heard.append(name))
    else:
      with pytest.raises(errors.SpecError, match=name):
        env.add_extra_hook(name, print)
  env.reset()
  env.step(helpers.no_op(env))
  assert {*heard} == allowed


_REFUSED = ('initialize_episode_mjcf', 'before_substep', 'after_substep')


def test_a_task_of_this_package_with_a_hook_that_is_never_called_is_refused():
  for name in _REFUSED:
    hook = {name: lambda *unused: None}
    task_class = type('Mazy', (_Sensing,), hook)
    with pytest.raises(
        errors.SpecError, match=rf'Mazy\.{name} is never called'
    ):
      _embed(task_class())
  task = unlock_door.UnlockDoor()
  entity_class = type('Prop', (props.Primitive,), hook)
  task.root_entity.attach(entity_class(geom_type='box', size=(0.1, 0.1, 0.1)))
  with pytest.raises(errors.SpecError, match=rf'Prop\.{name} is never called'):
    _embed(task)


def test_every_other_hook_of_a_task_of_this_package_is_called():
  names = {*composer_environment.HOOK_NAMES} - {*_REFUSED}
  heard = []

  def make_hook(name: str) -> Any:
    def hook(self: Any, *arguments: Any) -> None:
      heard.append(name)
      getattr(super(task_class, self), name)(*arguments)

    return hook

  hooks = {name: make_hook(name) for name in names}
  task_class = type('Hearing', (_Sensing,), hooks)
  env = _embed(task_class())
  env.reset()
  env.step(helpers.no_op(env))
  assert {*heard} == names


def test_a_batch_refuses_an_environment_with_extra_hooks():
  env = _embed(unlock_door.UnlockDoor())
  env.add_extra_hook('after_step', lambda physics, random_state: None)
  env.reset()
  with pytest.raises(errors.SpecError, match='add_extra_hook'):
    batch_environment.BatchEnvironment(env, 2)


# Senses.


class _Sensing(collect_apples.CollectApples):
  """Senses something else than it says."""

  change: Any = None

  def senses(self, physics: Any, names: Any) -> dict[str, np.ndarray]:
    senses = super().senses(physics, names)
    if self.change is not None:
      self.change(senses)
    return senses


_CHANGES = {
    'one too many': lambda s: s.update(score=np.zeros(1)),
    'one too few': lambda s: s.pop('holding'),
    'another shape': lambda s: s.update(holding=np.zeros(2, np.float32)),
    'another type': lambda s: s.update(holding=s['holding'].astype(float)),
    'no array': lambda s: s.update(holding=0.0),
}


@pytest.mark.parametrize('is_batch', [False, True])
def test_senses_that_do_not_fit_their_spec_are_refused(is_batch: bool):
  task = _Sensing()
  env = suite.embed(task, 'none', random=1)
  if is_batch:
    env = batch_environment.BatchEnvironment(env, 2)
  env.reset()
  for change in _CHANGES.values():
    task.change = change
    with pytest.raises(errors.SpecError, match=r'_Sensing\.senses'):
      env.reset()


@pytest.mark.parametrize(
    ('make', 'hint'),
    [
        (lambda: composer.Environment(helpers.PointTask()), 'pass its `.task`'),
        (lambda: _Wrapper(_embed(helpers.PointTask())), 'pass its `.task`'),
        (lambda: helpers.PointTask, 'this is a class: pass an instance'),
        (lambda: dm_suite.load('cartpole', 'swingup'), 'are no Composer tasks'),
        (
            lambda: dm_suite.load('cartpole', 'swingup').task,
            'are no Composer tasks',
        ),
        (lambda: _Wrapper(None), 'must be a Composer task'),
    ],
)
def test_another_thing_than_a_task_is_refused_with_a_hint(make: Any, hint: str):
  with pytest.raises(errors.SpecError, match=f'{hint}$'):
    _embed(make())


class _Wrapper:
  """Keeps an environment as wrappers do."""

  def __init__(self, env: Any) -> None:
    self.env = env
