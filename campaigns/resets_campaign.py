"""Campaign C32: whatever design is legal, every episode begins well.

Run from the root of the repository, about five minutes on one processor:

    python -m campaigns.resets_campaign

Designs are drawn at random; of those that are not refused, 500 begin 20
episodes each, in which nothing may be inside anything else. Then beginnings are
made to fail 2,000 times, through `reset` and through `step`, in one world alone
and in one of a batch: whatever comes next has to be the beginning of an
episode. Arguments: a scale for the numbers, and a seed.
"""

import collections
from collections.abc import Callable
from typing import Any, NamedTuple

from dm_control import composer
import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from tests.engine import helpers

SPECS = 500
RESETS = 20
FAILURES = 2_000
DEEPEST = 1e-3  # Metres.
_NUM_ENVS = 3
_MAX_STEPS = 4


class Found(NamedTuple):
  """What beginnings of episodes were like.

  Attributes:
    num_specs: How many designs were legal.
    num_refused: How many were not.
    num_resets: How many episodes were to begin.
    num_failed: How many did not, after all attempts.
    num_penetrating: In how many something was inside something else.
    deepest: How deep, metres.
    worst: Where, in words.
  """

  num_specs: int
  num_refused: int
  num_resets: int
  num_failed: int
  num_penetrating: int
  deepest: float
  worst: tuple[str, ...]


def draw_design(rng: np.random.Generator) -> dict[str, Any]:
  """Draws a design, legal or not."""
  registers = {}
  for i in range(rng.integers(1, 4)):
    kind = rng.choice(['two_block', 'block_position', 'block_orientation'])
    low, high = np.sort(rng.uniform(-3.0, 8.0, 2))
    registers[f'register_{i}'] = {
        'kind': str(kind),
        'role': str(rng.choice(['feedback', 'signal', 'meter'])),
        'place': {
            'position': rng.uniform(-3.9, 3.9, 2).tolist(),
            'yaw': float(rng.uniform(-np.pi, np.pi)),
            'spread': (rng.uniform(0, 0.3, 2) * rng.integers(0, 2)).tolist(),
        },
        'range': [float(low), float(high)],
        'scale': float(rng.uniform(0.01, 0.3)),
        'initial': float(rng.uniform(low, high)),
        'block_size': float(np.exp(rng.uniform(np.log(0.06), 0.0))),
        'mass': float(np.exp(rng.uniform(np.log(0.01), np.log(100.0)))),
        'channel': str(rng.choice(['embedded', 'welded', 'secure'])),
        'dof': str(rng.choice(['free', 'planar'])),
    }
  return {'schema': 1, 'name': 'drawn', 'registers': registers}


def penetration(env: environment.Environment) -> tuple[float, str]:
  """Returns how deep something is in something else, and what in what."""
  data, model = env.physics.data.ptr, env.physics.model
  deepest, what = 0.0, ''
  for contact in data.contact[: data.ncon]:
    if -contact.dist > deepest:
      deepest = float(-contact.dist)
      names = [model.id2name(int(geom), 'geom') for geom in contact.geom]
      what = f'{names[0]} in {names[1]}'
  return deepest, what


def begin_many(
    specs: int,
    resets: int,
    seed: int,
    spoil: Callable[[environment.Environment], Any] = lambda env: None,
) -> Found:
  """Begins episodes of designs that are drawn at random.

  Args:
    specs: Of how many legal designs.
    resets: How many episodes of each.
    seed: From which everything follows.
    spoil: Is called after each reset, for a control.
  """
  rng = np.random.default_rng(seed)
  legal = refused = begun = failed = penetrating = 0
  deepest, worst = 0.0, []
  while legal < specs:
    domain, task = suite.ALL_TASKS[rng.integers(len(suite.ALL_TASKS))]
    design = draw_design(rng)
    try:
      env = suite.load(domain, task, {'random': legal}, design=design)
    except errors.SpecError:
      refused += 1
      continue
    legal += 1
    for _ in range(resets):
      begun += 1
      try:
        env.reset()
      except composer.EpisodeInitializationError:
        failed += 1
        continue
      spoil(env)
      deep, what = penetration(env)
      deepest = max(deepest, deep)
      if deep > DEEPEST:
        penetrating += 1
        worst.append(f'{domain}.{task}: {what}, {deep:.3g} m')
    env.close()
  return Found(
      legal, refused, begun, failed, penetrating, deepest, tuple(worst)
  )


class Failures(NamedTuple):
  """What came of beginnings that failed.

  Attributes:
    num_failed: How many did.
    num_wrong: How many were followed by anything but the beginning of an
      episode.
    num_hidden: How many left an episode of another world that looks sound,
      though a step of it is missing.
    by_step: How many failed in `step`.
  """

  num_failed: int
  num_wrong: int
  num_hidden: int
  by_step: int


def _breakable(task: Any) -> tuple[Any, list[int]]:
  """Makes the next beginnings fail; returns how to mend it, and a counter."""
  begin, failing = task.initialize_episode, [0]

  def initialize(physics: Any, random_state: Any) -> None:
    begin(physics, random_state)
    if failing[0]:
      failing[0] -= 1
      raise composer.EpisodeInitializationError('planted')

  task.initialize_episode = initialize
  return begin, failing


def fail_single(number: int, seed: int) -> Failures:
  """Lets beginnings of one world alone fail."""
  rng = np.random.default_rng(seed)
  env = suite.load(
      'collect_apples', 'near', {'random': seed}, {'max_steps': _MAX_STEPS},
      design='instantaneous_reward',
  )  # fmt: skip
  begin, failing = _breakable(env.task)
  action = helpers.no_op(env)
  counts: collections.Counter[str] = collections.Counter()
  time_step = env.reset()
  while counts['failed'] < number:
    by_step = bool(rng.integers(2))
    while by_step and not time_step.last():
      time_step = env.step(action)
    for _ in range(0 if by_step else rng.integers(_MAX_STEPS)):
      env.step(action)
    # Fewer failures than attempts go unnoticed.
    failing[0] = int(rng.integers(1, 2 * episodes.MAX_RESET_ATTEMPTS))
    is_final = failing[0] >= episodes.MAX_RESET_ATTEMPTS
    try:
      time_step = env.step(action) if by_step else env.reset()
      counts['wrong'] += is_final or not time_step.first()
    except composer.EpisodeInitializationError:
      counts['wrong'] += not is_final
      counts['failed'] += 1
      counts['by_step'] += by_step
      time_step = env.step(action)
      counts['wrong'] += not time_step.first()
  env.task.initialize_episode = begin
  env.close()
  return Failures(counts['failed'], counts['wrong'], 0, counts['by_step'])


def fail_batch(number: int, seed: int) -> Failures:
  """Lets beginnings of one world of a batch fail.

  The large apple ends the episode of one world, the others are in the middle of
  theirs when its next beginning fails.
  """
  rng = np.random.default_rng(seed)
  batch = suite.load_batch(
      'unlock_door', 'near', {'random': seed},
      {'max_steps': 2 * _MAX_STEPS}, num_envs=_NUM_ENVS,
      design='instantaneous_reward',
  )  # fmt: skip
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  begin, failing = _breakable(batch.task)
  actions = np.zeros((_NUM_ENVS, *batch.action_spec().shape))
  wrong = hidden = by_steps = 0
  for _ in range(number):
    by_step = bool(rng.integers(2))
    batch.reset()
    for _ in range(rng.integers(1, _MAX_STEPS)):
      batch.step(actions)
    world = int(rng.integers(_NUM_ENVS))
    if by_step:
      view = batch.physics.world(world)
      side_room = np.array(batch.task.landmarks['side_room'])
      batch.task.avatar.place(view, side_room, 0.0)
      wrong += batch.step(actions).step_type[world] != 2
    failing[0] = episodes.MAX_RESET_ATTEMPTS
    try:
      if by_step:
        batch.step(actions)
      else:
        batch.reset()
      wrong += 1
    except composer.EpisodeInitializationError:
      by_steps += by_step
    last = [ledger.episodes(i)[-1] for i in range(_NUM_ENVS)]
    allowed = events.End.ERROR if by_step else events.End.ABANDONED
    hidden += any(
        episode.end is not allowed
        for i, episode in enumerate(last)
        if not (by_step and i == world)
    )
    wrong += bool(batch.step(actions).step_type.any())
  batch.task.initialize_episode = begin
  batch.close()
  return Failures(number, wrong, hidden, by_steps)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  specs, failures = max(1, int(SPECS * scale)), max(1, int(FAILURES * scale))
  found = begin_many(specs, RESETS, seed)
  for words in found.worst[:5]:
    print(f'# {words}', flush=True)
  report = figure_lines.Lines('C32', seed)
  report.at_least('legal designs', found.num_specs, specs)
  report.at_least('refused designs', found.num_refused, 1)
  report.at_least('resets', found.num_resets, specs * RESETS)
  report.at_most('penetration over 1 mm', found.num_penetrating, 0)
  report.at_most('deepest (m)', found.deepest, DEEPEST)
  report.at_most(
      'final EpisodeInitializationError (%)',
      100 * found.num_failed / found.num_resets,
      0.1,
  )
  for where, fail in (('single', fail_single), ('batch', fail_batch)):
    result = fail(failures, seed)
    report.at_least(f'{where} failures', result.num_failed, failures)
    report.at_least(f'{where} failures in step', result.by_step, failures / 4)
    report.at_most(f'{where} wrong step types', result.num_wrong, 0)
    report.at_most(f'{where} hidden steps', result.num_hidden, 0)
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
