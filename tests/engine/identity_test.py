"""A batch is its worlds."""

import itertools

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


def test_compared_runs_contain_ends_rewards_and_corruption():
  result = identity.compare(_REWARD, _STEPS)
  assert result.differences == ()
  assert result.num_episodes >= 2 * identity.NUM_ENVS
  assert result.num_terminated > 0
  assert result.num_rewarded > 0
  assert result.num_corrupted > 0
  assert result.num_held > 0
