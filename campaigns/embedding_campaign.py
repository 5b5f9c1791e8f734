"""Compares embedded tasks of dm_control with those without registers.

Run from the root of the repository, some minutes on one processor:

    python -m campaigns.embedding_campaign

Two episodes are played of each task in the tables of `docs/embedding.md`, and
of the mazes and corridors of `dm_control.locomotion`. Observations, rewards and
step types are compared with those of the same task without registers. Readings
are compared with the applied values and the parts of corruption. For each task,
a line gives the largest difference of an observation or a reward, and the time
of the processor. Arguments: a scale for the number of steps, and a seed.
"""

from collections.abc import Callable, Iterator
import functools
import time
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import suite as control_suite
from dm_control.locomotion import arenas
from dm_control.locomotion import props
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import seeding
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from tests.engine import embedded

STEPS = 10
EPISODES = 2
# Solvers solve for all bodies together. Tasks of `dm_control.suite` are equal.
LARGEST_DIFFERENCE = 1e-3
MOST_SECONDS = 60.0
_PLACES = ([2.0, 2.0], [2.0, -2.0])
_LARGE_TARGET = 'single goal maze that ends at once'


@final
class Played(NamedTuple):
  """Result of the episodes of a task.

  Attributes:
    difference: Largest difference of an observation or a reward.
    error: Largest difference between a reading and the applied value plus the
      parts of its corruption.
    num_steps: Number of control steps.
    num_reads: Number of reads.
    seconds: Time of the processor, in s.
  """

  difference: float
  error: float
  num_steps: int
  num_reads: int
  seconds: float


def _maze() -> composer.Arena:
  return arenas.RandomMazeWithTargets(
      x_cells=11, y_cells=11, xy_scale=2.0, max_rooms=4, room_min_size=3,
      room_max_size=4, spawns_per_room=1, targets_per_room=2,
  )  # fmt: skip


def _rat_in_maze() -> composer.Task:
  return tasks.ManyGoalsMaze(
      walkers.Rat(),
      arenas.RandomMazeWithTargets(
          x_cells=11, y_cells=11, xy_scale=0.5, z_height=0.3, max_rooms=4,
          room_min_size=4, room_max_size=5, spawns_per_room=1,
          targets_per_room=3,
      ),
      functools.partial(
          props.TargetSphere, radius=0.05, height_above_ground=0.125
      ),
      contact_termination=False,
      physics_timestep=0.001,
      control_timestep=0.02,
  )  # fmt: skip


def _humanoid_in_maze() -> composer.Task:
  return tasks.ManyGoalsMaze(
      walkers.CMUHumanoidPositionControlled(),
      arenas.RandomMazeWithTargets(
          x_cells=11, y_cells=11, xy_scale=3.0, max_rooms=4, room_min_size=4,
          room_max_size=5, spawns_per_room=1, targets_per_room=3,
      ),
      functools.partial(props.TargetSphere, radius=0.4),
      physics_timestep=0.005,
      control_timestep=0.03,
  )  # fmt: skip


_MAZES: dict[str, Callable[[], composer.Task]] = {
    'maze without goals': lambda: tasks.random_goal_maze.NullGoalMaze(
        walkers.JumpingBallWithHead(), _maze()
    ),
    'single goal maze with lesser goals': (
        lambda: tasks.RepeatSingleGoalMazeAugmentedWithTargets(
            walkers.JumpingBallWithHead(), props.TargetSphere(), _maze()
        )
    ),
    'rodent maze forage': _rat_in_maze,
    'humanoid maze forage': _humanoid_in_maze,
}


def _composer_design() -> dict[str, Any]:
  names, roles = ('reward', 'other'), ('feedback', 'signal')
  return {
      'schema': 1,
      'name': 'beside',
      'registers': {
          name: {
              'kind': 'two_block', 'role': role, 'place': place,
              'range': [-2, 12], 'scale': 0.02, 'block_size': 0.1,
          }
          for name, role, place in zip(names, roles, _PLACES, strict=True)
      },
      'providers': [{'kind': 'constant', 'writes': list(names), 'value': 5.0}],
  }  # fmt: skip


def _composer_pair(
    make: Callable[[], composer.Task], seed: int
) -> tuple[Any, Any, np.random.RandomState]:
  """Returns a Composer task without and with registers, and its generator."""
  random_state = seeding.random_state(seed, 0, 0, 'construction')
  stock, task = (embedded.without_cameras(embedded.lucky(make)) for _ in '12')
  return (
      composer.Environment(
          stock, random_state=random_state, strip_singleton_obs_buffer_dim=True
      ),
      suite.embed(task, _composer_design(), random=seed, max_steps=None),
      random_state,
  )


def control_pair(
    domain: str, task: str, seed: int
) -> tuple[Any, Any, np.random.RandomState]:
  """Returns a task of `dm_control.suite` in the same way."""
  random_state = np.random.RandomState(0)
  return (
      control_suite.load(domain, task, task_kwargs={'random': random_state}),
      suite.load(
          f'dm_control/{domain}', task, {'random': seed},
          design=embedded.control_design(domain),
      ),
      random_state,
  )  # fmt: skip


def play(
    pair: Callable[[int], tuple[Any, Any, np.random.RandomState]],
    num_steps: int,
    seed: int,
) -> Played:
  """Plays a task with and without registers.

  Args:
    pair: Function that returns both environments, and the generator of the one
      without registers, from a seed.
    num_steps: Number of steps in each episode, at most.
    seed: Seed.

  Raises:
    ValueError: If step types differ.
  """
  start = time.process_time()
  stock, env, random_state = pair(seed)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  generator = np.random.default_rng(seed)
  spec = stock.action_spec()
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
  difference, error, num_played, num_reads = 0.0, 0.0, 0, 0
  for episode in range(EPISODES):
    seeding.reseed(random_state, seed, 0, episode, 'reset/0')
    expected, found = (embedded.lucky(one.reset) for one in (stock, env))
    difference = max(difference, _difference(expected, found))
    for _ in range(num_steps):
      action = generator.uniform(low, high).astype(spec.dtype)
      expected, found = (
          embedded.lucky(functools.partial(one.step, action))
          for one in (stock, env)
      )
      if expected.step_type != found.step_type:
        raise ValueError(f'{expected.step_type} and {found.step_type}')
      reward = abs(expected.reward - ledger.last.true_rewards[-1])
      difference = max(difference, reward, _difference(expected, found))
      num_played += 1
      if found.last():
        break
    errors = list(_errors(ledger.last))
    num_reads += len(errors)
    error = max(error, *errors)
  env.close()
  stock.close()
  seconds = time.process_time() - start
  return Played(difference, error, num_played, num_reads, seconds)


def _difference(expected: Any, found: Any) -> float:
  """Returns the largest difference between two observations."""
  return max(
      float(np.abs(value - found.observation[f'senses/{name}']).max(initial=0))
      for name, value in expected.observation.items()
  )


def _errors(ledger: ledgers.EpisodeLedger) -> Iterator[float]:
  """Yields what the algebra of each read leaves unexplained."""
  for records in ledger.entries.values():
    applied = np.nan
    for record in records:
      if isinstance(record, registers.Write):
        applied = record.applied
      else:
        parts = record.obstruction + record.permanent + record.temporary
        yield abs(float(record.reading - applied - parts))


def main(scale: float = 1.0, seed: int = 11) -> int:
  """Prints figures and returns the number of targets missed."""
  report = figure_lines.Lines('embedding', seed)
  # Pairs, by name, with the largest difference that is allowed.
  pairs: dict[str, tuple[Any, float]] = {
      f'{domain} {task}': (functools.partial(control_pair, domain, task), 0.0)
      for domain, names in embedded.CONTROL_TASKS.items()
      for task in names
  }
  pairs |= {
      name: (functools.partial(_composer_pair, make), LARGEST_DIFFERENCE)
      for name, make in (embedded.COMPOSER_TASKS | _MAZES).items()
      # Its target is in the way when it is embedded.
      if name != _LARGE_TARGET
  }
  num_steps = max(1, int(STEPS * scale))
  results = []
  for name, (pair, limit) in pairs.items():
    played = play(pair, num_steps, seed)
    report.at_most(f'{name}: difference', played.difference, limit)
    report.at_most(f'{name}: seconds', played.seconds, MOST_SECONDS)
    results.append(played)
  report.at_least('tasks', len(results), 44)
  report.at_most('error of the algebra', max(r.error for r in results), 1e-9)
  report.at_least('reads', sum(r.num_reads for r in results), 1)
  report.at_least('steps', sum(r.num_steps for r in results), 1)
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
