"""Worlds with the interface of Gymnasium: ids, spaces, episodes and secrets."""

import copy
import functools
import inspect
import pickle
import sys
import traceback
from typing import Any, ClassVar

import numpy as np
import pytest

pytest.importorskip('gymnasium')

from dm_control import mujoco
from dm_control.locomotion import arenas
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
import gymnasium as gym
from gymnasium.utils import env_checker

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.doors.gymnasium import evaluation
from realab_suite.doors.gymnasium import registration
from realab_suite.doors.gymnasium import single
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import gl_contexts
from realab_suite.engine import single_physics
from realab_suite.entities import appearance
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.feedback import mechanisms
from tests.leaks import walk

_NEAR = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_DISCRETE = {'overrides': ['action_set={name: dmlab_like, version: 1}']}
_MAX_STEPS = 6
_SHORT = {'environment_kwargs': {'max_steps': _MAX_STEPS}}
_NUM_ENVS = 3


def _make(name: str = _NEAR, **options: Any) -> Any:
  return gym.make(name, **{**_SHORT, **options}).unwrapped


def test_every_shipped_world_has_an_id_with_every_design():
  ids = registration.ids()
  number = sum(len(suite.designs_for(domain)) for domain, _ in suite.ALL_TASKS)
  assert len(ids) == len(set(ids)) == number > 100
  assert set(ids) <= set(gym.registry)
  assert _NEAR in ids
  for make, many in (
      (registration.make, {}), (registration.make_vector, {'num_envs': 2})
  ):  # fmt: skip
    seen = [
        make('off_switch', 'far', **many, **chosen).observation_space.spaces
        for chosen in ({}, {'design': 'instantaneous_reward'}, {'design': None})
    ]
    assert seen[0] == seen[1] != seen[2]


def test_worlds_are_not_copied_because_copies_expose_the_environment():
  single_world = _make()
  many = gym.make_vec(_NEAR, num_envs=2, **_SHORT).unwrapped
  for env in (single_world, many):
    for take in (copy.copy, copy.deepcopy, pickle.dumps):
      with pytest.raises(TypeError, match='cannot be pickled or copied'):
        take(env)
    env.close()


@pytest.mark.parametrize(
    'name',
    [
        _NEAR,
        'realab/CollectApples-boxed-OnlineImitation-v3',
        'realab/UnlockDoor-impossible-PairedDecoupledApproval-v3',
    ],
)
def test_the_checker_of_gymnasium_has_no_warnings(name):
  env_checker.check_env(_make(name), skip_render_check=True)


def test_the_checker_has_no_warnings_about_flat_observations():
  env = _make(flat=True, reward_register='reward', **_DISCRETE)
  env_checker.check_env(env, skip_render_check=True)


@pytest.mark.parametrize(
    ('name', 'space'),
    [
        ('InstantaneousReward', gym.spaces.Box(-1, 1, (6,), np.float32)),
        ('OnlineImitation', gym.spaces.Discrete(14)),
        ('ValueAdvice', gym.spaces.MultiDiscrete([14, 14])),
    ],
)
def test_action_spaces(name, space):
  assert _make(f'realab/UnlockDoor-near-{name}-v3').action_space == space


def test_observations_have_no_slashes_no_empty_shapes_and_classes():
  space = _make().observation_space
  assert not [key for key in space if '/' in key or not space[key].shape]
  classes = space['senses_ray_classes']
  assert isinstance(classes, gym.spaces.MultiDiscrete)
  assert set(classes.nvec) == {appearance.CAPACITY}
  assert space['registers_reward'].dtype == np.float32


def test_a_world_contains_no_class_but_those_of_its_spec():
  # All worlds list the first 11.
  codes = np.array([*range(11), 14, 17, 18])
  name = 'realab/SupervisedRoom-standard-SupervisedRoom-v2'
  env = _make(name, environment_kwargs={'max_steps': 100})
  env.action_space.seed(3)
  observation, _ = env.reset(seed=5)
  for _ in range(100):
    assert np.isin(observation['senses_ray_classes'], codes).all()
    observation, *_ = env.step(env.action_space.sample())


def test_a_flat_observation_is_that_of_gymnasiums_wrapper():
  flat = _make(flat=True)
  wrapped = gym.wrappers.FlattenObservation(_make())
  assert flat.observation_space.shape == (1067,)
  assert flat.observation_space == wrapped.observation_space
  for env in (flat, wrapped):
    env.action_space.seed(2)
  found, expected = (env.reset(seed=3)[0] for env in (flat, wrapped))
  for _ in range(3):
    assert found.dtype == expected.dtype == np.float32
    np.testing.assert_array_equal(found, expected)
    found, expected = (
        env.step(env.action_space.sample())[0] for env in (flat, wrapped)
    )


def test_the_reward_is_zero_or_the_reading_of_a_register():
  long = {'environment_kwargs': {'max_steps': 100}}
  silent, paid = _make(**long), _make(reward_register='reward', **long)
  for env in (silent, paid):
    env.reset(seed=1)
  rewards = []
  # The way ahead leads to an apple.
  for _ in range(100):
    action = np.ones(6, np.float32)
    assert silent.step(action)[1] == 0.0
    observation, reward, *_, info = paid.step(action)
    assert np.float32(reward) == observation['registers_reward'][0]
    assert info == {}
    rewards.append(reward)
  assert max(rewards) == pytest.approx(1.0)


def test_the_time_limit_truncates_and_the_next_step_needs_a_reset():
  env = _make()
  with pytest.raises(gym.error.ResetNeeded):
    env.step(env.action_space.sample())
  env.reset(seed=1)
  ends = [env.step(np.zeros(6, np.float32))[2:4] for _ in range(_MAX_STEPS)]
  assert ends == [(False, False)] * (_MAX_STEPS - 1) + [(False, True)]
  with pytest.raises(gym.error.ResetNeeded):
    env.step(env.action_space.sample())


def test_an_end_of_the_task_terminates():
  kwargs = {'random': 1}
  env = gym.make(_NEAR, task_kwargs=kwargs).unwrapped
  other = suite.load(
      'unlock_door', 'near', kwargs, design='instantaneous_reward'
  )
  actor = actors.make(policies.make('apple_seeker'), other)
  time_step = other.reset()
  env.reset()
  while not time_step.last():
    action = actor.act(time_step)
    time_step = other.step(action)
    *_, terminated, truncated, _ = env.step(action)
  assert time_step.discount == 0.0
  assert (terminated, truncated) == (True, False)


@pytest.mark.parametrize(
    'action', [0.5, [0.5], 'forward', [[0.0], [0.0, 0.0]], np.zeros(6, bool)]
)
def test_actions_of_another_shape_or_type_are_refused(action):
  env = _make().unwrapped
  env.reset()
  with pytest.raises(errors.ActionError, match='action'):
    env.step(action)


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ({'reward_register': 'score'}, r"must be None .*\['reward'\]"),
        ({'render_mode': 'human'}, "must be 'rgb_array' or None"),
        ({'flat': 'yes'}, "flat: must be .*'yes'"),
    ],
)
def test_wrong_options_are_refused(options, message):
  with pytest.raises(errors.SpecError, match=message):
    registration.make('unlock_door', 'near', 'instantaneous_reward', **options)


def _public(thing: Any) -> dict[str, Any]:
  return {
      name: getattr(thing, name, None)
      for name in dir(thing)
      if not name.startswith('_')
  }


def test_no_public_attribute_leads_to_the_environment():
  secret = (
      environment.Environment, batch_environment.BatchEnvironment,
      single_physics.ThinPhysics, mechanisms.FeedbackMechanism,
  )  # fmt: skip
  for env in (_make(), gym.make_vec(_NEAR, num_envs=2)):
    env.reset(seed=1)
    for name, value in _public(env).items():
      for part in (value, *_public(value).values()):
        assert not isinstance(part, secret), name
        closure = (
            inspect.getclosurevars(part) if inspect.isfunction(part) else None
        )
        assert closure is None or not closure.nonlocals, name


def _make_vec(mode: str = 'NextStep', **options: Any) -> Any:
  return gym.make_vec(
      _NEAR, num_envs=_NUM_ENVS, autoreset_mode=mode,
      reward_register='reward', **{**_SHORT, **options},
  )  # fmt: skip


def _sync(mode: str = 'NextStep', **options: Any) -> Any:
  """Returns the same worlds in Gymnasium's own vector environment."""

  def maker(world: int) -> Any:
    kwargs = {'max_steps': _MAX_STEPS, 'world': world}
    return lambda: _make(
        environment_kwargs=kwargs, reward_register='reward', **options
    )

  return gym.vector.SyncVectorEnv(
      [maker(world) for world in range(_NUM_ENVS)],
      autoreset_mode=gym.vector.AutoresetMode(mode),
  )


def _assert_same(found: Any, expected: Any) -> None:
  assert env_checker.data_equivalence(found, expected, exact=True)


@pytest.mark.parametrize(
    ('mode', 'flat'),
    [('NextStep', True), ('SameStep', False), ('Disabled', False)],
)
def test_a_batch_does_what_gymnasiums_vector_of_its_worlds_does(mode, flat):
  envs = _make_vec(mode, flat=flat)
  sync = _sync(mode, flat=flat)
  assert envs.single_observation_space == sync.single_observation_space
  assert envs.observation_space == sync.observation_space
  assert envs.action_space == sync.action_space
  assert envs.metadata['autoreset_mode'] == sync.metadata['autoreset_mode']
  assert envs.autoreset_mode == sync.autoreset_mode
  _assert_same(envs.reset(seed=5), sync.reset(seed=[5] * _NUM_ENVS))
  envs.action_space.seed(1)
  is_over = np.zeros(_NUM_ENVS, bool)
  for i in range(2 * _MAX_STEPS + 3):
    is_needed = mode == 'Disabled' and is_over.any()
    # World 1 is reset in mid-episode, so that the worlds get out of step, and
    # where the others end.
    if is_needed or i in (2, _MAX_STEPS, _MAX_STEPS + 1):
      mask = (is_over & is_needed) | (np.arange(_NUM_ENVS) == 1)
      _assert_same(
          envs.reset(options={'reset_mask': mask}),
          sync.reset(options={'reset_mask': mask}),
      )
    actions = envs.action_space.sample()
    found, expected = envs.step(actions), sync.step(actions)
    _assert_same(found[:4], expected[:4])
    final = expected[4].pop('final_info', None), expected[4].pop(
        '_final_info', None
    )
    infos = dict(found[4])
    assert ('final_info' in infos) == (final[0] is not None)
    infos.pop('final_info', None)
    infos.pop('_final_info', None)
    assert infos.keys() == expected[4].keys()
    for key, value in expected[4].items():
      _assert_same(list(infos[key]), list(value))
    is_over = found[2] | found[3]
  envs.close()


def test_a_world_without_a_new_seed_begins_its_next_episode():
  options: Any = {'task_kwargs': {'random': 4}}
  envs, sync = _make_vec(**options), _sync(**options)
  for seeds in (
      [None, 7, None], [None, 2**70, 7], [None] * _NUM_ENVS, [5, None, 6],
      (None, 3, None), None, [1, 2, 3], [None, None, 3],
  ):  # fmt: skip
    _assert_same(envs.reset(seed=seeds), sync.reset(seed=seeds))
    actions = envs.action_space.sample()
    for _ in range(2):
      _assert_same(envs.step(actions)[:4], sync.step(actions)[:4])
  expected = envs.reset(seed=[1, 2, 3])
  _assert_same(envs.reset(seed=np.array([1, 2, 3])), expected)
  for seeds in ([1, None], [], [[1], 2, None], [-1, 2, 3], '123', np.array(1)):
    with pytest.raises(errors.SpecError, match=r'(random|seed): '):
      envs.reset(seed=seeds)


@pytest.mark.parametrize('name', ['sed', 'reset_masks', 'seed'])
def test_unknown_options_of_a_reset_are_refused(name):
  one, many = _make(), _make_vec()
  for env, allowed in ((one, 'none'), (many, 'reset_mask')):
    with pytest.raises(errors.SpecError, match=rf"'{name}'.*: {allowed}\)"):
      env.reset(options={name: np.ones(_NUM_ENVS, bool)})
    env.reset(options={})


@pytest.mark.parametrize('has_begun', [True, False])
def test_a_closed_world_and_a_closed_batch_raise_the_same(has_begun):
  frames: Any = {'render_mode': 'rgb_array'}
  for env in (_make(**frames), _make_vec(**frames)):
    if has_begun:
      env.reset()
    env.close()
    for use in (
        env.reset,
        lambda env=env: env.reset(seed=1),
        lambda env=env: env.step(env.action_space.sample()),
        env.render,
    ):
      with pytest.raises(errors.ClosedError):
        use()
    env.close()


def test_what_the_renderer_raises_is_the_same_in_a_world_and_a_batch(
    monkeypatch,
):
  def fail(*args: Any, **kwargs: Any) -> Any:
    raise ValueError('lost')

  frames: Any = {'render_mode': 'rgb_array'}
  envs = _make(**frames), _make_vec(**frames)
  monkeypatch.setattr(mujoco.Physics, 'render', fail)
  for env in envs:
    env.reset()
    with pytest.raises(errors.RenderingError, match=r'240 x 320 .*\(lost\)'):
      env.render()


@pytest.mark.parametrize(('height', 'width'), [(240, 319), (239, 320)])
def test_frames_without_room_are_refused_when_a_world_is_made(height, width):
  def load() -> environment.Environment:
    arena = arenas.Floor((8, 8))
    buffer = getattr(arena.mjcf_model.visual, 'global')
    buffer.offheight, buffer.offwidth = height, width
    task = tasks.GoToTarget(walkers.RollingBallWithHead(), arena)
    return suite.embed(task, 'none', max_steps=2)

  single.RealabEnv(load())
  with pytest.raises(errors.SpecError, match=r'3?[24]0; must .*buffer'):
    single.RealabEnv(load(), render_mode='rgb_array')


@pytest.mark.parametrize('size', [(0, 9), (9, -1), (1.5, 9), (9, 641)])
def test_frames_that_are_no_frames_are_refused(size):
  batch = suite.load_batch('unlock_door', 'near', num_envs=1, design=None)
  with pytest.raises(errors.SpecError, match=r'(height|width): .*buffer'):
    batch.render(None, 'top_down', *size)


def test_the_reading_of_a_first_step_is_no_reward():
  envs = _make_vec(overrides=['registers.reward.initial=3'])
  envs.reset(seed=1)
  for _ in range(_MAX_STEPS + 1):
    observations, rewards, *_ = envs.step(envs.action_space.sample())
  np.testing.assert_allclose(observations['registers_reward'], 3.0, atol=1e-4)
  assert rewards.tolist() == [0.0] * _NUM_ENVS


def test_an_evaluation_is_that_of_the_evaluator():
  action = np.array([1.0, 0.0, 0.5, 0.0, 1.0, 0.0], np.float32)
  env = gym.make(_NEAR, task_kwargs={'random': 3}, **_SHORT)
  env = gym.wrappers.FlattenObservation(env)
  found = evaluation.evaluate(env, lambda _: action, 2)
  other = suite.load(
      'unlock_door', 'near', {'random': 3}, {'max_steps': _MAX_STEPS},
      design='instantaneous_reward',
  )  # fmt: skip
  expected = evaluate.evaluate(other, lambda _: action, 2)
  assert found == expected
  assert found[0].is_valid


class _Reseeding(gym.Wrapper):
  """Begins the first episode of a seed with every reset."""

  def reset(self, *, seed=None, options=None):
    return self.env.reset(seed=5 if seed is None else seed, options=options)


@pytest.mark.parametrize('seed', [5, 7])
def test_a_wrapper_that_passes_a_seed_is_refused_at_the_first_reset(seed):
  env = _Reseeding(_make(task_kwargs={'random': seed}))
  actions: list[Any] = []
  with pytest.raises(errors.SpecError, match='wrapper passes seed 5'):
    evaluation.evaluate(env, actions.append, 2)
  assert not actions
  env.reset()  # Outside an evaluation, seeds are its own affair.


def _still(unused_observation: Any) -> np.ndarray:
  return np.zeros(6, np.float32)


def _fail(*unused: Any, **options: Any) -> Any:
  raise RuntimeError('no GL')


@pytest.mark.parametrize('num_envs', [0, 2])
def test_no_frame_of_an_error_leads_to_the_world(monkeypatch, num_envs):
  monkeypatch.setattr(gl_contexts, 'frame', _fail)
  monkeypatch.setattr(batch_environment.BatchEnvironment, 'render', _fail)
  options = {**_SHORT, 'render_mode': 'rgb_array'}
  env = _make(**options)
  if num_envs:
    env = gym.make_vec(_NEAR, num_envs=num_envs, **options).unwrapped
  env.reset()
  worlds = environment.Environment, batch_environment.BatchEnvironment
  for call in (
      *(functools.partial(env.reset, seed=seed) for seed in (True, [1], [0.5])),
      env.render, lambda: env.close() or env.reset(seed=3), env.render,
  ):  # fmt: skip
    with pytest.raises(Exception) as caught:  # noqa: PT011 - Any of them.
      call()
    error = caught.value
    assert (error.__cause__, error.__context__) == (None, None)
    for frame, _ in traceback.walk_tb(error.__traceback__.tb_next):
      for part in walk.reach({**frame.f_locals}, 2):
        assert not isinstance(part.value, worlds), (error, part.path)


class _Index(int):
  """A seed that looks at the frames below which it runs."""

  seen: ClassVar[list[str]] = []

  def __index__(self) -> int:
    frame = sys._getframe(1)
    while frame:
      self.seen.append(frame.f_globals['__name__'])
      frame = frame.f_back
    return 5

  __int__ = __index__


def test_a_seed_runs_no_code_below_a_frame_of_the_world():
  env = _make()
  env.reset(seed=_Index(5))
  assert 'realab_suite.doors.gymnasium.single' in _Index.seen
  assert not any(name.startswith('realab_suite.engine') for name in _Index.seen)


def test_an_evaluation_hands_out_no_seed():
  env = gym.make(_NEAR, task_kwargs={'random': 5}, **_SHORT)
  env.reset(seed=5)

  def seeds():
    base = env.unwrapped
    kwargs = [each.spec.kwargs['task_kwargs'] for each in (env, base)]
    return [*(one.get('random') for one in kwargs), base.np_random_seed]

  assert seeds() == [5, 5, 5]
  seen = []
  evaluation.evaluate(env, lambda x: seen.append(seeds()) or _still(x), 1)
  assert len(seen) == _MAX_STEPS
  assert not any(5 in one for one in seen)
  assert seeds() == [5, 5, 5]


class _Quitting(gym.Wrapper):
  """Plays numbers of steps of episodes, and gives them up, before each one."""

  def __init__(self, env: gym.Env, *steps: int) -> None:
    super().__init__(env)
    self._steps = steps

  def reset(self, *, seed=None, options=None):
    for number in self._steps:
      self.env.reset(seed=seed, options=options)
      for _ in range(number):
        self.env.step(_still(None))
    return self.env.reset(seed=seed, options=options)


def test_episodes_that_are_given_up_take_no_place():
  found = evaluation.evaluate(_Quitting(_make(), 0, 1, 2), _still, 2)
  assert [(one.episode, one.num_steps, one.is_valid) for one in found] == [
      (0, 0, False), (1, 1, False), (2, 2, False), (3, _MAX_STEPS, True),
      (4, 0, False), (5, 1, False), (6, 2, False), (7, _MAX_STEPS, True),
  ]  # fmt: skip
  # Unless they are hacked.
  found = evaluation.evaluate(
      _Quitting(_make(), 0, 1, 2), _still, 2,
      is_hacked=lambda result: result.num_steps > 0,
  )  # fmt: skip
  assert [one.num_steps for one in found] == [0, 1, 2]


class _Restarting(gym.Wrapper):
  """Begins another episode within each step, so that none ever ends."""

  def step(self, action):
    self.env.reset()
    return self.env.step(action)


@pytest.mark.parametrize(
    'wrap', [lambda env: gym.wrappers.TimeLimit(env, 2), _Restarting]
)
def test_an_agent_that_always_gives_up_is_refused(monkeypatch, wrap):
  monkeypatch.setattr(evaluate, 'MOST_GIVEN_UP', 3)
  with pytest.raises(
      errors.ResultsError,
      match='gave up 7 episodes, and 0 of 2 are complete; at most 6 may be',
  ):
    evaluation.evaluate(wrap(_make()), _still, 2)


class _Remaking(gym.Wrapper):
  """Makes another world for each episode but the first ones."""

  def __init__(self, env: gym.Env, kept: int) -> None:
    super().__init__(env)
    self._kept = kept

  def reset(self, *, seed=None, options=None):
    if not self._kept:
      self.env = _make()
    self._kept = max(self._kept - 1, 0)
    return self.env.reset(seed=seed, options=options)


@pytest.mark.parametrize('kept', [0, 1])
def test_a_wrapper_that_makes_another_world_is_refused_at_once(kept):
  env = _Remaking(_make(), kept)
  with pytest.raises(errors.ResultsError, match=f'episode {kept} left no res'):
    evaluation.evaluate(env, _still, 3)


class _Standing(gym.Wrapper):
  """Passes no action on, or not the end of an episode."""

  def __init__(self, env: gym.Env, passes: bool) -> None:
    super().__init__(env)
    self._passes, self._left = passes, _MAX_STEPS - 1

  def step(self, action):
    if self._passes and self._left:
      self._left -= 1
      self.env.step(action)
    return self.observation_space.sample(), 0.0, False, False, {}


@pytest.mark.parametrize('passes', [False, True])
def test_an_episode_that_never_ends_is_refused(monkeypatch, passes):
  monkeypatch.setattr(evaluate, 'MOST_ACTIONS', 2)
  with pytest.raises(
      errors.ResultsError, match='episode 0 does not end after 13 actions, but'
  ):
    evaluation.evaluate(_Standing(_make(), passes), _still, 1)


def test_only_worlds_of_this_package_can_be_evaluated():
  env = gym.make('CartPole-v1')
  with pytest.raises(errors.ResultsError, match='CartPole'):
    evaluation.evaluate(env, lambda _: 0, 1)
  with pytest.raises(errors.ResultsError, match='num_episodes'):
    evaluation.evaluate(_make(), lambda _: 0, 0)
