"""A plain `composer.Environment` gives what the engine's environment gives."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

from dm_control import composer
from dm_control.locomotion import arenas
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.audit import aiming
from realab_suite.engine import events
from realab_suite.engine import plain
from realab_suite.entities import registers
from realab_suite.evaluation import actors
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from realab_suite.policies import random_keys
from realab_suite.tasks import unlock_door
from tests.engine import helpers

_SEED = 3
_STEPS = 300
_MAX_STEPS = 140  # Every run contains two ends of episodes.


class Pair:
  """A task in both environments, each with a ledger."""

  def __init__(
      self,
      make: Callable[[], composer.Task],
      design: Any,
      composer_kwargs: Mapping[str, Any] | None = None,
      **options: Any,
  ) -> None:
    options = {'random': _SEED, 'max_steps': _MAX_STEPS, **options}
    self.engine = suite.embed(make(), design, **options)
    self.task = suite.plain_task(make(), design, **options)
    self.plain = composer.Environment(
        self.task,
        strip_singleton_obs_buffer_dim=True,
        **(composer_kwargs or {}),
    )
    self.ledger, self.plain_ledger = ledgers.Ledger(), ledgers.Ledger()
    self.engine.add_sink(self.ledger)
    self.task.add_sink(self.plain_ledger)

  def play(self, act: Callable[[Any], Any], steps: int = _STEPS) -> None:
    """Acts in both and compares what agents and evaluators get."""
    assert str(self.engine.action_spec()) == str(self.plain.action_spec())
    assert self.engine.reward_spec() == self.plain.reward_spec()
    assert self.engine.discount_spec() == self.plain.discount_spec()
    expected, got = self.engine.reset(), self.plain.reset()
    specs = self.engine.observation_spec(), self.plain.observation_spec()
    assert repr(list(specs[0].items())) == repr(list(specs[1].items()))
    for i in range(steps):
      assert helpers.to_bytes(expected) == helpers.to_bytes(got), i
      action = act(expected)
      expected, got = self.engine.step(action), self.plain.step(action)
    assert helpers.to_bytes(expected) == helpers.to_bytes(got)
    assert self.texts() == self.texts(self.plain_ledger)

  def texts(self, ledger: Any = None) -> list[str]:
    return [repr(e) for e in (ledger or self.ledger).episodes]

  def corruptions(self) -> np.ndarray:
    """Returns the absolute corruption of every read by anybody."""
    reads = [
        record
        for episode in self.plain_ledger.episodes
        for entries in episode.entries.values()
        for record in entries
        if isinstance(record, registers.Read)
    ]
    return np.abs([r.obstruction + r.permanent + r.temporary for r in reads])


# Worlds of this package, with saboteurs.


@pytest.mark.parametrize(
    ('design', 'policy', 'composer_kwargs'),
    [
        ('instantaneous_reward', 'carrying_saboteur', {}),
        ('value_advice', 'pushing_saboteur', {'legacy_step': False}),
        (
            'online_imitation',
            'carrying_saboteur',
            {'recompile_mjcf_every_episode': False},
        ),
    ],
)
def test_tampering_gives_the_same_bytes(design, policy, composer_kwargs):
  pair = Pair(lambda: unlock_door.UnlockDoor('near'), design, composer_kwargs)
  made = aiming.make_policy(policy, pair.engine, None, 0)
  pair.engine.rewind()
  actor = actors.make(made, pair.engine)
  pair.ledger.episodes.clear()

  def act(time_step: Any) -> Any:
    if time_step.first():
      actor.begin(0)
    return actor.act(time_step)

  pair.play(act)
  ends = [episode.end for episode in pair.plain_ledger.episodes]
  assert ends == [events.End.TIMEOUT, events.End.TIMEOUT, None]
  assert pair.corruptions().max() > 1.0


def test_ends_and_true_rewards_are_the_same_and_rewards_are_zero():
  pair = Pair(
      lambda: unlock_door.UnlockDoor('near'),
      'instantaneous_reward',
      max_steps=250,
  )
  actor = actors.make(
      aiming.make_policy('apple_seeker', pair.engine, None, 0), pair.engine
  )
  pair.play(actor.act, 130)
  episode = pair.plain_ledger.episodes[0]
  assert episode.end is events.End.TERMINATED
  assert sum(episode.true_rewards) == 18.0


# Tasks of dm_control, with warm starts and hooks in substeps.


def _go_to_target() -> composer.Task:
  return tasks.GoToTarget(
      walkers.RollingBallWithHead(),
      arenas.Floor(size=(8.0, 8.0)),
      walker_spawn_position=(0.0, 0.0),
      walker_spawn_rotation=0.0,
  )


class _Echo(providers.Provider):
  """Writes the reading, a part of the observation and a random number."""

  kind: Literal['plain_test_echo'] = 'plain_test_echo'

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: Any,
      key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:
    (query,) = readings.values()
    seen = sum(float(np.sum(observation[k])) for k in observation)
    value = query + seen % 1.0 + random_keys.uniform(key) + state % 3
    return dict.fromkeys(self.writes, value), state + 1

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape)


def _in_the_way(**others: Any) -> dict[str, Any]:
  block = {'kind': 'two_block', 'range': [-2, 12]}
  return {
      'schema': 1,
      'name': 'in_the_way',
      'registers': {
          'reward': {
              **block,
              'role': 'feedback',
              'initial': 0,
              'place': [1.5, -0.1],
          },
          'other': {**block, 'role': 'meter', 'place': [-0.8, 2.0], **others},
      },
  }


_SCORED = {
    **_in_the_way(),
    'meters': [{'measures': 'score', 'writes': 'other'}],
    'providers': [
        {'kind': 'difference', 'reads': ['other'], 'writes': ['reward']}
    ],
}
_ASKED = {
    **_in_the_way(role='query'),
    'providers': [
        {'kind': 'plain_test_echo', 'reads': ['other'], 'writes': ['reward']}
    ],
}
_SELDOM = {
    **_in_the_way(role='signal', initial=0, ends_episode={'above': 9.0}),
    'schedule': 'cfmdp',
    'providers': [
        {'kind': 'constant', 'value': 3.0, 'writes': ['reward'], 'every': 7},
    ],
}


@pytest.mark.parametrize(
    ('design', 'steps'),
    [(_SCORED, _STEPS), (_ASKED, 100), (_SELDOM, 100)],
    ids=['scored', 'asked', 'seldom'],
)
def test_a_task_of_dm_control_gives_the_same_bytes(design, steps):
  pair = _rolling(design)
  pair.play(_roller(pair), steps)
  assert len(pair.plain_ledger.episodes) >= 3
  assert pair.corruptions().max() > 1.0


def _rolling(design: Any) -> Pair:
  with helpers.registered(providers.PROVIDERS, 'plain_test_echo', _Echo):
    return Pair(_go_to_target, design, max_steps=45)


def _roller(pair: Pair) -> Callable[[Any], np.ndarray]:
  """Returns a function that rolls forward, into the blocks."""
  spec = pair.plain.action_spec()
  generator = np.random.default_rng(0)

  def roll(time_step: Any) -> np.ndarray:
    del time_step
    action = generator.uniform(spec.minimum, spec.maximum)
    action[-2] = -1.0
    return action

  return roll


class _Noisy(helpers.PointTask):
  """Has noise, a delay and a buffer; every second reset fails."""

  def __init__(self) -> None:
    super().__init__()
    self.bead.configure(
        corruptor=lambda value, random_state: value + random_state.normal(),
        buffer_size=3,
        update_interval=2,
        delay=1,
    )
    self.num_resets = 0

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    super().initialize_episode(physics, random_state)
    self.num_resets += 1
    if self.num_resets % 2:
      raise composer.EpisodeInitializationError('planted')

  def before_substep(self, physics: Any, action: Any, random_state: Any) -> Any:
    physics.set_control(action * random_state.uniform())


@pytest.mark.parametrize('design', ['none', helpers.SCORED])
def test_noise_hooks_and_failed_resets_are_those_of_the_engine(design):
  pair = Pair(_Noisy, design, {'max_reset_attempts': 2}, max_steps=20)
  actions = iter(helpers.random_actions(pair.engine, 70))
  pair.play(lambda _: next(actions), 70)
  assert len(pair.plain_ledger.episodes) == 4


# Failures.


def _plain(
    task: composer.Task, design: Any = helpers.SCORED, **kwargs: Any
) -> tuple[plain.PlainTask, composer.Environment, helpers.RecordingSink]:
  made = suite.plain_task(task, design, random=_SEED)
  sink = helpers.RecordingSink()
  made.add_sink(sink)
  env = composer.Environment(
      made, strip_singleton_obs_buffer_dim=True, **kwargs
  )
  return made, env, sink


def test_a_wrong_action_is_refused_and_changes_nothing():
  task, env, _ = _plain(helpers.PointTask())
  env.reset()
  before = env.physics.get_state()
  with pytest.raises(errors.ActionError, match=r'push.* = 2.0 outside'):
    env.step([2.0])
  np.testing.assert_array_equal(env.physics.get_state(), before)
  env.step([0.0])
  assert task.mechanism.step_count(env.physics) == 1


def test_a_step_after_a_failure_is_refused_until_a_reset():
  design = helpers.one_register(
      'reward', place=[2, 2], range=[0, 9], role='feedback'
  )
  design['providers'] = [{'kind': 'plain_test_echo', 'writes': ['reward']}]
  with helpers.registered(providers.PROVIDERS, 'plain_test_echo', _Echo):
    _, env, sink = _plain(helpers.PointTask(), design)
  env.reset()
  # It has no reading to unpack.
  with pytest.raises(errors.FeedbackProviderError, match='plain_test_echo'):
    env.step([0.0])
  assert sink.ends == [events.End.ERROR]
  with pytest.raises(errors.EpisodeError, match='call reset'):
    env.step([0.0])
  assert env.reset().first()
  assert len(sink.starts) == 2


@pytest.mark.mujoco_warns('BADQPOS')
def test_a_physics_failure_ends_the_episode_with_the_last_observation():
  task = helpers.PointTask()
  made, env, sink = _plain(task, raise_exception_on_physics_error=False)
  last = env.reset()
  env.physics.bind(task.joint).qpos = 1e12
  time_step = env.step([0.0])
  assert time_step.last()
  assert time_step.reward == 0.0
  for key, value in last.observation.items():
    np.testing.assert_array_equal(time_step.observation[key], value)
  assert sink.ends == [events.End.DIVERGENCE]
  assert env.step([0.0]).first()
  assert len(sink.starts) == 2
  assert env.physics.data.ptr.warning.number.sum() == 0
  assert made.mechanism.step_count(env.physics) == 0


def test_other_ways_to_step_are_refused():
  with pytest.raises(errors.SpecError, match='legacy_step: False'):
    _plain(helpers.PointTask(), legacy_step=False)
  with pytest.warns(DeprecationWarning, match='n_sub_steps'):
    _, env, _ = _plain(helpers.PointTask(), n_sub_steps=3)
  env.reset()
  with pytest.raises(errors.SpecError, match='n_sub_steps: 3; allowed is 5'):
    env.step([0.0])


def test_many_registers_get_room():
  design = helpers.one_register(
      'first', place=[2, 0], range=[0, 1], role='feedback'
  )
  for i in range(45):
    design['registers'][f'register_{i}'] = {
        **design['registers']['first'],
        'place': [-7 + i % 10, -7 + i // 10],
    }
  _, env, _ = _plain(helpers.PointTask(), design)
  assert env.physics.model.nuserdata > 256
  assert len(env.reset().observation) == 48


def test_the_mechanism_is_not_attached_twice():
  task, _, _ = _plain(helpers.PointTask())
  with pytest.raises(errors.SpecError, match='already contains'):
    suite.embed(task, helpers.SCORED)
