"""A mechanism that is attached to an arena runs in an environment of Composer.

It gives the readings that an environment of this package gives, whether it is
attached before or after its siblings.
"""

from typing import Any, Literal

from dm_control import composer
from dm_control import mjcf
from dm_control.locomotion.arenas import floors
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.feedback import mechanisms
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.policies import random_keys
from tests.engine import helpers

_STEPS = 60
_ACTIONS = {'name': 'dmlab_like', 'version': 1}
_NUM_SUBSTEPS = 6


class _Noisy(providers.Provider):
  """Adds noise and the last reading of the agent to a measurement."""

  kind: Literal['composer_noisy'] = 'composer_noisy'

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape)

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: Any,
      key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:
    (measured,) = readings.values()
    seen = float(observation['registers/reward'])
    value = measured + 0.1 * seen + state % 2
    if 'noise' in self.reads[0]:
      value = value + random_keys.uniform(key)
    return dict.fromkeys(self.writes, value), state + 1


def _design(reads: str = 'place', **others: Any) -> dict[str, Any]:
  block = {'kind': 'two_block', 'range': [-20, 40]}
  behind = {'position': [1.6, 0.0], 'yaw': np.pi}
  return {
      'schema': 1,
      'name': 'pushed',
      'registers': {
          # The ram meets the offset block first, which each step writes.
          'reward': {**block, 'role': 'feedback', 'place': behind},
          reads: {**block, 'role': 'meter', 'place': [-1.0, 2.0]},
          'hits': {**block, 'role': 'meter', 'place': [-1.0, -2.0]},
      },
      'meters': [
          {
              'measures': {'kind': 'position', 'of': 'pusher/ram', 'axis': 'x'},
              'writes': reads,
          },
          {'measures': 'hits', 'writes': 'hits'},
      ],
      'providers': [
          {'kind': 'composer_noisy', 'reads': [reads], 'writes': ['reward']}
      ],
      **others,
  }


class _Pusher(composer.Entity):
  """A ram that pushes what is before it, and counts the substeps of contact."""

  def _build(self) -> None:
    self._root = mjcf.RootElement(model='pusher')
    body = self._root.worldbody.add('body', name='ram', pos=(0, 0, 0.15))
    body.add('geom', name='ram', type='sphere', size=(0.12,), mass=5.0)
    self.joint = body.add('joint', name='x', type='slide', axis=(1, 0, 0))
    self._root.actuator.add('motor', name='push', joint=self.joint)
    self.hits = 0

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._root

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.hits = 0

  def after_substep(self, physics: Any, random_state: Any) -> None:
    ram = physics.bind(self._root.find('geom', 'ram')).element_id
    self.hits += bool((physics.data.ptr.contact.geom == ram).any())


class _Push(composer.Task):
  """Pushes forward and backward."""

  def __init__(self, arena: composer.Entity, pusher: _Pusher) -> None:
    self._arena, self.pusher = arena, pusher
    self.set_timesteps(control_timestep=0.06, physics_timestep=0.01)

  @property
  def root_entity(self) -> composer.Entity:
    return self._arena

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    physics.set_control(action)

  def get_reward(self, physics: Any) -> float:
    return 0.0


def _actions() -> list[np.ndarray]:
  generator = np.random.default_rng(0)
  return [
      np.array([generator.uniform(0.0, 60.0) if i % 20 < 14 else -40.0])
      for i in range(_STEPS)
  ]


def _mechanism(
    design: Any, pusher: _Pusher, num_substeps: int | None = _NUM_SUBSTEPS
) -> mechanisms.FeedbackMechanism:
  return mechanisms.FeedbackMechanism(specs.load(design), num_substeps)


def _attached(
    design: Any, order: str, whole: bool, **kwargs: Any
) -> composer.Environment:
  """Returns an environment of Composer with an attached mechanism."""
  arena, pusher = floors.Floor(size=(8, 8)), _Pusher()
  mechanism = _mechanism(design, pusher)

  def attach() -> None:
    if whole:
      arena.attach(mechanism)
    else:
      mechanism.attach_to(arena)

  if order == 'before':
    attach()
  arena.attach(pusher)
  if order == 'after':
    attach()
  mechanism.connect({'hits': lambda physics: pusher.hits})
  return composer.Environment(
      _Push(arena, pusher), strip_singleton_obs_buffer_dim=True, **kwargs
  )


def _readings(env: composer.Environment, key: str) -> np.ndarray:
  """Returns the readings of two episodes, `(episodes, steps)`."""
  found = []
  for _ in range(2):
    time_steps = [env.reset()] + [env.step(action) for action in _actions()]
    found.append([float(one.observation[key]) for one in time_steps])
  return np.array(found)


@pytest.fixture(name='registered', autouse=True)
def fixture_registered():
  with helpers.registered(providers.PROVIDERS, 'composer_noisy', _Noisy):
    yield


@pytest.mark.parametrize(
    'schedule', ['cfmdp', {'meter_substep': 1, 'provider_substep': 5}], ids=str
)
def test_the_order_of_attachment_does_not_matter(schedule):
  design = _design(schedule=schedule)
  arena, pusher = floors.Floor(size=(8, 8)), _Pusher()
  arena.attach(pusher)
  engine = suite.embed(
      _Push(arena, pusher),
      design,
      random=1,
      measurements={'hits': lambda physics: pusher.hits},
  )
  expected = _readings(engine, 'registers/reward')
  corruption = np.abs(
      engine.mechanism.registers['reward'].inspect(engine.physics).permanent
  )
  assert corruption > 1.0
  assert np.ptp(expected) > 5.0
  for order, whole in (('before', True), ('after', False)):
    env = _attached(design, order, whole)
    found = _readings(env, 'feedback/reward')
    np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=order)


def test_noise_is_seeded_by_the_environment_and_does_not_change_its_episodes():
  def run(reads: str, order: str, seed: int) -> tuple[np.ndarray, Any]:
    env = _attached(_design(reads), order, True, random_state=seed)
    found = _readings(env, 'feedback/reward')
    return found, env.random_state.get_state()[1:]

  plain, state = run('place', 'after', 1)
  noisy, same = run('noise', 'after', 1)
  np.testing.assert_array_equal(state[0], same[0])
  assert state[1:] == same[1:]
  noise = noisy - plain
  assert np.abs(noise).max() > 0.1
  assert not np.allclose(noise[0], noise[1])
  np.testing.assert_allclose(run('noise', 'before', 1)[0], noisy, atol=1e-6)
  assert not np.allclose(run('noise', 'after', 2)[0], noisy)


def _query() -> dict[str, Any]:
  design = _design()
  design['registers']['hits']['role'] = 'query'
  return {**design, 'meters': design['meters'][:1]}


def _scored() -> dict[str, Any]:
  design = _design()
  design['meters'][1]['measures'] = 'score'
  return design


@pytest.mark.parametrize(
    ('make', 'need'),
    [
        (_query, "the query 'hits' of an action"),
        (
            _scored,
            'the score (mechanism.connect({"score": function}) offers one)',
        ),
    ],
)  # fmt: skip
def test_what_composer_does_not_pass_to_entities_is_refused(make, need):
  arena, pusher = floors.Floor(size=(8, 8)), _Pusher()
  arena.attach(pusher)
  arena.attach(_mechanism(make(), pusher))
  with pytest.raises(errors.SpecError) as caught:
    composer.Environment(_Push(arena, pusher))
  assert str(caught.value) == (
      f"design 'pushed' needs {need}, which entities of Composer do not get;"
      ' use suite.embed(task, design)'
  )


def test_the_number_of_substeps_has_to_be_known():
  arena, pusher = floors.Floor(size=(8, 8)), _Pusher()
  arena.attach(pusher)
  arena.attach(_mechanism(_design(), pusher, None))
  with pytest.raises(errors.SpecError, match='pass num_substeps=task'):
    composer.Environment(_Push(arena, pusher))


@pytest.mark.mujoco_warns('BADQPOS')
def test_a_failure_of_the_physics_ends_the_episode_as_in_composer():
  env = _attached(
      _design(), 'after', True, raise_exception_on_physics_error=False
  )
  env.reset()
  env.step([0.0])
  env.physics.bind(env.task.pusher.joint).qpos = 1e12
  assert env.step([0.0]).last()
  assert env.step([0.0]).first()
  assert np.isfinite(env.step([0.0]).observation['feedback/reward'])
