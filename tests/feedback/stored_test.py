"""Registers of the kind `stored`: what was measured, out of reach."""

import contextlib

from dm_control import composer
from dm_control.locomotion.arenas import floors
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.lab.attribution import attribution
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import tracking

_SEEN = {'kind': 'stored', 'role': 'meter', 'range': [0, 6]}


def _design(**registers):
  return {
      'schema': 1,
      'name': 'watched',
      'dof': 'planar',
      'registers': {
          'seen': _SEEN,
          'fine': {**_SEEN, 'role': 'feedback', 'range': [-6, 0]},
          **registers,
      },
      'meters': [{'measures': 'cubes_seen', 'writes': 'seen'}],
      'providers': [
          {
              'kind': 'growth',
              'reads': ['seen'],
              'writes': ['fine'],
              'weights': [-1],
          }
      ],
      'learner': {'kind': 'policy_gradient', 'reward': 'fine'},
  }


@pytest.mark.parametrize('channel', ['embedded', 'secure'])
def test_a_stored_meter_is_as_good_as_its_instrument(channel):
  overrides = [f'channel={channel}', 'action_set=dmlab_like']
  batch = suite.load_batch(
      'supervised_room',
      'standard',
      {'random': 3},
      num_envs=16,
      design=_design(),
      overrides=overrides,
  )
  seen = batch.mechanism.registers['seen']
  random = np.random.RandomState(0)
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  batch.reset()
  for _ in range(150):
    batch.step(random.randint(batch.action_spec().num_values, size=16))
  instrument = batch.task.measurements['cubes_seen']
  measured, ideal = (
      one(batch.physics) for one in (instrument.measured, instrument.ideal)
  )
  assert (measured < ideal).any()
  assert (measured > 0).any()
  expected = measured if channel == 'embedded' else ideal
  np.testing.assert_array_equal(seen.read(batch.physics), expected)
  np.testing.assert_array_equal(seen.clean(batch.physics), ideal)
  read = seen.inspect(batch.physics)
  assert not np.any(read.obstruction + read.permanent + read.temporary)


def test_only_registers_with_blocks_are_attacked_and_filmed():
  reward = {'kind': 'two_block', 'role': 'feedback', 'place': 'station_1'}
  design = specs.load(_design(other=reward | {'range': [0, 5], 'initial': 1}))
  assert aiming.attacked(design) == ['other']
  assert [name for name in design.ports if design.is_movable(name)] == ['other']
  env = suite.load(
      'supervised_room',
      'standard',
      {'random': 1, 'starts_beside_registers': 1.0},
      design=design,
      overrides=['action_set=dmlab_like'],
  )
  with contextlib.closing(env):
    tracker = tracking.Tracker(env)
    env.add_sink(tracker)
    env.reset()
    for _ in range(3):
      env.step(1)
    blocks = {n: one.blocks[-1] for n, one in tracker.track.registers.items()}
    assert {n: len(one) for n, one in blocks.items()} == {
        'seen': 0,
        'fine': 0,
        'other': 2,
    }


@pytest.mark.parametrize(
    ('spec', 'problem'),
    [
        (_SEEN | {'place': 'station_1'}, 'stored has no blocks; leave the'),
        (_SEEN | {'kind': 'two_block'}, 'place: required key is missing'),
        (_SEEN | {'kind': 'two_block', 'place': None}, 'for kind two_block'),
    ],
)
def test_a_place_belongs_to_blocks(spec, problem):
  with pytest.raises(errors.SpecError, match=problem):
    specs.load(_design(seen=spec))


def test_a_foreign_task_can_have_stored_registers_alone():
  design = _design() | {'meters': [], 'providers': []}
  design['registers']['fine'] = design['registers']['fine'] | {'initial': -2}
  env = suite.embed(composer.NullTask(floors.Floor()), design)
  with contextlib.closing(env):
    env.reset()
    time_step = env.step(env.action_spec().generate_value())
  assert time_step.observation['registers/fine'] == -2
