"""Tests for designs: round trips, digests, twins and registered kinds."""

import json
from typing import Any, Literal, final

import numpy as np
import pydantic
import pytest
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from tests import registries
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import stubs

_ON_TWO = ('collect_apples', 'standard')
_KINDS = register_kinds.REGISTER_KINDS


# Round trips and digests.


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


def test_a_spec_that_is_loaded_again_can_be_overridden():
  spec = specs.load('instantaneous_reward')
  assert specs.load(spec, ('channel=secure',)).channel == 'secure'
  assert spec.channel == 'embedded'


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


# For each field, a change of the design.
_CHANGES = {
    'name': 'name=e',
    'description': 'description=x',
    'channel': 'channel=secure',
    'dof': 'dof=planar',
    'registers.kind': 'registers.reward.kind=block_position',
    'registers.role': 'registers.reward.role=signal',
    'registers.ends_episode':
        'registers.reward={kind: two_block, role: signal, place: station_1,'
        ' range: [-2, 12], ends_episode: {above: 1}}',
    'registers.place': 'registers.reward.place=station_3',
    'registers.place.position': 'registers.reward.place=[0, 0]',
    'registers.place.yaw': 'registers.reward.place={position: [0, 0], yaw: 1}',
    'registers.place.spread':
        'registers.reward.place={position: [0, 0], spread: [1, 0]}',
    'registers.range': 'registers.reward.range=[-2, 11]',
    'registers.scale': 'registers.reward.scale=0.2',
    'registers.initial': 'registers.reward.initial=1',
    'registers.channel': 'registers.reward.channel=secure',
    'registers.dof': 'registers.reward.dof=planar',
    'registers.block_size': 'registers.reward.block_size=0.3',
    'registers.mass': 'registers.reward.mass=2',
    'registers.options': 'registers.reward.kind=test_stubborn',
    'registers.options.held':
        'registers.reward={kind: test_stubborn, role: feedback, place:'
        ' station_1, range: [-2, 12], options: {held: 1.0}}',
    'meters': 'meters=[]',
    'meters.measures': 'meters.0.measures=door_unlocked',
    'meters.writes': 'meters=[{measures: score, writes: score_2}]',
    'providers': 'providers=[]',
    'providers.initial': 'providers.0.initial=1.0',
    'providers.every': 'providers.0.every=2',
    'schedule': 'schedule=cfmdp',
    'schedule.meter_substep':
        'schedule={meter_substep: 1, provider_substep: 4}',
    'schedule.provider_substep':
        'schedule={meter_substep: 1, provider_substep: 5}',
    'action_set': 'action_set={name: dmlab_like, version: 1}',
    'learner': 'learner=null',
    'learner.kind': 'learner.kind=x',
    'learner.rate': 'learner.rate=0.1'
}  # fmt: skip


def test_the_digest_changes_with_every_field():
  second = f'registers.score_2={json.dumps(designs.SCORE)}'
  base = designs.changed(second)
  with helpers.registered(_KINDS, 'test_stubborn', _Stubborn):
    digests = {
        name: specs.load(designs.changed(change, base=base)).digest()
        for name, change in {**_CHANGES, 'unchanged': second}.items()
    }
  assert len(set(digests.values())) == len(digests), digests


def test_the_table_of_changes_has_every_field():
  parts = {'registers': specs.RegisterSpec, 'meters': specs.MeterSpec}
  fields = set(specs.DesignSpec.model_fields) | {
      f'{name}.{field}' for name, s in parts.items() for field in s.model_fields
  }
  # The version has one value so far.
  assert fields <= {*_CHANGES, 'schema_version', 'registers'}


def test_a_spec_is_immutable():
  spec = specs.load(designs.SCORED)
  with pytest.raises(pydantic.ValidationError):
    spec.channel = 'secure'
  with pytest.raises(pydantic.ValidationError):
    spec.registers['reward'].scale = 1.0
  with pytest.raises(pydantic.ValidationError):
    spec.providers[0].initial = 1.0


# Twins.


def test_twins_have_the_specs_of_the_original():
  found = []
  for overrides in ((), ('channel=secure',)):
    env = suite.load(
        *_ON_TWO, {'random': 1}, design='value_advice', overrides=overrides
    )
    found.append((env.observation_spec(), env.action_spec()))
    env.close()
  assert found[0] == found[1]


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


# Action sets.


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


def test_the_name_of_an_action_set_is_its_newest_version():
  with registries.preserved():
    for version in (11, 2, 9):
      action_sets.register(
          action_sets.ActionSet('walk', version, (('wait', {}),))
      )
    spec = specs.load(designs.changed('action_set=walk'))
    assert spec.to_mapping()['action_set'] == {'name': 'walk', 'version': 11}


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


# The JSON Schema, and registered kinds.


def test_the_json_schema_has_every_key_and_every_shipped_provider():
  schema = specs.json_schema()
  assert set(schema['properties']) == set(specs.load('none').to_mapping())
  assert {'schema', 'name'} <= set(schema['required'])
  assert schema['additionalProperties'] is False
  text = json.dumps(schema)
  for kind in providers.PROVIDERS:
    assert f'"const": "{kind}"' in text
  forms = schema['$defs']['ActionSetSpec']['anyOf']
  assert [form['type'] for form in forms] == ['string', 'object']


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
_DOUBLED_KIND = '"const": "test_doubled"'


def test_a_registered_provider_is_usable_by_name():
  with helpers.registered(providers.PROVIDERS, 'test_doubled', _Doubled):
    spec = specs.load(_WITH_DOUBLED)
    assert spec.providers == (_Doubled(reads=('score',), writes=('reward',)),)
    assert specs.load(spec.to_mapping()) == spec
    with pytest.raises(errors.SpecError, match='factor: must be a valid num'):
      specs.load(_WITH_DOUBLED, ('providers.0.factor=much',))
    assert _DOUBLED_KIND in json.dumps(specs.json_schema())
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
  assert _DOUBLED_KIND not in json.dumps(specs.json_schema())


@final
class _Stubborn(stubs.Still):
  """Has the reading `held`, independently of writes."""

  def _build(self, name: str, *, held: float = 0.0, **kwargs: Any) -> None:
    self._held = held
    super()._build(name, **kwargs)

  def _read_blocks(self, physics: Any) -> np.ndarray:
    return self.applied(physics) * 0 + self._held


def test_a_registered_kind_of_register_is_usable_with_options():
  design = designs.changed(
      'registers.reward.kind=test_stubborn', 'registers.reward.options.held=5.5'
  )
  with helpers.registered(_KINDS, 'test_stubborn', _Stubborn):
    env = suite.load(*_ON_TWO, {'random': 1}, design=design)
    env.reset()
    time_step = env.step(helpers.no_op(env))
    env.close()
  assert time_step.observation['registers/reward'] == 5.5
  with pytest.raises(errors.SpecError, match="'test_stubborn' is unknown"):
    specs.load(design)


def test_a_name_cannot_be_registered_twice():
  with pytest.raises(errors.SpecError, match="'difference' is registered"):
    providers.PROVIDERS.add('difference')(_Doubled)
  with pytest.raises(errors.SpecError, match="'two_block' is registered"):
    _KINDS.add('two_block')(_Stubborn)


# Schedules and names.


@pytest.mark.parametrize(
    ('num_substeps', 'expected'), [(10, (3, 6)), (1, (0, 0)), (2, (0, 1))]
)
def test_the_default_schedule_is_a_third_and_two_thirds(
    num_substeps: int, expected: tuple[int, int]
):
  schedule = specs.load(designs.SCORED).schedule_for(num_substeps)
  assert (schedule.meter_substep, schedule.provider_substep) == expected


def test_the_schedule_of_the_cfmdp_comes_before_the_first_substep():
  schedule = specs.load(designs.changed('schedule=cfmdp')).schedule_for(10)
  assert (schedule.meter_substep, schedule.provider_substep) == (0, 0)


def test_registers_may_have_the_names_of_parts_of_the_world():
  taken = ('feedback', 'avatar', 'apples', 'world', 'floor', 'reward_base')
  constant = {'kind': 'constant', 'value': 0.5, 'writes': list(taken)}
  design = {
      'schema': 1,
      'name': 'd',
      'channel': 'secure',
      'registers': {
          name: {**designs.REWARD, 'place': [1.5, i * 0.9 - 2]}
          for i, name in enumerate(('reward', *taken))
      },
      'providers': [constant],
  }
  env = suite.load(*_ON_TWO, {'random': 1}, design=design)
  env.reset()
  observation = env.step(helpers.no_op(env)).observation
  env.close()
  assert observation['registers/reward'] == 0
  for name in taken:
    np.testing.assert_allclose(observation[f'registers/{name}'], 0.5)
