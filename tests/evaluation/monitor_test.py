"""Tests of the training monitor: figures of the ledger at a constant size."""

import json

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.engine import snapshots
from realab_suite.entities import registers
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics
from realab_suite.evaluation import monitors
from tests.engine import helpers

_NUM_ENVS = 5
_CASES = [
    ('instantaneous_reward', 'secure'),
    ('value_advice', 'embedded'),
    ('online_imitation', 'embedded'),
    ('none', 'embedded'),
]


def _load(design='instantaneous_reward', channel='embedded', seed=5):
  return suite.load_batch(
      'unlock_door',
      'near',
      {'random': seed},
      {'max_steps': 20},
      num_envs=_NUM_ENVS,
      num_threads=1,
      design=design,
      overrides=[f'channel={channel}'],
  )


def _monitored(batch):
  monitor = monitors.TrainingMonitor(batch.mechanism, batch.num_envs)
  batch.add_sink(monitor)
  return monitor


def _actions(batch, rng):
  spec = batch.action_spec()
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 13)
  shape = (batch.num_envs, *spec.shape)
  if spec.dtype.kind == 'i':
    return helpers.draw(spec, (batch.num_envs,), rng)
  actions = rng.uniform(low, high, shape)
  if spec.shape:
    actions[:, 0] = abs(actions[:, 0])
  return actions


def _push(batch, rng):
  """Sends every block somewhere, so that registers are corrupted."""
  for register in batch.mechanism.registers.values():
    for block in register.blocks:
      joints = block.geom.parent.find_all('joint', immediate_children_only=True)
      for joint in joints:
        velocity = batch.physics.bind((joint,)).qvel
        batch.physics.bind((joint,)).qvel = rng.normal(
            scale=1.0, size=velocity.shape
        )


def _expected(episode, mechanism):
  registers = {
      name: metrics.register_metrics(episode.entries[name], register.scale)
      for name, register in mechanism.registers.items()
  }
  return {
      'true_return': ledgers.true_return(episode),
      'observed_return': sum(
          registers[name].agent_reading_sum
          for name in mechanism.design.names('feedback')
      ),
      'corruption': metrics.in_metres(
          registers, gains.scales(mechanism.design)
      ),
      **gains.figures(episode.entries, mechanism.design)._asdict(),
      'registers': registers,
  }


def _check(record, episode, mechanism):
  names = [record['seed'], record['world'], record['episode']]
  assert names == [episode.seed, episode.world, episode.episode]
  assert record['end'] == episode.end.value
  assert record['is_valid'] == episode.is_valid
  assert record['num_steps'] == episode.num_steps
  expected = _expected(episode, mechanism)
  for key in ('true_return', 'observed_return'):
    assert record[key] == pytest.approx(expected[key], rel=1e-9, abs=1e-12)
  if not mechanism.design.names('feedback'):
    assert record['corruption'] is None
  else:
    assert record['corruption'] == pytest.approx(
        expected['corruption'], rel=1e-9, abs=1e-12
    )
  for key in (
      'gain',
      'num_paying_reads',
      'first_paying_read',
      'first_contact',
  ):
    assert (record[key] is None) == (expected[key] is None), key
    if record[key] is not None:
      assert record[key] == pytest.approx(expected[key], rel=1e-9, abs=1e-12)
  for name, register in mechanism.registers.items():
    ours, theirs = record['registers'][name], expected['registers'][name]
    for key in ('corruption', 'corruption_metres', 'corruption_signed',
                'obstruction', 'permanent', 'temporary'):  # fmt: skip
      value = getattr(theirs, key)
      if value is None:
        assert ours[key] is None
      else:
        assert ours[key] == pytest.approx(value, rel=1e-9, abs=1e-12)
    reads = [e for e in episode.entries[name] if isinstance(e, registers.Read)]
    if reads:
      last = reads[-1].permanent * register.scale
      assert ours['base_metres'] == pytest.approx(last, rel=1e-9, abs=1e-12)
      assert ours['corruption_signed_metres'] == pytest.approx(
          theirs.corruption_signed * register.scale, rel=1e-9, abs=1e-12
      )


@pytest.mark.parametrize(('design', 'channel'), _CASES)
def test_figures_equal_those_of_the_ledger(design, channel):
  batch = _load(design, channel)
  monitor, ledger = _monitored(batch), ledgers.BatchLedger()
  batch.add_sink(ledger)
  rng = np.random.default_rng(0)
  records = []
  for i in range(50):
    if i % 12 == 3 and channel == 'embedded':
      _push(batch, rng)
    batch.step(_actions(batch, rng))
    records += monitor.take()
  batch.reset()  # In mid-episode.
  batch.close()
  records += monitor.take()
  mechanism = batch.mechanism
  for world in range(_NUM_ENVS):
    episodes = ledger.episodes(world)
    ours = [record for record in records if record['world'] == world]
    assert len(ours) == len(episodes) == 4
    for record, episode in zip(ours, episodes, strict=True):
      _check(record, episode, mechanism)
  if mechanism.registers and channel == 'embedded':
    assert max(record['corruption'] for record in records) > 0.01
  elif mechanism.registers:
    assert {record['corruption'] for record in records} == {0.0}


@pytest.mark.mujoco_warns('BADQVEL')
def test_the_record_of_a_diverged_episode_is_invalid():
  batch = _load()
  monitor, ledger = _monitored(batch), ledgers.BatchLedger()
  batch.add_sink(ledger)
  rng = np.random.default_rng(0)
  batch.reset()
  batch.step(_actions(batch, rng))
  joint = batch.task.avatar.body.find_all('joint')[0]
  batch.physics.world(1).bind((joint,)).qvel = np.nan
  batch.step(_actions(batch, rng))
  [record] = monitor.take()
  assert record['end'] == events.End.DIVERGENCE.value
  assert not record['is_valid']
  _check(record, ledger.episodes(1)[0], batch.mechanism)
  for _ in range(40):
    batch.step(_actions(batch, rng))
  for record in monitor.take():
    episodes = ledger.episodes(record['world'])
    _check(record, episodes[record['episode']], batch.mechanism)
  batch.close()


def test_a_monitor_continues_from_a_snapshot():
  def play(batch, monitor, steps, seed):
    rng, records = np.random.default_rng(seed), []
    for _ in range(steps):
      batch.step(_actions(batch, rng))
      records += monitor.take()
    return json.dumps(records)

  batch = _load()
  monitor = _monitored(batch)
  play(batch, monitor, 13, 1)
  data = batch.save().to_bytes()
  expected = play(batch, monitor, 40, 2)
  batch.close()
  other = _load(seed=8)
  monitor = _monitored(other)
  play(other, monitor, 4, 3)
  other.restore(snapshots.Snapshot.from_bytes(data))
  abandoned = monitor.take()
  assert {record['end'] for record in abandoned} == {'abandoned'}
  assert play(other, monitor, 40, 2) == expected
  assert json.loads(expected)
  other.close()


def test_taken_records_use_no_more_memory():
  batch = _load()
  monitor = _monitored(batch)
  rng = np.random.default_rng(0)
  sizes = []
  for _ in range(3):
    for _ in range(21):
      batch.step(_actions(batch, rng))
    assert len(monitor.take()) == _NUM_ENVS
    assert monitor.take() == []
    sizes.append(len(json.dumps(monitor.state(np.arange(_NUM_ENVS)))))
  batch.close()
  assert max(sizes) < 1.2 * min(sizes)
