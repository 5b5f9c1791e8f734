"""Tests for designs: round trips, digests, twins and registered kinds."""

import json
from typing import Any, Literal, final

import numpy as np
import pytest
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.feedback import designs

_ON_TWO = ('collect_apples', 'standard')


_EVERYTHING = designs.changed(
    'description=All of it.',
    'channel=secure',
    'dof=planar',
    'schedule={meter_substep: 1, provider_substep: 2}',
    'action_set={name: dmlab_like, version: 1}',
    'registers.reward.place={position: [1, 2], yaw: 0.5, spread: [0.1, 0.2]}',
    'registers.reward.scale=0.2',
    'registers.reward.initial=1',
    'registers.reward.channel=secure',
    'registers.reward.dof=free',
    'registers.reward.block_size=0.3',
    'registers.reward.mass=2',
    'learner={kind: x, reward: reward, rates: [0.1, {a: null}]}',
)


@pytest.mark.parametrize(
    'design',
    [*specs.DESIGNS, _EVERYTHING, designs.changed('schedule=cfmdp')],
    ids=str,
)
def test_a_design_survives_being_written_and_loaded(design: Any, tmp_path):
  spec = specs.load(design)
  as_json = json.loads(json.dumps(spec.to_mapping()))
  path = tmp_path / 'copy.yaml'
  path.write_text(yaml.safe_dump(spec.to_mapping()), encoding='utf-8')
  for copied in (specs.load(as_json), specs.load(path), specs.load(spec)):
    assert copied == spec
    assert copied.digest() == spec.digest()
    assert copied.to_mapping() == spec.to_mapping()


def test_equal_designs_have_equal_digests():
  design = designs.SCORED
  backwards = dict(reversed(design.items()))
  backwards['registers'] = {
      name: dict(reversed(design['registers'][name].items()))
      for name in ('reward', 'score')
  }
  assert list(backwards) != list(design)
  in_tuples = designs.changed()
  in_tuples['registers']['reward']['range'] = (-2.0, 12.0)
  for same in (
      backwards,
      in_tuples,
      # Defaults.
      designs.changed('channel=embedded', 'dof=free', "description=''"),
      designs.changed('registers.reward.scale=0.1', 'registers.reward.mass=1'),
  ):
    assert specs.load(same).digest() == specs.load(design).digest()


def test_the_digest_changes_with_every_part_of_a_design():
  changes = [
      'name=e', 'channel=secure', 'dof=planar', 'registers.reward.mass=2',
      'registers.reward.range=[-2, 11]', 'registers.reward.place=station_3',
      'meters=[]', 'providers.0.every=2', 'schedule=cfmdp', 'learner.rate=0.1',
      'action_set={name: dmlab_like, version: 1}',
  ]  # fmt: skip
  found = {specs.load(designs.changed(change)).digest() for change in changes}
  assert len({*found, specs.load(designs.SCORED).digest()}) == len(changes) + 1


@pytest.mark.parametrize(
    ('whole', 'found'),
    [
        ('embedded', {'reward': 'secure', 'score': 'embedded'}),
        ('secure', {'reward': 'secure', 'score': 'secure'}),
    ],
)
def test_the_channel_of_a_twin_replaces_those_of_its_registers(whole, found):
  design = designs.changed(
      f'channel={whole}', 'dof=planar', 'registers.reward.channel=secure'
  )
  env = suite.load(*_ON_TWO, design=design)
  channels = {n: r.channel for n, r in env.mechanism.registers.items()}
  env.close()
  assert channels == found


@pytest.mark.parametrize(
    ('design', 'overrides'),
    [
        ({**designs.SCORED, 'action_set': 'walk'}, ()),
        (designs.SCORED, ('action_set=walk',)),
    ],
)
def test_the_name_of_an_action_set_is_enough(design, overrides):
  stated = {**designs.SCORED, 'action_set': {'name': 'walk', 'version': 1}}
  spec, expected = specs.load(design, overrides), specs.load(stated)
  assert spec == expected
  assert spec.digest() == expected.digest()


@pytest.mark.parametrize(
    ('given', 'complaint'),
    [
        ('wlk', "'wlk' is unknown; did you mean 'walk'?; known are ['dmlab_"),
        ('3', 'must be a name, or a mapping with name and version, got 3'),
        ('{name: walk}', 'action_set.version: required key is missing'),
    ],
)
def test_what_names_no_action_set_is_refused(given, complaint):
  with pytest.raises(errors.SpecError) as raised:
    specs.load(designs.SCORED, [f'action_set={given}'])
  assert complaint in str(raised.value)


@final
class _Doubled(providers.Provider):
  kind: Literal['test_doubled'] = 'test_doubled'
  factor: float = 2.0

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    doubled = self.factor * readings[self.reads[0]]
    return {name: doubled for name in self.writes}, state


_WITH_DOUBLED = designs.changed('providers.0.kind=test_doubled')


def test_a_registered_provider_is_usable_by_name():
  with helpers.registered(providers.PROVIDERS, 'test_doubled', _Doubled):
    spec = specs.load(_WITH_DOUBLED)
    assert spec.providers == (_Doubled(reads=('score',), writes=('reward',)),)
    assert specs.load(spec.to_mapping()) == spec
    with pytest.raises(errors.SpecError, match='factor: must be a valid num'):
      specs.load(_WITH_DOUBLED, ('providers.0.factor=much',))
    env = suite.load(*_ON_TWO, {'random': 1}, design=_WITH_DOUBLED)
    env.reset()
    env.task.earn(env.physics, 3.0)
    time_step = env.step(helpers.no_op(env))
    env.close()
  np.testing.assert_allclose(time_step.observation['registers/reward'], 6.0)
  # It is unknown again when it is no longer registered.
  with pytest.raises(
      errors.SpecError, match=r'providers\[0\].kind: provider kind'
  ):
    specs.load(_WITH_DOUBLED)


@pytest.mark.parametrize(
    ('num_substeps', 'expected'), [(10, (3, 6)), (1, (0, 0)), (2, (0, 1))]
)
def test_the_default_schedule_is_a_third_and_two_thirds(
    num_substeps: int, expected: tuple[int, int]
):
  schedule = specs.load(designs.SCORED).schedule_for(num_substeps)
  assert (schedule.meter_substep, schedule.provider_substep) == expected
