"""A batch is its worlds."""

import itertools

import numpy as np
import pytest

from realab_suite import suite
from tests import examples
from tests.engine import identity

# The third visit is over, and an episode has ended, with this many steps.
_STEPS = 130
# Several visits, and time to hold and push blocks.
_FEW_STEPS = 45
_REWARD = identity.Case('unlock_door', 'standard', 'instantaneous_reward')
# Registers of the other kinds; a meter that turns a block.
_KINDS = _REWARD._replace(
    overrides=(
        'registers.reward.kind=block_position',
        'registers.score.kind=block_orientation',
    )
)
# Hands turn blocks.
_TURNS = _REWARD._replace(
    overrides=(
        'dof=planar',
        'registers.reward.kind=block_orientation',
        'registers.score.kind=block_orientation',
    )
)
# A register along no axis of the room.
_TURNED = _REWARD._replace(
    overrides=(
        'dof=planar',
        'registers.reward.place={position: [0.8, -2.5], yaw: 2.3}',
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
# Every design and domain, with other tasks, channels, freedoms, schedules and
# threads; in the profile `long`, all of their combinations.
_PAIRS = [
    *zip(suite.TASKS_BY_DOMAIN, suite.DESIGNS, strict=False),
    *(
        (domain, design)
        for domain in suite.TASKS_BY_DOMAIN
        for design in suite.designs_for(domain)[len(suite.DESIGNS) :]
    ),
]
_CASES = [
    identity.Case(
        domain,
        suite.TASKS_BY_DOMAIN[domain][i % len(suite.TASKS_BY_DOMAIN[domain])],
        design,
        _OVERRIDES[i % len(_OVERRIDES)],
        i,
        num_threads=1 + i % 2,
    )
    for i, (domain, design) in enumerate(_PAIRS)
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


def test_a_batch_with_held_blocks_that_turn_equals_its_worlds():
  result = identity.compare(_TURNS, _STEPS)
  assert result.differences == ()
  assert result.num_held > 0


def test_a_register_along_no_axis_turns_vectors_alike_in_any_number():
  vectors = np.random.default_rng(0).normal(size=(identity.NUM_ENVS, 9, 3))
  env, batch = _TURNED.load(0), _TURNED.load_batch()
  env.reset()
  batch.reset()
  alone, together = (
      one.mechanism.ports['reward'].blocks[0].surroundings
      for one in (env, batch)
  )
  for name in ('in_frame', 'in_world'):
    turned = [getattr(alone, name)(env.physics, one) for one in vectors[:, 0]]
    assert not np.isclose(turned, vectors[:, 0])[:, :2].any()
    for others in range(1, 10):
      crowd = vectors[:, :others].reshape(-1, 3)
      turned_crowd = getattr(together, name)(batch.physics, crowd)
      assert np.array_equal(turned_crowd[::others], turned)


def test_compared_runs_contain_ends_rewards_and_corruption():
  result = identity.compare(_REWARD, _STEPS)
  assert result.differences == ()
  assert result.num_episodes >= 2 * identity.NUM_ENVS
  assert result.num_terminated > 0
  assert result.num_rewarded > 0
  assert result.num_corrupted > 0
  assert result.num_held > 0
