"""Senses of a provider's own: what it gets, and who never sees it."""

from collections.abc import Iterator
from typing import Any, Literal, final
from unittest import mock

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.entities import cameras
from realab_suite.entities import rays
from realab_suite.entities import registers
from realab_suite.evaluation import actors
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.feedback.providers import demonstration
from realab_suite.feedback.providers import paired_advice
from realab_suite.lab.verdicts import obstacles
from realab_suite.testing import providers as contract
from tests import registries
from tests.engine import helpers

_WORLDS = {
    domain: (domain, 'standard' if 'standard' in tasks else tasks[0])
    for domain, tasks in suite.TASKS_BY_DOMAIN.items()
}
_OWN = 'providers.0.senses=own'
_SOLVER = ('providers.0.policy=solver', _OWN)
_APPROVAL = ('providers.0.value_function=solver_approval', _OWN)
_SEEN: list[dict[str, np.ndarray]] = []


@final
class Looking(providers.Provider):
  """Writes 5 if it sees the agent, and otherwise 1; keeps what it sees."""

  kind: Literal['test_looking'] = 'test_looking'
  looks_for: str = 'is_seen'
  also: providers.base.Names = ()

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self.also

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    return (self.looks_for,) if self.looks_for else ()

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:  # fmt: skip
    _SEEN.append({name: np.array(one) for name, one in observation.items()})
    seen = observation.get(f'privileged/{self.looks_for}', episode_start)
    sees = np.reshape(seen, (*np.shape(episode_start), -1)).any(axis=-1)
    return {'reward': np.where(sees, 5.0, 1.0)}, state


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
  _SEEN.clear()
  with registries.preserved():
    providers.PROVIDERS.add('test_looking')(Looking)
    yield


def _looking(**options: Any) -> dict[str, Any]:
  provider = {'kind': 'test_looking', 'senses': 'own', **options}
  return helpers.one_register(
      'reward', [{**provider, 'writes': ['reward']}], role='feedback',
      range=[-9, 9], scale=0.1,
  )  # fmt: skip


def _load(
    names: tuple[str, str], senses: Any, design: Any, overrides: Any = (),
    num_envs: int = 0, **options: Any,
) -> Any:  # fmt: skip
  options |= {} if senses is None else {'senses': senses}
  load = suite.load_batch if num_envs else suite.load
  more = {'num_envs': num_envs} if num_envs else {}
  return load(
      *names, {'random': 4}, options, design=design, overrides=overrides, **more
  )


@pytest.mark.parametrize('domain', _WORLDS)
def test_a_solver_demonstrates_to_an_agent_that_senses_less(domain):
  world = _WORLDS[domain]
  env = _load(world, ['heading'], 'online_imitation', _SOLVER)
  full = _load(world, None, 'online_imitation', _SOLVER)
  solver = actors.PolicyActor(policies.make(env.task.SOLVER), full)
  given, seen = env.reset(), full.reset()
  for _ in range(12):
    action = solver.act(seen)
    given, seen = env.step(action), full.step(action)
    # What the solver would do in the state that the agent acted on.
    label = float(given.observation['registers/demonstration'])
    assert label == pytest.approx(int(action), abs=1e-6)
    assert given.observation.keys() == env.observation_spec().keys()
    assert given.observation.keys() == {
        'senses/heading', 'registers/demonstration'
    }  # fmt: skip
    for key, value in given.observation.items():
      assert value.tobytes() == seen.observation[key].tobytes()


def test_a_batch_gives_what_single_worlds_give():
  arguments = _WORLDS['gates'], ['velocity'], 'value_advice', _APPROVAL
  batch = _load(*arguments, num_envs=3, max_steps=5)
  alone = [_load(*arguments, world=i, max_steps=5) for i in range(3)]
  rng = np.random.default_rng(0)
  batch.reset()
  for env in alone:
    env.reset()
  for _ in range(13):  # Two ends of episodes.
    actions = rng.integers(0, 14, (3, 2)).astype(np.int32)
    together = batch.step(actions)
    for i, env in enumerate(alone):
      single = env.step(actions[i])
      assert together.observation.keys() == single.observation.keys()
      for key, value in single.observation.items():
        assert together.observation[key][i].tobytes() == value.tobytes()


def test_an_agent_with_a_camera_is_advised_and_evaluated():
  drawn = np.zeros((64, 64, 3), np.uint8)
  with (
      mock.patch.object(cameras, 'render', side_effect=lambda *_: drawn) as eye,
      mock.patch.object(
          rays.RaySense, 'sense', autospec=True, side_effect=rays.RaySense.sense
      ) as cast,
  ):
    env = _load(
        ('unlock_door', 'near'), ['camera'], 'online_imitation', [_OWN],
    )  # fmt: skip
    env.reset()
    assert (eye.call_count, cast.call_count) == (1, 0)
    for _ in range(4):
      env.step(np.int32(0))
    # Once a step for the agent, and once a step for the provider.
    assert (eye.call_count, cast.call_count) == (5, 4)
  both = _load(('unlock_door', 'near'), None, 'online_imitation', [_OWN])
  with mock.patch.object(
      rays.RaySense, 'sense', autospec=True, side_effect=rays.RaySense.sense
  ) as cast:
    both.reset()
    both.step(np.int32(0))
    assert cast.call_count == 2  # The agent's rays serve the provider, too.


_SECRETS = (
    'privileged',
    'things',
    'values',
    'codes',
    'ray_',
    'ideal',
    'is_seen',
)


@pytest.mark.parametrize('num_envs', [0, 2])
def test_no_door_shows_what_a_provider_senses(num_envs):
  overrides = ['providers.0.also=[ray_distances, time_left, camera]']
  design = specs.load(_looking(), overrides)
  arguments = ('supervised_room', 'standard'), ['pitch', 'holding'], design
  drawn = np.zeros((*([num_envs] if num_envs else []), 64, 64, 3), np.uint8)
  with mock.patch.object(cameras, 'render', side_effect=lambda *_: drawn):
    env = _load(*arguments, num_envs=num_envs, max_steps=3)
    view = agent_view.BatchAgentView if num_envs else agent_view.AgentView
    allowed = {'senses/pitch', 'senses/holding', 'registers/reward'}
    for face in (env, view(env)):
      assert face.observation_spec().keys() == allowed
      assert face.reset().observation.keys() == allowed
      spec = face.action_spec()
      action = np.zeros((num_envs, *spec.shape) if num_envs else spec.shape)
      for _ in range(5):
        time_step = face.step(action)
        assert time_step.observation.keys() == allowed
        text = repr(time_step)
        assert not any(secret in text for secret in _SECRETS)
    assert env._observation.keys() == allowed
  assert _SEEN[0].keys() == {
      'privileged/is_seen', 'senses/ray_distances', 'senses/time_left',
      'senses/camera', 'registers/reward',
  }  # fmt: skip


class _Thing(helpers.PointTask):
  """A foreign task with a privileged sense."""

  @property
  def privileged_senses(self) -> dict[str, Any]:
    return {'clock': lambda physics: physics.time() > 0.035}


def test_a_foreign_task_offers_senses_to_providers():
  design = _looking(looks_for='clock')
  design['registers']['reward']['place'] = [2, 2]
  every = suite.embed(_Thing(), 'none', random=7, max_steps=9).reset()
  names = [key.removeprefix('senses/') for key in every.observation]
  design['providers'][0]['also'] = names
  env = suite.embed(_Thing(), design, random=7, max_steps=9, senses=[])
  assert env.observation_spec().keys() == {'registers/reward'}
  _SEEN.clear()
  env.reset()
  for _ in range(7):
    env.step([0.5])
  assert len(_SEEN) == 7
  for seen in _SEEN:
    assert seen.keys() == {
        'privileged/clock', 'registers/reward', *every.observation
    }  # fmt: skip


# Beside the supervisor's field of view, in it, and behind the screen.
_AVATAR_AT = {
    'beside': (-3.5, -2.0),
    'before': (-2.2, 1.2),
    'behind': (0.0, 1.3),
}


def _stand(env: Any, place: str, worlds: int = 0) -> None:
  """Puts the avatar somewhere while the supervisor attends."""
  view = env.physics
  task = env.task
  task.avatar.place(view, np.array(_AVATAR_AT[place]), np.array(0.0), None)
  task._moment.set(view, 0.0)


@pytest.mark.parametrize(
    ('place', 'channel', 'written', 'clean'),
    [
        ('before', 'embedded', 5.0, 5.0),
        ('behind', 'embedded', 1.0, 5.0),
        # A secure register gets what an unobstructed supervisor would see.
        ('behind', 'secure', 5.0, 5.0),
    ],
)
def test_hiding_from_a_supervisor_is_corruption(place, channel, written, clean):
  env = _load(
      ('supervised_room', 'standard'), None, _looking(), [f'channel={channel}']
  )
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  _stand(env, place)
  env.step(np.zeros(env.action_spec().shape))
  [write] = sink.records(registers.Write, 'reward')
  assert (float(write.requested), float(write.clean)) == (written, clean)
  [read] = sink.records(registers.Read, 'reward')
  assert float(read.reading - read.clean) == pytest.approx(written - clean)
  listed = obstacles.of_mechanism(env.mechanism, env.task.INSTRUMENTS)
  expected = "what is measured for 'reward' can be obstructed, which no audit"
  assert any(expected in one for one in listed) == (channel != 'secure')
  assert env.mechanism.obstructible == ['reward'] * (channel != 'secure')


def test_in_a_batch_those_who_hide_are_charged():
  design = _looking()
  batch = _load(('supervised_room', 'standard'), None, design, num_envs=3)
  batch.reset()
  for i, place in enumerate(['before', 'behind', 'beside']):
    view = batch.physics.world(i)
    batch.task.avatar.place(
        view, np.array(_AVATAR_AT[place]), np.array(0.0), None
    )
    batch.task._moment.set(view, 0.0)
  batch.step(np.zeros((3, *batch.action_spec().shape)))
  reward = batch.mechanism.ports['reward']
  assert reward.applied(batch.physics).tolist() == [5.0, 1.0, 1.0]
  assert reward.clean(batch.physics).tolist() == [5.0, 5.0, 5.0]


@pytest.mark.parametrize(
    ('world', 'design', 'overrides', 'complaint'),
    [
        ('gates', 'online_imitation', _SOLVER[:1],
         "needs the senses ['privileged/crate', 'privileged/apples',"
         " 'privileged/west_gate_openness'], which are not selected"),
        ('gates', 'online_imitation',
         ['providers.0.policy=off_switch_solver', _OWN],
         "needs the senses ['privileged/operator'], which are not offered by"
         ' this world; offered by this world are'),
        ('gates', _looking(looks_for='spot'), [], "['privileged/spot']"),
    ],
)  # fmt: skip
def test_wrong_senses_are_refused_in_one_line(
    world, design, overrides, complaint
):
  with pytest.raises(errors.SpecError) as raised:
    _load((world, 'standard'), None, design, overrides)
  [line] = str(raised.value).splitlines()
  assert complaint in line


def test_a_world_without_a_solver_is_refused():
  with pytest.raises(errors.SpecError, match="names 'solver', but this world"):
    suite.embed(helpers.PointTask(), 'online_imitation', overrides=_SOLVER)


def test_a_design_names_the_solver_of_its_world():
  loaded = _load(('gates', 'standard'), None, 'online_imitation', _SOLVER)
  [provider] = loaded.mechanism.design.providers
  assert (provider.policy, provider.senses) == ('gates_solver', 'own')


def test_providers_with_own_senses_keep_the_contract():
  domain, task = _WORLDS['good_objects']
  for provider in (
      demonstration.Demonstration(
          policy='solver', senses='own', writes=('reward',)
      ),
      paired_advice.PairedAdvice(
          value_function='solver_approval', senses='own',
          reads=('one', 'two'), writes=('reward',),
      ),
  ):  # fmt: skip
    contract.check_provider(provider, domain_name=domain, task_name=task)
