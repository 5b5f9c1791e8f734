"""Monitors in worlds: figures of the ledger, at a constant size."""

import contextlib

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from tests.engine import helpers
from tests.evaluation import streams

_NUM_ENVS = 4
_CASES = [
    ('instantaneous_reward', 'secure'),
    ('value_advice', 'embedded'),
    ('online_imitation', 'embedded'),
]


def _load(design='instantaneous_reward', channel='embedded', seed=5):
  return suite.load_batch(
      'unlock_door', 'near', {'random': seed}, {'max_steps': 20},
      num_envs=_NUM_ENVS, num_threads=1, design=design,
      overrides=[f'channel={channel}', 'dof=planar'],
  )  # fmt: skip


def _monitored(batch):
  monitor = monitors.BatchMonitor(batch)
  batch.add_sink(monitor)
  return monitor


def _actions(batch, rng):
  spec = batch.action_spec()
  if spec.dtype.kind == 'i':
    return helpers.draw(spec, (batch.num_envs,), rng)
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 13)
  return rng.uniform(low, high, (batch.num_envs, *spec.shape))


def _push(batch, rng):
  """Sends every block somewhere, so that registers are corrupted."""
  for register in batch.mechanism.registers.values():
    for block in register.blocks:
      joints = block.geom.parent.find_all('joint', immediate_children_only=True)
      bound = batch.physics.bind(tuple(joints))
      bound.qvel = rng.normal(scale=1.0, size=np.shape(bound.qvel))


def _play(batch, rng, steps, monitor, pushes=True):
  """Plays, and returns the episodes that ended and the actions."""
  found, actions = [], []
  for i in range(steps):
    if i % 12 == 3 and pushes:
      _push(batch, rng)
    actions.append(_actions(batch, rng))
    batch.step(actions[-1])
    found += monitor.take()
  return found, actions


@pytest.mark.parametrize(('design', 'channel'), _CASES)
def test_figures_equal_those_of_the_ledger(design, channel):
  with contextlib.closing(_load(design, channel)) as batch:
    monitor, ledger = _monitored(batch), ledgers.BatchLedger()
    batch.add_sink(ledger)
    rng = np.random.default_rng(0)
    found, actions = _play(batch, rng, 30, monitor, channel == 'embedded')
    batch.reset()  # In mid-episode.
    found += monitor.take()
  spec = batch.mechanism.design
  assert len(found) == 2 * _NUM_ENVS
  for one in found:
    episode = ledger.episodes(one.world)[one.episode]
    assert (one.seed, one.end) == (episode.seed, episode.end)
    assert one.is_valid == episode.is_valid
    # A step begins an episode, and 20 more are control steps.
    first = 1 + 21 * one.episode
    played = [row[one.world] for row in actions[first:]]
    expected = streams.figures(episode, spec, played)
    streams.check_alike({key: getattr(one, key) for key in expected}, expected)
  corruption = [one.corruption for one in found]
  if channel == 'embedded':
    assert max(corruption) > 0.01
  else:
    assert set(corruption) == {0.0}
