"""Tasks that tests and a campaign embed, and what Composer makes of them."""

from collections.abc import Callable
import functools
from typing import Any

from dm_control import composer
from dm_control import manipulation
from dm_control.composer.variation import distributions
from dm_control.locomotion import arenas
from dm_control.locomotion import props
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
from dm_control.manipulation.shared import registry
import dm_env
import mujoco
import numpy as np

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from tests.engine import helpers

_SEED = 11
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS) | int(
    mujoco.mjtState.mjSTATE_WARMSTART
)


def lucky(call: Callable[[], Any], seed: int = 5) -> Any:
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
COMPOSER_TASKS: dict[str, Callable[[], composer.Task]] = {
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


def without_cameras(task: composer.Task) -> composer.Task:
  """Disables the cameras of a task, and returns it."""
  for name, observable in task.observables.items():
    if 'camera' in name:
      observable.enabled = False
  return task


def make_composer(name: str) -> composer.Task:
  """Returns a new task of `COMPOSER_TASKS`, without cameras."""
  return without_cameras(lucky(COMPOSER_TASKS[name]))


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


def _state(physics: Any, num_own: int) -> list[bytes]:
  """Returns the state of a world, with a number of its own userdata."""
  state = np.empty(mujoco.mj_stateSize(physics.model.ptr, _STATE))
  mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, _STATE)
  return [state.tobytes(), physics.data.userdata[:num_own].tobytes()]


def assert_identical(
    make: Callable[[], composer.Task], num_steps: int, num_episodes: int = 2
) -> list[int]:
  """Plays a task both ways; returns the step types that came up."""
  random_state = seeding.random_state(_SEED, 0, 0, 'construction')
  stock = composer.Environment(
      make(), random_state=random_state, strip_singleton_obs_buffer_dim=True
  )
  env = suite.embed(make(), 'none', random=_SEED, max_steps=None)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  generator = np.random.default_rng(0)
  seen = []
  for episode in range(num_episodes):
    seeding.reseed(random_state, _SEED, 0, episode, 'reset/0')
    expected, time_step = lucky(stock.reset), lucky(env.reset)
    assert _bytes(time_step, None) == _bytes(expected, None)
    expected_spec = stock.observation_spec()
    assert env.observation_spec() == {
        f'senses/{key}': value.replace(name=f'senses/{key}')
        for key, value in expected_spec.items()
    }
    spec = stock.action_spec()
    assert env.action_spec() == spec
    low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
    for _ in range(num_steps):
      action = generator.uniform(low, high).astype(spec.dtype)
      expected, time_step = (
          lucky(functools.partial(one.step, action)) for one in (stock, env)
      )
      reward = ledger.last.true_rewards[-1]
      assert _bytes(time_step, reward) == _bytes(expected, expected.reward)
      assert time_step.reward == 0.0
      num_own = stock.physics.model.nuserdata
      assert _state(env.physics, num_own) == _state(stock.physics, num_own)
      seen.append(int(time_step.step_type))
      if time_step.last():
        break
    assert time_step.last() == (ledger.last.end is events.End.TERMINATED)
  stock.close()
  env.close()
  return seen
