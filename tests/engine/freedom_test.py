"""Composer tasks that use their freedom are as free in this engine."""

from collections.abc import Callable
import gc
import itertools
from typing import Any
import weakref

from dm_control import composer
from dm_control.composer.variation import distributions
from dm_control.composer.variation import noises
from dm_control.entities import props
import mujoco
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import meters
from realab_suite.entities import registers
from realab_suite.entities import state
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from tests.engine import embedded
from tests.engine import helpers


class _Free(helpers.PointTask):
  """Changes something before each episode."""

  def __init__(
      self,
      change: Callable[[Any, int, Any], None],
      look: Callable[[Any, Any], Any],
  ) -> None:
    super().__init__()
    self.num_episodes = self.num_own = 0
    # What the change made of the world at the start of each episode.
    self.looks: list[Any] = []
    self.props: list[composer.Entity] = []
    self._change, self._look = change, look

  def initialize_episode_mjcf(self, random_state: Any) -> None:
    self._change(self, self.num_episodes, random_state)
    self.num_episodes += 1

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    super().initialize_episode(physics, random_state)
    self.looks.append(self._look(self, physics))

  def should_terminate_episode(self, physics: Any) -> bool:
    return bool(physics.time() > 0.6)

  def get_discount(self, physics: Any) -> float:
    return 0.9


def _timesteps(*steps: tuple[float, float]) -> Any:
  return (
      lambda task, episode, random_state: task.set_timesteps(*steps[episode]),
      lambda task, physics: task.physics_steps_per_control_step,
  )


def _change_props(task: _Free, episode: int, random_state: Any) -> None:
  for prop in task.props:
    prop.detach()
  task.props = [
      props.Primitive(
          geom_type='box', size=[0.05] * 3, name=f'box_{i}',
          pos=[random_state.uniform(0.2, 0.3), 0, 1],
      )
      for i in range(episode)
  ]  # fmt: skip
  for prop in task.props:
    prop.mjcf_model.size.nuserdata = 2
    task.root_entity.add_free_entity(prop)
    prop.observables.position.enabled = True


def _find_props(task: _Free, physics: Any) -> Any:
  boxes = physics.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
  return len(task.props), boxes.sum()


def _look_at_joint(task: _Free, physics: Any) -> float:
  return float(physics.bind(task.joint).damping[0])


def _add_motor(task: _Free, episode: int, random_state: Any) -> None:
  task.root_entity.mjcf_model.actuator.add(
      'motor', joint=task.joint, ctrllimited=True, ctrlrange=(-0.5, 0.5)
  )


def _set_delays(task: _Free, episode: int, random_state: Any) -> None:
  task.bead.configure(
      delay=[2, distributions.UniformInteger(0, 7), None][episode],
      buffer_size=[None, 3, 4][episode],
      update_interval=[3, None, distributions.UniformInteger(1, 4)][episode],
      corruptor=noises.Additive(distributions.Normal(scale=0.1)),
      aggregator=[None, 'max', lambda values: values.sum(axis=0)][episode],
  )
  task.secret.configure(enabled=episode == 1)


def _write_userdata(task: _Free, episode: int, random_state: Any) -> None:
  task.num_own = [1, 10, 1000][episode]
  task.root_entity.mjcf_model.size.nuserdata = task.num_own

  def write(physics: Any, random_state: Any) -> None:
    physics.data.userdata[: task.num_own] += 1.0

  task.end_step = write


def _write_in_steps(task: _Free, episode: int, random_state: Any) -> None:
  def write(physics: Any, random_state: Any) -> None:
    physics.model.opt.gravity[0] = random_state.uniform(-1, 1)
    physics.bind(task.joint).damping = random_state.uniform()

  task.begin = task.end_step = write


_FREEDOMS: dict[str, Any] = {
    'timesteps': _timesteps((0.02, 0.005), (0.02, 0.001), (0.1, 0.01)),
    'one substep': _timesteps((0.05, 0.01), (0.03, 0.03), (0.02, 0.01)),
    'props': (_change_props, _find_props),
    'motors': (_add_motor, lambda task, physics: physics.model.nu),
    'delays': (_set_delays, lambda task, physics: task.bead.update_interval),
    'userdata': (_write_userdata, lambda task, physics: task.num_own),
    'the model in an episode': (_write_in_steps, _look_at_joint),
}


@pytest.mark.parametrize('name', _FREEDOMS)
def test_a_free_task_equals_composer_bit_for_bit(name: str):
  made = []

  def make() -> composer.Task:
    made.append(_Free(*_FREEDOMS[name]))
    return made[-1]

  seen = embedded.assert_identical(make, num_steps=50, num_episodes=3)
  assert {1, 2} == {*seen}
  stock, ours = (task.looks for task in made)
  assert stock == ours
  assert all(a != b for a, b in itertools.pairwise(stock))


# Registers beside a task that changes its timesteps.

_FIXED = {'meter_substep': 2, 'provider_substep': 4}
_REFUSAL = 'schedule.provider_substep: 4 must be less than the 4 substeps'


def _slower() -> _Free:
  return _Free(*_timesteps((0.02, 0.001), (0.02, 0.005), (0.02, 0.02)))


def test_the_schedule_follows_the_substeps_of_each_episode():
  env, sink = helpers.embed(_slower(), helpers.SCORED, max_steps=10)
  schedules = []
  for _ in range(3):
    env.reset()
    while not env.step(np.zeros(1)).last():
      pass
    np.testing.assert_allclose(env.physics.time(), 0.2)
    schedule = env.schedule
    schedules.append((schedule.meter_substep, schedule.provider_substep))
  assert schedules == [(6, 13), (1, 2), (0, 0)]
  assert len(sink.requested('score')) == 30


def test_a_schedule_that_no_longer_fits_is_refused():
  design = {**helpers.SCORED, 'schedule': _FIXED}
  env, _ = helpers.embed(_slower(), design)
  env.reset()
  with pytest.raises(errors.SpecError, match=_REFUSAL):
    env.reset()


def _attached(num_substeps: int | None, **others: Any) -> Any:
  """Returns Composer's environment; 0 substeps for a function."""
  task = _slower()
  mechanism = mechanisms.FeedbackMechanism(
      specs.load({**helpers.SCORED, **others}),
      (lambda: task.physics_steps_per_control_step)
      if num_substeps == 0
      else num_substeps,
  )
  task.root_entity.attach(mechanism)
  mechanism.connect({'score': lambda physics: physics.time()})
  return composer.Environment(task), mechanism


def test_the_schedule_in_composer_follows_a_function():
  env, mechanism = _attached(0)
  for written in (0.006, 0.005, 0.0):
    env.reset()
    env.step(np.zeros(1))
    applied = mechanism.registers['score'].applied(env.physics)
    np.testing.assert_allclose(applied, written)


@pytest.mark.parametrize(
    ('num_substeps', 'schedule', 'message'),
    [
        (20, None, 'num_substeps: 20; must be 4, .* pass num_substeps=lambda'),
        (None, _FIXED, _REFUSAL),
        (0, _FIXED, _REFUSAL),
    ],
)
def test_a_schedule_that_does_not_fit_is_refused_in_composer(
    num_substeps: int | None, schedule: Any, message: str
):
  env, _ = _attached(num_substeps, schedule=schedule)
  env.reset()
  env.step(np.zeros(1))
  with pytest.raises(errors.SpecError, match=message):
    _ = env.reset(), env.step(np.zeros(1))


# Registers beside userdata of the task.


class _Owner(helpers.PointTask):
  """Keeps numbers in the userdata that a nested model declares."""

  def __init__(self, number: int) -> None:
    super().__init__()
    box = props.Primitive(geom_type='box', size=[0.1] * 3, pos=[0, 4, 1])
    box.mjcf_model.size.nuserdata = number
    self.root_entity.attach(box)
    self.number = number
    self.begin = lambda physics, random: self._set(physics, 7.0)
    self.end_step = lambda physics, random: self._set(physics, physics.time())

  def own(self, physics: Any) -> Any:
    return physics.data.userdata[: self.number]

  def _set(self, physics: Any, value: float) -> None:
    self.own(physics)[:] = value


def _attach_mechanism(task: _Owner) -> Any:
  spec = specs.load({**helpers.SCORED, 'schedule': 'cfmdp'})
  mechanism = mechanisms.FeedbackMechanism(spec)
  task.root_entity.attach(mechanism)
  mechanism.connect({'score': lambda physics: 3.0})
  return mechanism.registers['score']


def _attach_meter(task: _Owner) -> Any:
  register = registers.TwoBlockRegister(
      'score', value_range=(0, 20), scale=0.05, role='meter'
  )
  register.attach_to(task.root_entity, (2.0, -3.0))
  task.root_entity.attach(meters.Meter(lambda physics: 3.0, register))
  return register


@pytest.mark.parametrize('number', [1, 10, 256, 1000])
@pytest.mark.parametrize('attach', [_attach_mechanism, _attach_meter, None])
def test_userdata_of_a_task_and_slots_share_the_array(number: int, attach: Any):
  task = _Owner(number)
  if attach is None:
    env = suite.embed(
        task,
        helpers.SCORED,
        measurements={'three': lambda physics: 3.0},
        overrides=['meters.0.measures=three'],
    )
    register = env.mechanism.registers['score']
  else:
    register = attach(task)
    env = composer.Environment(task)
  for _ in range(3):
    env.reset()
    np.testing.assert_array_equal(task.own(env.physics), 7.0)
    for _ in range(4):
      env.step(np.zeros(1))
      np.testing.assert_array_equal(task.own(env.physics), env.physics.time())
      assert register.applied(env.physics) == 3.0
    assert env.physics.model.nuserdata == number + state.CAPACITY


def test_a_task_in_composer_may_change_its_userdata_beside_a_mechanism():
  task = _Free(*_FREEDOMS['props'])
  register = _attach_mechanism(task)
  env = composer.Environment(task)
  for number in range(3):
    env.reset()
    env.step(np.zeros(1))
    assert len(task.props) == number
    assert env.physics.model.nuserdata == state.CAPACITY + 2 * bool(number)
    assert register.applied(env.physics) == 3.0


# Observables and memory.


@pytest.mark.parametrize('is_early', [True, False])
def test_a_reading_that_is_disabled_stays_disabled(is_early: bool):
  task = helpers.PointTask()
  design = {**helpers.SCORED, 'schedule': 'cfmdp'}
  mechanism = mechanisms.FeedbackMechanism(specs.load(design))
  task.root_entity.attach(mechanism)
  mechanism.connect({'score': lambda physics: 0.0})
  reading = mechanism.observables.get_observable('reward')
  if is_early:
    reading.enabled = False
  env = composer.Environment(task)
  assert ('feedback/reward' in env.reset().observation) != is_early
  reading.enabled = False
  for _ in range(2):
    assert [*env.reset().observation] == ['bead']


def test_senses_follow_the_observables_of_an_episode():
  task = helpers.PointTask()
  env = suite.embed(task, 'none', random=1, max_steps=None)
  task.bead.enabled, task.secret.enabled = False, True
  assert [*env.reset().observation] == ['senses/secret']
  env = suite.embed(
      helpers.PointTask(), 'none', random=1, max_steps=None, senses=['bead']
  )
  env.task.bead.enabled = False
  with pytest.raises(errors.SpecError, match=r"senses: unknown .'bead'."):
    env.reset()


@pytest.mark.parametrize('num_steps', [0, 3])
def test_the_world_of_an_episode_is_freed_with_the_next_one(num_steps: int):
  env, _ = helpers.embed(helpers.PointTask(), helpers.SCORED)
  gc.disable()
  try:
    worlds = []
    for _ in range(3):
      env.reset()
      for _ in range(num_steps):
        env.step(np.zeros(1))
      parts = env._physics, env._physics.model, env._physics.data
      worlds.append([weakref.ref(part) for part in parts])
      del parts
    alive = [[part() is not None for part in world] for world in worlds]
  finally:
    gc.enable()
  assert alive == [[False] * 3, [False] * 3, [True] * 3]
