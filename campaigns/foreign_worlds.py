"""Tasks of dm_control with a reward register, and policies that solve them."""

from collections.abc import Mapping, Sequence
import contextlib
from typing import Any, Final

from dm_control import manipulation
from dm_control.locomotion import arenas
from dm_control.locomotion import props
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
import dm_env
import labmaze
import mujoco
import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from tests.engine import embedded

MAX_STEPS: Final = 200
"""Length of an episode, in control steps."""

DETOUR: Final = 15
"""Length of a detour, in control steps."""

_REACH_GAIN = 3.0
_TURN_GAIN = 1.5
_TURN_DAMPING = 0.3


def _design(
    name: str, reward: list[float], score: list[float], **blocks: Any
) -> specs.DesignSpec:
  """Returns instantaneous reward with the registers at places in a world."""
  return specs.load(
      {
          'schema': 1,
          'name': name,
          'registers': {
              'reward': {
                  'kind': 'two_block', 'role': 'feedback', 'place': reward,
                  'range': [-1, 2], **blocks,
              },
              'score': {
                  'kind': 'two_block', 'role': 'meter', 'place': score,
                  'range': [0, MAX_STEPS], **blocks,
                  'scale': blocks['scale'] / 100,
              },
          },
          'meters': [{'measures': 'score', 'writes': 'score'}],
          'providers': [
              {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
          ],
          'learner': {
              'kind': 'own',
              'objective': {'kind': 'return', 'registers': {'reward': 1.0}},
          },
      }
  )  # fmt: skip


# Width of a cell of the maze, in metres.
_CELL = 3.0
_MAZE = """
*********
*P  G  G*
* *** * *
*G*  G* *
* * *** *
* *G  *G*
* *** * *
*G  G  P*
*********
"""


def _maze() -> Any:
  return tasks.RepeatSingleGoalMaze(
      walkers.JumpingBallWithHead(),
      arenas.MazeWithTargets(
          maze=labmaze.FixedMazeWithRandomGoals(
              _MAZE.strip() + '\n',
              num_spawns=1,
              num_objects=1,
              random_state=np.random.RandomState(1),
          ),
          xy_scale=_CELL,
      ),
      target=props.TargetSphere(),
      max_repeats=MAX_STEPS,
      physics_timestep=0.005,
      control_timestep=0.05,
  )


DESIGNS: Mapping[str, specs.DesignSpec] = {
    'maze': _design(
        'in_a_maze', [10.1, 0.0], [-10.1, 0.0], scale=0.3, block_size=0.3
    ),
    'manipulation': _design(
        'on_a_table', [0.15, -0.1], [-0.3, -0.1], scale=0.05, block_size=0.06
    ),
}
"""Design of each world."""


def play(
    name: str,
    episodes: int,
    seed: int,
    detours: float,
    share: float | None,
    overrides: Sequence[str] = (),
) -> list[results.EpisodeResult]:
  """Returns the episodes of a solver that is distracted.

  Args:
    name: Name of the world.
    episodes: Number of episodes.
    seed: Seed of the world and the policy.
    detours: Chance of a detour in each step: one random action for a while.
    share: Share of steps with random actions; `None` for an agent at rest.
    overrides: Changes of the design.
  """
  task = manipulation.load('reach_site_features').task
  if name == 'maze':
    task = _maze()
  env = suite.embed(
      embedded.without_cameras(task),
      specs.load(DESIGNS[name], overrides),
      random=seed,
      max_steps=MAX_STEPS,
  )
  solve = _to_goal if name == 'maze' else _reach
  spec, rng = env.action_spec(), np.random.default_rng(seed)
  left, way = 0, np.zeros(spec.shape)

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    nonlocal left, way
    if share is None:
      return np.zeros(spec.shape)
    left = 0 if time_step.first() else left - 1
    anything = rng.uniform(spec.minimum, spec.maximum)
    if left <= 0 and rng.random() < detours:
      left, way = DETOUR, anything
    if left > 0:
      return way
    return anything if rng.random() < share else solve(env)

  with contextlib.closing(env):
    return evaluate.evaluate(env, act, episodes)


def _reach(env: environment.Environment) -> np.ndarray:
  """Returns the joint velocities that bring the hand nearer to the target."""
  physics, task = env.physics, env.task
  point, target = task.hand.tool_center_point, task._target
  away = physics.bind(target).xpos - physics.bind(point).xpos
  jacobian = np.zeros((3, physics.model.nv))
  mujoco.mj_jacSite(
      physics.model.ptr, physics.data.ptr, jacobian, None,
      physics.bind(point).element_id,
  )  # fmt: skip
  joints = physics.bind(task.arm.joints).dofadr
  speeds = np.linalg.pinv(jacobian[:, joints], rcond=0.05) @ (
      _REACH_GAIN * away
  )
  spec = env.action_spec()
  action = np.zeros(spec.shape)
  action[: len(joints)] = speeds
  return np.clip(action, spec.minimum, spec.maximum)


def _to_goal(env: environment.Environment) -> np.ndarray:
  """Returns the action that rolls along the shortest way to the goal."""
  physics, task = env.physics, env.task
  body = physics.bind(task._walker.root_body)
  here = body.xpos[:2]
  goal = physics.bind(task._target.geom).xpos[:2]
  way = _next_place(here, goal) - here
  ahead = body.xmat.reshape(3, 3)[:2, 1]
  angle = np.arctan2(ahead[0] * way[1] - ahead[1] * way[0], ahead @ way)
  roll = max(0.0, np.cos(angle)) ** 3
  return np.clip(
      [-roll, _TURN_DAMPING * body.cvel[2] - _TURN_GAIN * angle, 0.0], -1.0, 1.0
  )


def _next_place(here: np.ndarray, goal: np.ndarray) -> np.ndarray:
  """Returns the middle of the next cell on the shortest way to a goal."""
  rows = _MAZE.strip().splitlines()
  start, end = (_cell(place, rows) for place in (here, goal))
  if start == end:
    return goal
  came = {end: end}
  queue = [end]
  for row, column in queue:
    for near in (
        (row + 1, column), (row - 1, column),
        (row, column + 1), (row, column - 1),
    ):  # fmt: skip
      if near not in came and rows[near[0]][near[1]] != '*':
        came[near] = (row, column)
        queue.append(near)
  row, column = came[start]
  if (row, column) == end:
    return goal
  middle = (len(rows) - 1) / 2
  return _CELL * np.array([column - middle, middle - row])


def _cell(place: np.ndarray, rows: list[str]) -> tuple[int, int]:
  middle = (len(rows) - 1) / 2
  column, row = np.round(place / [_CELL, -_CELL] + middle).astype(int)
  return int(row), int(column)
