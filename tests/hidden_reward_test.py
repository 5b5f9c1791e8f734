"""Tests that the true reward is hidden: change it, and the agent cannot tell.

Without meters nothing of the true reward may reach the agent. With them it may,
through registers and contacts alone: that is what a meter register is for.
"""

from collections.abc import Callable
from typing import Any

from dm_control import composer
import mujoco
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.feedback import mechanism
from realab_suite.tasks import base
from realab_suite.tasks import collect_apples
from tests import worlds
from tests.engine import helpers

_STEPS = 60
_FEEDBACK = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': 'station_1',
    'range': [-2, 12],
}
_NO_METERS = {
    'schema': 1,
    'name': 'no_meters',
    'registers': {'reward': _FEEDBACK},
    'providers': [{'kind': 'constant', 'value': 3.0, 'writes': ['reward']}],
}
# The meter is read by nobody, so that it can be moved without consequences.
_UNREAD_METER = {
    **_NO_METERS,
    'name': 'unread_meter',
    'registers': {
        'reward': _FEEDBACK,
        'score': {
            'kind': 'two_block',
            'role': 'meter',
            'place': 'station_2',
            'range': [0, 20],
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
}

_Run = tuple[list[bytes], helpers.RecordingSink]


def _load(
    task: tuple[str, str], design: Any, seed: int = 3
) -> environment.Environment:
  return suite.load(
      *task, {'random': seed}, {'max_steps': _STEPS}, design=design
  )


def _walk(env: environment.Environment, number: int) -> list[np.ndarray]:
  """Actions that take an avatar through a room, and so over apples."""
  generator = np.random.default_rng(3)
  actions = np.zeros((number, *env.action_spec().shape))
  actions[:, 0] = 1.0
  actions[:, 2] = np.repeat(generator.uniform(-1, 1, number), 4)[:number]
  return list(actions)


def _run(env: environment.Environment) -> _Run:
  """Returns everything that an agent gets, and what an evaluator hears."""
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  transcript = [helpers.spec_text(env).encode()]
  # An episode and the beginning of the next.
  for action in _walk(env, _STEPS + 10):
    transcript.append(helpers.to_bytes(env.step(action)))
  env.close()
  return transcript, sink


def _raise(physics: Any) -> Any:
  raise ZeroDivisionError('the true reward is 173.25')


def _alter_earn(
    change: Callable[[Any], Any],
) -> Callable[[environment.Environment], None]:
  """Makes a world pay another reward for what it rewards."""

  def alter(env: environment.Environment) -> None:
    earn = env.task.earn
    env.task.earn = lambda physics, reward: earn(physics, change(reward))

  return alter


def _alter_reward(
    get_reward: Callable[[Any], Any],
) -> Callable[[environment.Environment], None]:
  def alter(env: environment.Environment) -> None:
    env.task.get_reward = get_reward

  return alter


_SECRETS = {
    'another sign': _alter_earn(lambda reward: -reward),
    'another scale': _alter_earn(lambda reward: 1e6 * reward),
    'tiny': _alter_earn(lambda reward: 173.2317e-9 * reward),
    'none': _alter_earn(lambda reward: 0.0 * reward),
    'paid all the time': _alter_earn(lambda reward: reward + 1.0),
    'not a number': _alter_earn(lambda reward: reward * float('nan')),
    'infinite': _alter_earn(lambda reward: reward + float('inf')),
    'reward that is not a number': _alter_reward(lambda physics: np.nan),
    'reward in an array': _alter_reward(lambda physics: np.ones(1)),
    'reward that is None': _alter_reward(lambda physics: None),
    'reward that raises': _alter_reward(_raise),
}


@pytest.fixture(scope='module', params=suite.TASKS_BY_DOMAIN)
def plain(request: pytest.FixtureRequest) -> tuple[tuple[str, str], _Run]:
  task = (request.param, 'standard')
  return task, _run(_load(task, _NO_METERS))


def test_the_walk_of_these_tests_earns_something(
    plain: tuple[tuple[str, str], _Run],
):
  _, (_, sink) = plain
  assert sink.true_return() >= 2
  assert sink.ends == [events.End.TIMEOUT, events.End.ABANDONED]


@pytest.mark.parametrize('secret', _SECRETS)
def test_without_meters_another_true_reward_changes_no_bit(
    plain: tuple[tuple[str, str], _Run], secret: str
):
  task, (expected, plain_sink) = plain
  env = _load(task, _NO_METERS)
  _SECRETS[secret](env)
  found, sink = _run(env)
  assert found == expected
  rewards = [str(step.true_reward) for step in sink.steps]
  # The evaluator, on the other hand, does hear of the difference.
  assert rewards != [str(step.true_reward) for step in plain_sink.steps]


@pytest.mark.parametrize(
    'secret', ['reward that is None', 'reward that raises']
)
def test_a_true_reward_that_fails_is_no_message_to_the_agent(secret: str):
  env = _load(suite.ALL_TASKS[0], _NO_METERS)
  _SECRETS[secret](env)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  assert env.step(helpers.no_op(env)).mid()
  env.close()


@pytest.mark.parametrize('design', ['instantaneous_reward'])
def test_with_meters_another_true_reward_does_show(design: str):
  # The control: these comparisons can tell runs apart.
  task = ('collect_apples', 'standard')
  expected, _ = _run(_load(task, design))
  env = _load(task, design)
  _alter_earn(lambda reward: 2.0 * reward)(env)
  assert _run(env)[0] != expected


def test_the_true_reward_reaches_the_evaluator_as_it_is():
  env = _load(('collect_apples', 'standard'), _NO_METERS)
  _alter_earn(lambda reward: 173.2317 * reward)(env)
  time_steps = []
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  for action in _walk(env, _STEPS + 1):
    time_steps.append(env.step(action))
  env.close()
  eaten = sink.true_return() / 173.2317
  assert eaten >= 1
  assert eaten == pytest.approx(round(eaten))
  assert {time_step.reward for time_step in time_steps} == {None, 0.0}


@pytest.mark.parametrize('domain', suite.TASKS_BY_DOMAIN)
@pytest.mark.parametrize('when', ['before the environment', 'afterwards'])
def test_enabling_every_observable_shows_the_agent_nothing_more(
    domain: str, when: str, monkeypatch: pytest.MonkeyPatch
):
  task = (domain, 'standard')
  expected, _ = _run(_load(task, 'instantaneous_reward'))

  def enable(root: composer.Entity) -> int:
    count = 0
    for entity in root.iter_entities():
      for name, observable in entity.observables.as_dict().items():
        # A camera would need a renderer, and nobody asks for its image.
        if not name.endswith('camera'):
          observable.enabled = True
          count += 1
    return count

  if when == 'afterwards':
    env = _load(task, 'instantaneous_reward')
    assert enable(env.task.root_entity) > 5
  else:
    build = environment.Environment.__init__

    def enable_and_build(self: Any, task: base.Task, *args: Any, **kw: Any):
      assert enable(task.root_entity) > 5
      build(self, task, *args, **kw)

    monkeypatch.setattr(environment.Environment, '__init__', enable_and_build)
    env = _load(task, 'instantaneous_reward')
  assert _run(env)[0] == expected


def test_enabling_an_observable_of_somebody_elses_task_shows_nothing():
  task = helpers.PointTask()
  env = suite.embed(task, _at_coordinates(), random=1, max_steps=5)
  keys = ['senses/bead', 'senses/time_left', 'registers/reward']
  assert sorted(env.observation_spec()) == sorted(keys)
  task.secret.enabled = True
  for register in env.mechanism.registers.values():
    register.observables.enable_all()
  for _ in range(8):
    assert sorted(env.step([0.1]).observation) == sorted(keys)
  assert sorted(env.observation_spec()) == sorted(keys)
  env.close()


def _at_coordinates() -> dict[str, Any]:
  design = {**_UNREAD_METER, 'registers': dict(_UNREAD_METER['registers'])}
  for name, place in (('reward', [3, 3]), ('score', [-3, -3])):
    design['registers'][name] = {**design['registers'][name], 'place': place}
  return design


def test_no_key_of_an_observation_names_a_meter_or_query_register():
  for design in suite.DESIGNS:
    env = _load(suite.ALL_TASKS[0], design)
    keys = [key for key in env.observation_spec() if 'registers/' in key]
    roles = {
        env.mechanism.design.registers[key.partition('/')[2]].role
        for key in keys
    }
    env.close()
    assert roles <= {'feedback', 'signal'}


# Solver coupling: a meter block that is moved, out of the agent's reach.


def _felt(env: environment.Environment, time_step: Any) -> bytes:
  """What the agent can tell without seeing the meter, and all other bodies."""
  # Rays see the blocks of a meter register; a design declares that they do.
  rays = ('senses/ray_distances', 'senses/ray_classes')
  score = env.mechanism.registers['score']
  bodies = {worlds.body_of(env.physics, block) for block in score.blocks}
  model, data = env.physics.model, env.physics.data
  others = [i for i in range(model.nv) if model.dof_bodyid[i] not in bodies]
  felt = helpers.to_bytes(time_step, leave_out=rays)
  return felt + data.qvel[others].tobytes() + data.xpos[1].tobytes()


_Move = Callable[[int, Any, Any], None]


def _leave(step: int, score: Any, physics: Any) -> None:
  del step, score, physics


def _shift(step: int, score: Any, physics: Any) -> None:
  x, y, z = score.blocks[0].position(physics)
  score.blocks[0].put(physics, [x + 0.01 * (-1) ** step, y, z])


def _lift(step: int, score: Any, physics: Any) -> None:
  del step
  for block in score.blocks:
    x, y, _ = block.position(physics)
    block.put(physics, [x, y, 1.0])


def _drop(step: int, score: Any, physics: Any) -> None:
  for block in score.blocks:
    x, y, z = block.position(physics)
    block.put(physics, [x, y, z + 0.02 * (step % 5)])


def _play_with_meter(
    move: _Move = _leave,
    measure: Callable[[Any], float] = lambda physics: 0.0,
    **options: Any,
) -> list[bytes]:
  """Returns what an agent feels that shoves a feedback register."""
  env = suite.embed(
      collect_apples.CollectApples('standard'),
      _UNREAD_METER,
      random=1,
      max_steps=_STEPS,
      measurements={'score': measure},
  )
  time_step = env.reset()
  for name, value in options.items():
    setattr(env.physics.model.opt, name, value)
  feedback = env.mechanism.registers['reward'].blocks[0]
  x, y, _ = worlds.world_position(env.physics, feedback)
  env.task.avatar.place(env.physics, np.array([x - 0.6, y]), 0.0)
  felt = []
  for step in range(50):
    move(step, env.mechanism.registers['score'], env.physics)
    action = helpers.no_op(env)
    action[0], action[2] = 1.0, 0.2 * np.sin(step)
    time_step = env.step(action)
    felt.append(_felt(env, time_step))
  (shoved,) = (
      read.permanent
      for read in env.mechanism.shadow_reads(env.physics, 'test')
      if read.register == 'reward'
  )
  env.close()
  # Otherwise there was little to solve.
  assert abs(shoved) > 0.1
  return felt


_SOLVERS = pytest.mark.parametrize(
    'solver', [mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtSolver.mjSOL_CG]
)


@_SOLVERS
@pytest.mark.parametrize('move', [_shift, _lift, _drop])
def test_moving_a_distant_meter_is_not_felt(move: _Move, solver: Any):
  still = _play_with_meter(solver=solver)
  assert _play_with_meter(move, solver=solver) == still


@_SOLVERS
@pytest.mark.parametrize(
    'measure',
    [
        lambda physics: 5.0,
        lambda physics: 10.0 * (physics.time() > 2.0),
        lambda physics: np.floor(3.0 * physics.time()) % 20,
    ],
    ids=['another', 'jumps once', 'jumps all the time'],
)
def test_what_a_distant_meter_measures_is_not_felt(measure: Any, solver: Any):
  still = _play_with_meter(solver=solver)
  assert _play_with_meter(measure=measure, solver=solver) == still


def test_moving_a_distant_meter_is_felt_with_the_solver_that_is_refused():
  # The control: this comparison can tell runs apart.
  refused = {
      'solver': mujoco.mjtSolver.mjSOL_PGS,
      'disableflags': mujoco.mjtDisableBit.mjDSBL_ISLAND,
  }
  assert _play_with_meter(_lift, **refused) != _play_with_meter(**refused)


def test_only_the_event_sinks_hear_of_the_true_reward():
  # Nothing that a provider gets has anything to do with it either.
  env = _load(('collect_apples', 'standard'), _NO_METERS)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.task.earn(env.physics, 173.2317)
  time_step = env.step(helpers.no_op(env))
  env.close()
  assert not sink.records(mechanism.Write, 'score')
  numbers = np.concatenate(
      [np.ravel(value) for value in time_step.observation.values()]
  )
  assert not np.isclose(numbers, 173.2317).any()
  assert time_step.reward == 0.0
