"""Inspections in worlds: alike in one and in many, and after snapshots."""

import pytest

from campaigns import snapshot_campaign
from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.lab import agents
from realab_suite.lab.experiments import experiment_specs
from tests.engine import helpers
from tests.engine import identity

pytestmark = pytest.mark.slow

# Everything that draws, remembers or looks.
_OPTIONS = (
    'providers.0.period=2', 'providers.0.probability=0.6',
    'providers.0.false_positives=0.3', 'providers.0.false_negatives=0.3',
    'providers.0.lasts=5', 'providers.0.penalty=0.5',
    'providers.0.suspects=meter_a', 'providers.0.plausible=[0.5, 4]',
    'meters.1.measures={kind: detector, of: [reward, budget, meter],'
    ' sight: {eye: avatar, range: 3}}',
)  # fmt: skip


@pytest.mark.parametrize('channel', ['embedded', 'secure'])
def test_a_batch_equals_its_worlds(channel: str):
  case = identity.Case(
      'unlock_door', 'near', 'inspected_reward',
      (*_OPTIONS, f'channel={channel}', 'registers.budget.initial=8'), 4,
  )  # fmt: skip
  result = identity.compare(case, 60)
  assert result.differences == ()
  assert result.num_corrupted > 0 or channel == 'secure'


@pytest.mark.parametrize('way', ['batch to alone', 'fork'])
def test_a_restored_world_is_inspected_as_before(way: str):
  case = snapshot_campaign.Case('unlock_door', 'inspected_reward', _OPTIONS, 7)
  assert snapshot_campaign.WAYS[way](case, 12, 30) == 0


def test_it_loads_in_every_world_with_stations():
  for i, task in enumerate(suite.ALL_TASKS):
    channel = ('embedded', 'secure')[i // 2 % 2]
    env = suite.load(
        *task, design='inspected_reward',
        overrides=(
            f'channel={channel}', f'dof={("free", "planar")[i % 2]}',
            'meters.1.measures.sight={eye: [0, 0, 2]}',
        ),
    )  # fmt: skip
    # One write sets both ports of the meter.
    both = [] if channel == 'secure' else ['meter_a', 'meter_b']
    assert env.mechanism.obstructible == both
    env.reset()
    env.step(helpers.no_op(env))
    env.close()


_RESPONSES = {
    'fine, by the learner': ('learner.defence.fine=5',),
    'penalty, by the provider': (
        'learner.defence=null', 'providers.0.penalty=5',
    ),
    'end': (
        'learner.defence=null', 'registers.alarm.ends_episode={above: 0.5}',
    ),
}  # fmt: skip


@pytest.mark.parametrize('name', _RESPONSES)
def test_each_response_is_a_few_overrides(name: str):
  design = specs.load('inspected_reward', _RESPONSES[name])
  for one in (design, experiment_specs.secure_twin(design)):
    batch = suite.load_batch(
        'collect_apples', 'standard', num_envs=2, design=one
    )
    learner = agents.make(
        one.learner, batch.observation_spec(), batch.action_spec(), 2, 1
    )
    time_step = batch.reset()
    for _ in range(3):
      time_step = batch.step(learner.step(time_step))
    batch.close()
    assert one.objective is not None
    assert one.objective.registers == {'reward': 1.0}


@pytest.mark.parametrize('moved', [0.0, 5.0])
def test_a_penalty_of_the_provider_ends_at_the_range_of_the_register(
    moved: float,
):
  env = suite.load(
      'collect_apples', 'standard', {'random': 1}, design='inspected_reward',
      overrides=(
          'learner.defence=null', 'providers.0.penalty=50',
          'providers.0.period=1', 'providers.0.false_positives=0.999999',
      ),
  )  # fmt: skip
  env.reset()
  registers = env.mechanism.registers
  base = registers['reward'].blocks[0]
  position = base.position(env.physics) - [0.1 * moved, 0, 0]
  base.put(env.physics, position)
  time_step = env.step(helpers.no_op(env))
  observation = time_step.observation
  assert observation['registers/alarm'] == pytest.approx(1.0, abs=0.01)
  # 50 less than 0 is below the range, [-2, 12].
  reading = observation['registers/reward']
  assert reading == pytest.approx(moved - 2.0, abs=0.05)
  env.close()
