"""A batch is its worlds."""

import itertools
from typing import Any

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import batch_physics
from realab_suite.evaluation import ledgers
from realab_suite.tasks import base
from tests import examples
from tests.engine import identity

# The third visit is over, and an episode has ended, with this many steps.
_STEPS = 130
# Several visits, and time to hold and push blocks.
_FEW_STEPS = 60
_REWARD = identity.Case('unlock_door', 'standard', 'instantaneous_reward')
# Registers of the other kinds; a meter that turns a block.
_KINDS = _REWARD._replace(
    overrides=(
        'registers.reward.kind=block_position',
        'registers.score.kind=block_orientation',
    )
)
# A provider draws at random in every step, from a large seed.
_DRAWING = identity.Case(
    'unlock_door',
    'standard',
    'online_imitation',
    ('providers.0.policy=random',),
    2**70,
)


_OVERRIDES: list[tuple[str, ...]] = [
    (), ('channel=secure', 'dof=planar'), ('channel=secure',),
    ('schedule=cfmdp',), ('dof=planar',), (),
]  # fmt: skip
# Every design, with other tasks, channels, freedoms, schedules and threads; in
# the profile `long`, all of their combinations.
_CASES = [
    identity.Case(
        *suite.ALL_TASKS[i % len(suite.ALL_TASKS)],
        design,
        _OVERRIDES[i % len(_OVERRIDES)],
        i,
        num_threads=1 + i % 2,
    )
    for i, design in enumerate(suite.DESIGNS)
]
# The worlds with designs of their own.
_CASES += [
    identity.Case(domain, tasks[0], suite.designs_for(domain)[-1], (), i)
    for i, (domain, tasks) in enumerate(suite.TASKS_BY_DOMAIN.items())
]
if examples.IS_LONG:
  _CASES = [
      identity.Case(*task, design, overrides, seed, num_threads=2)
      for seed, (task, design, overrides) in enumerate(
          itertools.product(suite.ALL_TASKS, suite.DESIGNS, _OVERRIDES)
      )
  ]


@pytest.mark.parametrize(
    'case',
    [*_CASES, _KINDS, _DRAWING],
    ids=lambda case: '-'.join((*case[:3], *case.overrides)),
)
def test_a_batch_equals_its_worlds_with_ledgers_and_state(case):
  assert identity.compare(case, _FEW_STEPS).differences == ()


def test_compared_runs_contain_ends_rewards_and_corruption():
  result = identity.compare(_REWARD, _STEPS)
  assert result.differences == ()
  assert result.num_episodes >= 2 * identity.NUM_ENVS
  assert result.num_terminated > 0
  assert result.num_rewarded > 0
  assert result.num_corrupted > 0
  assert result.num_held > 0


# Whatever is planted in a batch is noticed.


def _differences(steps: int = 10) -> str:
  return '; '.join(identity.compare(_REWARD, steps).differences)


def test_a_sense_of_one_world_that_differs_is_noticed(monkeypatch):
  senses = base.Task.senses

  def sense_carelessly(
      task: Any, physics: Any, names: Any
  ) -> dict[str, np.ndarray]:
    sensed = senses(task, physics, names)
    if isinstance(physics, batch_physics.BatchPhysics):
      position = sensed['position'].copy()
      position[1] = np.nextafter(position[1], np.inf, dtype=position.dtype)
      sensed['position'] = position
    return sensed

  monkeypatch.setattr(base.Task, 'senses', sense_carelessly)
  assert _differences() == "world 1 step 0: ['senses/position']"


def test_a_state_of_one_world_that_differs_is_noticed(monkeypatch):
  advance = batch_physics.BatchPhysics.advance

  def advance_carelessly(physics: Any, num_substeps: int) -> None:
    advance(physics, num_substeps)
    physics.state[2, -1] += 1e-15

  monkeypatch.setattr(batch_physics.BatchPhysics, 'advance', advance_carelessly)
  assert "world 2 step 1: ['state']" in _differences()


@pytest.mark.parametrize('what', ['true_rewards', 'reading'])
def test_a_ledger_of_one_world_that_differs_is_noticed(monkeypatch, what):
  episodes = ledgers.BatchLedger.episodes

  def tell_carelessly(
      ledger: ledgers.BatchLedger, world: int
  ) -> list[ledgers.EpisodeLedger]:
    told = episodes(ledger, world)
    if world == 1 and what == 'true_rewards':
      told[0].true_rewards[-1] += 1e-15
    elif world == 1:
      entries = told[0].entries['score']
      entries[-1] = entries[-1]._replace(reading=-0.0)
    return told

  monkeypatch.setattr(ledgers.BatchLedger, 'episodes', tell_carelessly)
  assert _differences() == 'world 1: ledger'
