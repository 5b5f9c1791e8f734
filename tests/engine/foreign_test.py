"""An embedded task of dm_control gives what `composer.Environment` gives."""

from collections.abc import Callable
import functools
from typing import Any

from dm_control import composer
from dm_control import manipulation
from dm_control.composer.variation import distributions
from dm_control.locomotion import arenas
from dm_control.locomotion import props
from dm_control.locomotion import soccer
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
from dm_control.manipulation.shared import registry
import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from tests.engine import helpers

_SEED = 11
_REGISTER = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': [3.0, 3.0],
    'range': [-2, 12],
}


def _lucky(call: Callable[[], Any], seed: int = 5) -> Any:
  """Returns the result of a call, with a seeded global generator."""
  np.random.seed(seed)  # noqa: NPY002
  return call()


def _maze() -> composer.Arena:
  return arenas.RandomMazeWithTargets(
      x_cells=7,
      y_cells=7,
      xy_scale=1.0,
      max_rooms=2,
      room_min_size=3,
      room_max_size=3,
      spawns_per_room=1,
      targets_per_room=2,
  )


def _single_goal(**kwargs: Any) -> composer.Task:
  return tasks.RepeatSingleGoalMaze(
      walkers.JumpingBallWithHead(), _maze(), **kwargs
  )


def _many_goals(kind: Any, **kwargs: Any) -> composer.Task:
  return kind(
      walkers.Ant(),
      _maze(),
      target_builder=functools.partial(props.TargetSphere, radius=0.2),
      **kwargs,
  )


def _corridor(arena: composer.Arena, walker: Any, **kwargs: Any) -> Any:
  return tasks.RunThroughCorridor(
      walker,
      arena,
      walker_spawn_position=(0.5, 0, 0),
      physics_timestep=0.005,
      control_timestep=0.03,
      **kwargs,
  )


def _manipulation(name: str) -> Any:
  assert name in manipulation.ALL
  return registry.get_constructor(name)


# Tasks by name: walkers of five kinds, arenas that stay and arenas that are
# generated anew, arms, props, targets, episodes that the task ends.
_TASKS: dict[str, Callable[[], composer.Task]] = {
    'go to target': lambda: tasks.GoToTarget(
        walkers.RollingBallWithHead(), arenas.Floor(size=(8, 8))
    ),
    'go to a moving target': lambda: tasks.GoToTarget(
        walkers.Ant(), arenas.Floor(size=(8, 8)), moving_target=True
    ),
    'walls corridor': lambda: _corridor(
        arenas.WallsCorridor(
            wall_gap=4.0,
            wall_width=distributions.Uniform(1, 3),
            wall_height=2.0,
            corridor_width=6,
            corridor_length=20,
        ),
        walkers.Ant(),
    ),
    'single goal maze that ends at once': lambda: _single_goal(
        target=props.TargetSphere(radius=4.0, height_above_ground=0.0)
    ),
    'gaps corridor': lambda: _corridor(
        arenas.GapsCorridor(
            platform_length=distributions.Uniform(0.3, 2.5),
            gap_length=distributions.Uniform(0.5, 1.5),
            corridor_width=6,
            corridor_length=20,
        ),
        walkers.JumpingBallWithHead(),
    ),
    'humanoid in a corridor': lambda: _corridor(
        arenas.EmptyCorridor(corridor_width=6, corridor_length=20),
        walkers.CMUHumanoidPositionControlled(),
        contact_termination=True,
    ),
    'two touch': lambda: tasks.TwoTouch(
        walkers.Rat(),
        arenas.Floor(size=(10.0, 10.0)),
        target_builders=[
            functools.partial(props.TargetSphereTwoTouch, radius=0.025)
        ],
        randomize_spawn_rotation=True,
        target_type_rewards=[25.0],
        shuffle_target_builders=False,
        target_area=(1.5, 1.5),
        physics_timestep=0.001,
        control_timestep=0.02,
    ),
    'single goal maze': _single_goal,
    'single goal maze that respawns': lambda: _single_goal(
        max_repeats=2, regenerate_maze_on_repeat=False
    ),
    'many goals maze': lambda: _many_goals(tasks.ManyGoalsMaze),
    'heterogeneous goals maze': lambda: tasks.ManyHeterogeneousGoalsMaze(
        walkers.Ant(),
        _maze(),
        target_builders=[
            functools.partial(props.TargetSphere, radius=radius)
            for radius in (0.1, 0.2)
        ],
        target_type_rewards=[30.0, -10.0],
        target_type_proportions=[1, 1],
    ),
    'reach a site': _manipulation('reach_site_features'),
    'reach a brick': _manipulation('reach_duplo_features'),
    'lift a brick': _manipulation('lift_brick_features'),
    'stack bricks': _manipulation('stack_2_bricks_features'),
    'place a brick': _manipulation('place_brick_features'),
    'place in a cradle': _manipulation('place_cradle_features'),
    'lift a large box': _manipulation('lift_large_box_features'),
    'reassemble bricks': _manipulation(
        'reassemble_3_bricks_fixed_order_features'
    ),
    'stack on a movable base': _manipulation(
        'stack_2_bricks_moveable_base_features'
    ),
    'a bead on a wire': helpers.PointTask,
}


def _without_cameras(task: composer.Task) -> composer.Task:
  for name, observable in task.observables.items():
    if 'camera' in name:
      observable.enabled = False
  return task


def _make(name: str) -> composer.Task:
  return _without_cameras(_lucky(_TASKS[name]))


def _composer(task: composer.Task) -> tuple[composer.Environment, Any]:
  random_state = seeding.random_state(_SEED, 0, 0, 'construction')
  stock = composer.Environment(
      task, random_state=random_state, strip_singleton_obs_buffer_dim=True
  )
  return stock, random_state


def _bytes(time_step: dm_env.TimeStep, reward: Any) -> list[Any]:
  """Returns all of a time step, with its reward, canonically."""
  discount = time_step.discount
  return [
      int(time_step.step_type),
      None if reward is None else np.float64(reward).tobytes(),
      None if discount is None else np.float64(discount).tobytes(),
      {
          key.removeprefix('senses/'): (
              np.asarray(value).dtype.str,
              np.shape(value),
              np.asarray(value).tobytes(),
          )
          for key, value in time_step.observation.items()
      },
  ]


def _assert_identical(
    make: Callable[[], composer.Task], num_steps: int, num_episodes: int = 2
) -> list[int]:
  """Plays a task both ways; returns the step types that came up."""
  stock, random_state = _composer(make())
  env = suite.embed(make(), 'none', random=_SEED, max_steps=None)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  expected_spec = stock.observation_spec()
  found_spec = env.observation_spec()
  assert set(found_spec) == {f'senses/{key}' for key in expected_spec}
  generator = np.random.default_rng(0)
  spec = stock.action_spec()
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
  seen = []
  for episode in range(num_episodes):
    seeding.reseed(random_state, _SEED, 0, episode, 'reset/0')
    expected, found = _lucky(stock.reset), _lucky(env.reset)
    assert _bytes(found, None) == _bytes(expected, None)
    for _ in range(num_steps):
      action = generator.uniform(low, high).astype(spec.dtype)
      expected, found = (
          _lucky(functools.partial(one.step, action)) for one in (stock, env)
      )
      reward = ledger.last.true_rewards[-1]
      assert _bytes(found, reward) == _bytes(expected, expected.reward)
      assert found.reward == 0.0
      seen.append(int(found.step_type))
      if found.last():
        break
    assert found.last() == (ledger.last.end is events.End.TERMINATED)
  stock.close()
  env.close()
  return seen


@pytest.mark.parametrize('name', _TASKS)
def test_an_embedded_task_equals_composer_bit_for_bit(name: str):
  assert _assert_identical(functools.partial(_make, name), num_steps=15)


@pytest.mark.parametrize(
    'name', ['humanoid in a corridor', 'single goal maze that ends at once']
)
def test_episodes_that_the_task_ends_end_as_in_composer(name: str):
  seen = _assert_identical(functools.partial(_make, name), num_steps=400)
  assert 2 in seen


def _small_actions(env: Any, number: int) -> list[np.ndarray]:
  spec = env.action_spec()
  generator = np.random.default_rng(0)
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
  return [generator.uniform(low, high) for _ in range(number)]


# Places of registers at which nothing touches them, where [3, 3] is none, and
# scales at which their values fit there. The first cell of a maze is free.
_PLACES = {
    'walls corridor': ([4.0, 2.0], 0.05),
    'humanoid in a corridor': ([4.0, 2.0], 0.05),
    'single goal maze': ([0.0, 0.0], 0.01),
    'single goal maze that respawns': ([0.0, 0.0], 0.01),
}
# When the task is embedded, its large target is in the way.
_WITHOUT_REGISTERS = {'single goal maze that ends at once'}


@pytest.mark.parametrize(
    'name', [name for name in _TASKS if name not in _WITHOUT_REGISTERS]
)
def test_what_a_task_observes_does_not_depend_on_registers_nearby(name: str):
  place, scale = _PLACES.get(name, ([3.0, 3.0], 0.1))
  register = _REGISTER | {'place': place, 'scale': scale}
  design: Any = {
      'schema': 1,
      'name': 'd',
      'registers': {'r': register},
      'providers': [{'kind': 'constant', 'writes': ['r'], 'value': 1.0}],
  }
  found: list[list[Any]] = []
  for with_register in (False, True):
    env = suite.embed(
        _make(name),
        design if with_register else 'none',
        random=_SEED,
        max_steps=None,
    )
    ledger = ledgers.Ledger()
    env.add_sink(ledger)
    actions = _small_actions(env, 6)
    time_steps = [_lucky(env.reset)]
    time_steps += [
        _lucky(functools.partial(env.step, action)) for action in actions
    ]
    found.append([t.observation for t in time_steps])
    rewards = ledger.last.true_rewards
    found[-1].append({'senses/reward': np.array(rewards)})
    env.close()
  for bare, beside in zip(*found, strict=True):
    for key, value in bare.items():
      np.testing.assert_allclose(
          beside[key], value, rtol=1e-3, atol=1e-3, err_msg=key
      )


def test_the_table_of_the_documentation_lists_the_tested_tasks():
  rows = [
      row
      for row in helpers.rows_of_page('embedding.md', 'equal, bit for bit', 3)
      if row[1] == 'equal, bit for bit'
  ]
  assert [row[0] for row in rows] == list(_TASKS)
  tested = {row[0] for row in rows if row[2] == 'within 1e-3'}
  assert tested == set(_TASKS) - _WITHOUT_REGISTERS


def test_a_task_with_several_agents_is_refused():
  with pytest.raises(errors.SpecError, match='has 2 agents'):
    suite.embed(soccer.load(team_size=1).task, 'none')


class _Curious(events.EventSink):
  """Reads what derives from the state, at every opportunity."""

  def __init__(self, env: Any) -> None:
    root = env.task.root_entity.mjcf_model
    self._bodies = root.find_all('body')
    self.num_looks = 0

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self._look(physics)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self._look(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _look(self, physics: Any) -> None:
    assert np.isfinite(physics.bind(self._bodies).xpos).all()
    self.num_looks += 1


@pytest.mark.parametrize('name', ['go to target', 'walls corridor'])
@pytest.mark.parametrize('with_register', [False, True])
def test_a_sink_that_looks_changes_nothing(name: str, with_register: bool):
  design: Any = {'schema': 1, 'name': 'd'}
  if with_register:
    place, scale = _PLACES.get(name, ([3.0, 3.0], 0.1))
    register = _REGISTER | {'place': place, 'scale': scale}
    design['registers'] = {'r': register}
    design['providers'] = [{'kind': 'constant', 'writes': ['r'], 'value': 1.0}]

  def play(is_watched: bool) -> list[bytes]:
    env = suite.embed(_make(name), design, random=2, max_steps=None)
    if is_watched:
      sink = _Curious(env)
      env.add_sink(sink)
    actions = helpers.random_actions(env, 20)
    found = [helpers.to_bytes(_lucky(env.reset))]
    found += [helpers.to_bytes(env.step(action)) for action in actions]
    env.close()
    assert not is_watched or sink.num_looks == 21
    return found

  assert play(is_watched=True) == play(is_watched=False)


@pytest.mark.parametrize('channel', ['embedded', 'welded', 'secure'])
def test_a_write_holds_in_a_task_that_composer_steps(channel: str):
  design: Any = {
      'schema': 1,
      'name': 'd',
      'channel': channel,
      'registers': {'r': _REGISTER},
      'providers': [{'kind': 'constant', 'writes': ['r'], 'value': 7.0}],
  }
  env = suite.embed(_make('go to target'), design, random=2, max_steps=None)
  env.reset()
  for action in helpers.random_actions(env, 20):
    reading = env.step(action).observation['registers/r']
    np.testing.assert_allclose(reading, 7.0, atol=1e-6)
