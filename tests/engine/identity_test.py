"""A batch is its worlds: a small part of the campaign `identity`."""

from typing import Any

import numpy as np
import pytest

from campaigns import identity_campaign
from realab_suite import suite
from realab_suite.engine import batch_physics
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from realab_suite.tasks import base

# The third visit is over, and an episode has ended, with this many steps.
_STEPS = 130
# Several visits, and time to hold and push blocks.
_FEW_STEPS = 60
_REWARD = identity_campaign.Case(
    'unlock_door', 'standard', 'instantaneous_reward'
)
# Registers of the other kinds; a meter that turns a block.
_KINDS = _REWARD._replace(
    overrides=(
        'registers.reward.kind=block_position',
        'registers.score.kind=block_orientation',
    )
)
# A provider draws at random in every step, from streams with a salt.
_SALTED = identity_campaign.Case(
    'unlock_door',
    'standard',
    'online_imitation',
    ('providers.0.policy=random',),
    seeding.SaltedSeed(0, bytes(range(seeding.NUM_SALT_BYTES))),
)


# A batch is its worlds.


_OVERRIDES = [
    (), ('channel=secure', 'dof=planar'), ('channel=welded',),
    ('schedule=cfmdp',), ('dof=planar',), (),
]  # fmt: skip
# Every design, with other tasks, channels, freedoms, schedules and threads.
_CASES = [
    identity_campaign.Case(
        *suite.ALL_TASKS[i % len(suite.ALL_TASKS)],
        design,
        _OVERRIDES[i % len(_OVERRIDES)],
        i,
        num_threads=1 + i % 2,
    )
    for i, design in enumerate(suite.DESIGNS)
]


@pytest.mark.parametrize(
    'case',
    [*_CASES, _KINDS, _SALTED],
    ids=lambda case: '-'.join(
        (*case[:3], *case.overrides, type(case.seed).__name__)
    ),
)
def test_a_batch_equals_its_worlds_with_ledgers_and_state(case):
  assert identity_campaign.compare(case, _FEW_STEPS).differences == ()


def test_compared_runs_contain_ends_rewards_and_corruption():
  result = identity_campaign.compare(_REWARD, _STEPS)
  assert result.differences == ()
  assert result.num_episodes >= 2 * identity_campaign.NUM_ENVS
  assert result.num_terminated > 0
  assert result.num_rewarded > 0
  assert result.num_corrupted > 0
  assert result.num_held > 0


def test_the_campaign_compares_every_task_and_design():
  cases = identity_campaign.tasks_and_designs(seeds=3)
  num_cases = 3 * len(suite.ALL_TASKS) * len(suite.DESIGNS)
  assert len(set(cases)) == len(cases) == num_cases >= 3 * 8 * 5


# Whatever is planted in a batch is noticed.


def _differences(steps: int = 10) -> str:
  return '; '.join(identity_campaign.compare(_REWARD, steps).differences)


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
