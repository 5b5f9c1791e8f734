"""Demonstrations of, and advice on, actions that are vectors."""

import itertools
from typing import Any

from dm_control import suite as control_suite
from dm_env import specs as dm_env_specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.feedback import continuous_designs
from realab_suite.feedback import specs
from tests.engine import helpers

# Balances the pole of `cartpole`, beginning near the upright position.
_BALANCE = {
    'gains': {'position': [[0.5, 0.0, 3.0]], 'velocity': [[0.5, 1.0]]},
}  # fmt: skip
# Turns of the arm of `reacher`, from a sense with two elements.
_DAMP = {'gains': {'velocity': [[-0.3, 0.1], [0.0, -0.2]]}, 'offset': [0.5, 0]}
# The six controls of an avatar, from its velocity.
_WALK = {
    'gains': {'velocity': [[0.1 * i, -0.1, 0.2] for i in range(6)]},
    'offset': [0.5, 0.1, -0.3, 0.0, 0.0, 0.0],
}


def _cartpole(**overrides: Any) -> Any:
  task = control_suite.load('cartpole', 'balance')
  design = continuous_designs.demonstration(
      task.action_spec(), 'linear', _BALANCE
  )
  return suite.embed(task, design | overrides, random=1, max_steps=60)


def _follow(env: Any) -> list[Any]:
  """Takes demonstrated actions, as read, until an episode ends."""
  time_steps = [env.reset()]
  while not time_steps[-1].last():
    action = continuous_designs.action(
        time_steps[-1].observation, env.action_spec()
    )
    time_steps.append(env.step(action))
  return time_steps


def _assert_algebra(env: Any, sink: helpers.RecordingSink) -> None:
  """Readings are applied values plus the parts of corruption."""
  applied: dict[str, Any] = {}
  num_reads = 0
  for record in (r for step in sink.steps for r in step.records):
    if isinstance(record, registers.Write):
      applied[record.register] = record.applied
    elif record.register in applied:
      parts = record.obstruction + record.permanent + record.temporary
      np.testing.assert_allclose(
          record.reading, applied[record.register] + parts, atol=1e-12
      )
      num_reads += 1
  assert num_reads == len(sink.steps) * len(env.mechanism.registers)


@pytest.mark.parametrize('channel', ['embedded', 'secure'])
def test_an_agent_that_follows_demonstrations_balances_a_pole(channel: str):
  env, sink, ledger = (
      _cartpole(channel=channel), helpers.RecordingSink(), ledgers.Ledger(),
  )  # fmt: skip
  env.add_sink(sink)
  env.add_sink(ledger)
  time_steps = _follow(env)
  assert np.sum(ledger.last.true_rewards) > 58.0
  _assert_algebra(env, sink)
  # What is read is the controller's action for the observation before.
  controller = policies.make_controller('linear', **_BALANCE)
  for before, after in itertools.pairwise(time_steps):
    demonstrated, _ = controller.step(
        before.observation, np.False_, np.zeros(2), ()
    )
    np.testing.assert_allclose(
        after.observation['registers/demonstration_0'],
        np.clip(demonstrated[0], -1.0, 1.0),
        atol=0.0 if channel == 'secure' else 1e-6,
    )
  env.close()


def test_the_same_agent_fails_once_a_block_has_moved():
  env, ledger = _cartpole(), ledgers.Ledger()
  env.add_sink(ledger)
  time_step = env.reset()
  (register,) = env.mechanism.registers.values()
  base = register.blocks[0]
  # By 1.5 units: every reading is too high from now on.
  place = base.position(env.physics) - [1.5 * register.scale, 0.0, 0.0]
  base.put(env.physics, place)
  while not time_step.last():
    action = continuous_designs.action(time_step.observation, env.action_spec())
    time_step = env.step(action)
  assert np.sum(ledger.last.true_rewards) < 45.0
  read = register.inspect(env.physics)
  np.testing.assert_allclose(read.permanent, 1.5, atol=1e-3)
  env.close()


def test_the_secure_twin_has_no_corruption_at_all():
  env, sink = _cartpole(channel='secure'), helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  (register,) = env.mechanism.registers.values()
  register.blocks[0].put(env.physics, [-1.0, 0.0, 0.1])
  env.step([0.0])
  for read in sink.records(registers.Read, 'demonstration_0'):
    assert read.reading == register.applied(env.physics)
    assert (read.obstruction, read.permanent, read.temporary) == (0, 0, 0)
  env.close()


def test_there_is_a_register_for_each_element():
  task = control_suite.load('reacher', 'easy')
  design = continuous_designs.demonstration(
      task.action_spec(), 'linear', _DAMP, place=(2.0, 0.0)
  )
  env, sink = suite.embed(task, design, random=1), helpers.RecordingSink()
  env.add_sink(sink)
  observation = env.reset().observation
  for action in helpers.random_actions(env, 5):
    gains = np.array(_DAMP['gains']['velocity'])
    expected = gains @ observation['senses/velocity'] + _DAMP['offset']
    observation = env.step(action).observation
    found = [float(observation[f'registers/demonstration_{i}']) for i in (0, 1)]
    np.testing.assert_allclose(found, np.clip(expected, -1.0, 1.0), atol=1e-6)
  _assert_algebra(env, sink)
  env.close()


def test_six_registers_fit_beside_a_cheetah_and_its_actions_may_be_far_off():
  spec = dm_env_specs.BoundedArray(
      (6,), np.float64, [-1.0] * 5 + [-np.inf], 1.0
  )
  design = continuous_designs.demonstration(
      spec, 'linear', {'gains': {}, 'offset': [0, 1, 2, -3, 4, -5.0]}
  )
  env, sink = helpers.embed(helpers.PointTask(), design, max_steps=3)
  env.reset()
  observation = env.step([0.0]).observation
  found = continuous_designs.action(observation, spec)
  np.testing.assert_allclose(found, [0, 1, 1, -1, 1, -1], atol=1e-6)
  written = sink.records(registers.Write, 'demonstration_3')
  assert (written[0].requested, written[0].applied) == (-3.0, -1.0)


def _door(make: Any, **overrides: Any) -> dict[str, Any]:
  spec = suite.load('unlock_door', 'near', {'random': 1}).action_spec()
  # Registers in two columns of the room.
  return make(spec, 'linear', _WALK, place=(-3.2, -1.8)) | overrides


@pytest.mark.parametrize(
    'make', [continuous_designs.demonstration, continuous_designs.advice]
)
def test_a_world_of_this_package_continues_from_a_snapshot(make: Any):
  env = suite.load('unlock_door', 'near', {'random': 3}, design=_door(make))
  env.reset()
  actions = helpers.random_actions(env, 12)
  for action in actions[:6]:
    env.step(action)
  snapshot = env.save()
  expected = [helpers.to_bytes(env.step(action)) for action in actions[6:]]
  env.restore(snapshot)
  assert [helpers.to_bytes(env.step(a)) for a in actions[6:]] == expected


def test_a_batch_equals_single_worlds():
  design = _door(continuous_designs.demonstration)
  batch = suite.load_batch(
      'unlock_door', 'near', {'random': 3}, num_envs=2, design=design
  )
  single = suite.load(
      'unlock_door', 'near', {'random': 3}, {'world': 1}, design=design
  )
  assert isinstance(batch, batch_environment.BatchEnvironment)
  batch.reset()
  single.reset()
  for action in helpers.random_actions(single, 5):
    both = batch.step(np.tile(action, (2, 1))).observation
    for key, value in single.step(action).observation.items():
      np.testing.assert_array_equal(both[key][1], value, err_msg=key)
  batch.close()


def test_advice_judges_the_query_that_is_read():
  task = control_suite.load('reacher', 'easy')
  design = continuous_designs.advice(
      task.action_spec(), 'linear', {'gains': {}, 'offset': [0.5, -0.5]},
      place=(2.0, 0.0),
  )  # fmt: skip
  env, sink = suite.embed(task, design, random=1), helpers.RecordingSink()
  env.add_sink(sink)
  assert env.action_spec().name.split('\t') == [
      'query/query_0', 'query/query_1', 'shoulder', 'wrist',
  ]  # fmt: skip
  env.reset()

  def advice(query: Any) -> float:
    time_step = env.step([*query, 0.0, 0.0])
    return float(time_step.observation['registers/advice'])

  farthest = np.hypot(2.0, 2.0)
  for query in ([0.5, -0.5], [0.5, 0.5], [-1.0, 1.0]):
    distance = np.linalg.norm(np.subtract(query, [0.5, -0.5]))
    expected = 1.0 - 2.0 * distance / farthest
    assert advice(query) == pytest.approx(expected, abs=1e-6)
  # A base block that was moved makes the adviser read another query.
  register = env.mechanism.registers['query_1']
  base = register.blocks[0]
  shift = [register.scale, 0.0, 0.0]
  base.put(env.physics, base.position(env.physics) + shift)
  assert advice([0.5, 0.5]) == pytest.approx(1.0, abs=1e-4)
  _assert_algebra_of_queries(sink)
  env.close()


def _assert_algebra_of_queries(sink: helpers.RecordingSink) -> None:
  reads = sink.records(registers.Read, 'query_1')
  writes = sink.records(registers.Write, 'query_1')
  for read, write in zip(reads, writes, strict=True):
    parts = read.obstruction + read.permanent + read.temporary
    np.testing.assert_allclose(read.reading, write.applied + parts, atol=1e-12)
  assert abs(reads[-1].permanent) == pytest.approx(1.0, abs=1e-4)


_SPEC = dm_env_specs.BoundedArray((2,), np.float64, -1.0, 1.0)


@pytest.mark.parametrize(
    ('make', 'options', 'reason'),
    [
        (
            continuous_designs.demonstration,
            {'gains': {'velocity': [[1.0]]}},
            r'writes: 2 registers; allowed are 1',
        ),
        (
            continuous_designs.advice,
            {'gains': {}, 'offset': [0.0] * 3},
            r'reads: 2 registers; allowed are 3',
        ),
        (
            continuous_designs.demonstration,
            {'gains': {'velocity': [[1.0], [1.0, 2.0]]}},
            r'gains\.velocity.*a matrix with a row for each',
        ),
        (
            continuous_designs.demonstration,
            {'gains': {'velocity': [[1.0]]}, 'offset': [0.0, 0.0]},
            r'\[1, 2\] rows',
        ),
    ],
)
def test_designs_that_do_not_fit_the_controller_are_refused(
    make: Any, options: Any, reason: str
):
  with pytest.raises(errors.SpecError, match=reason):
    specs.load(make(_SPEC, 'linear', options))


def test_advice_needs_query_registers():
  design = continuous_designs.advice(
      _SPEC, 'linear', {'gains': {}, 'offset': [0.0, 0.0]}
  )
  design['registers']['query_0']['role'] = 'feedback'
  with pytest.raises(errors.SpecError, match="'query_0', whose role is"):
    specs.load(design)


def test_a_matrix_for_a_sense_of_another_size_is_refused():
  design = continuous_designs.demonstration(
      _SPEC, 'linear', {'gains': {'velocity': [[1.0] * 3] * 2}}
  )
  env = suite.load('dm_control/reacher', 'easy', {'random': 1}, design=design)
  env.reset()
  with pytest.raises(
      errors.FeedbackProviderError, match=r'gains\.velocity: 3 columns'
  ):
    env.step([0.0, 0.0])


@pytest.mark.parametrize(
    'spec',
    [
        dm_env_specs.DiscreteArray(3),
        dm_env_specs.BoundedArray((2, 2), np.float64, 0.0, 1.0),
    ],
)
def test_action_specs_of_other_kinds_are_refused(spec: Any):
  with pytest.raises(errors.SpecError, match='action_spec'):
    continuous_designs.demonstration(spec, 'linear')
