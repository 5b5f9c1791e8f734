"""Tests for designs: what they say survives, and what is wrong is named."""

import contextlib
import copy
import json
import pathlib
from typing import Any, Literal, final

from dm_control import composer
import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pydantic
import pytest
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from tests.engine import helpers

_REWARD = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': 'station_1',
    'range': [-2, 12],
}
_SCORE = {
    'kind': 'two_block',
    'role': 'meter',
    'place': 'station_2',
    'range': [0, 20],
}
_QUERY = {
    'kind': 'two_block',
    'role': 'query',
    'place': 'station_2',
    'range': [0, 13],
}
_DESIGN = {
    'schema': 1,
    'name': 'd',
    'registers': {'reward': _REWARD, 'score': _SCORE},
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
    'learner': {'kind': 'policy_gradient', 'reward': 'reward'},
}
_ACTION_SET = {'name': 'dmlab_like', 'version': 1}
_ON_TWO = ('collect_apples', 'standard')


def _design(**changes: Any) -> dict[str, Any]:
  return {**copy.deepcopy(_DESIGN), **changes}


def _reward(**changes: Any) -> dict[str, Any]:
  """A design whose feedback register is changed."""
  return _design(registers={'reward': {**_REWARD, **changes}, 'score': _SCORE})


def _constants(**reads_and_writes: str) -> dict[str, Any]:
  """A design of constant providers: `a='b'` reads a and writes b."""
  names = {*reads_and_writes, *reads_and_writes.values()}
  return _design(
      registers={
          name: {**_REWARD, 'place': [0, i], 'range': [0, 1]}
          for i, name in enumerate(sorted(names))
      },
      meters=[],
      providers=[
          {'kind': 'constant', 'reads': [one], 'writes': [other]}
          for one, other in reads_and_writes.items()
      ],
      learner=None,
  )


def _without(key: str) -> dict[str, Any]:
  return {k: v for k, v in _design().items() if k != key}


def _advice(**changes: Any) -> dict[str, Any]:
  return {
      'kind': 'value_advice',
      'value_function': 'apple_seeker_approval',
      'reads': ['query'],
      'writes': ['reward'],
      **changes,
  }


# What a file says, and what the message has to say about it. Every message
# begins with the name of the file.
_WRONG = {
    'unknown key': (
        _design(metres=[]),
        "unknown key 'metres'; did you mean 'meters'?",
    ),
    'unknown key of a register': (
        _reward(scales=0.1),
        "registers.reward: unknown key 'scales'; did you mean 'scale'?",
    ),
    'unknown key of a provider': (
        _design(providers=[{**_DESIGN['providers'][0], 'initail': 1.0}]),
        "providers[0]: unknown key 'initail'; did you mean 'initial'?",
    ),
    'unknown key of a meter': (
        _design(meters=[{'measure': 'score', 'writes': 'score'}]),
        "meters[0]: unknown key 'measure'; did you mean 'measures'?",
    ),
    'newer schema': (_design(schema=2), 'schema: must be 1, got 2'),
    'schema as text': (_design(schema='1'), "schema: must be 1, got '1'"),
    'schema as a boolean': (_design(schema=True), 'schema: must be 1, got Tr'),
    'no schema': (_without('schema'), 'schema: required key is missing'),
    'no name': (_without('name'), 'name: required key is missing'),
    'empty name': (_design(name=''), "name: must match pattern '^[a-z]"),
    'name with a space': (_design(name='my d'), 'name: must match pattern'),
    'name with a slash': (_design(name='a/b'), 'name: must match pattern'),
    'name with an umlaut': (_design(name='grün'), 'name: must match pattern'),
    'name with a newline': (_design(name='a\n'), 'name: must match pattern'),
    'name that is too long': (_design(name='a' * 65), 'must match pattern'),
    'name of a register': (
        _design(registers={'Reward': _REWARD}, meters=[], providers=[]),
        "must match pattern '^[a-z][a-z0-9_]{0,63}$', got 'Reward'",
    ),
    'range upside down': (
        _reward(range=[3, -3]),
        'registers.reward: range [3.0, -3.0] must have low < high',
    ),
    'range of one value': (_reward(range=[1, 1]), 'must have low < high'),
    'range of three': (_reward(range=[1, 2, 3]), 'registers.reward.range'),
    'range of booleans': (_reward(range=[False, True]), 'got False'),
    'range of texts': (_reward(range=['0', '5']), "got '0'"),
    'initial out of range': (
        _reward(initial=50),
        'initial 50.0 must be in range [-2.0, 12.0]',
    ),
    'initial as a boolean': (_reward(initial=True), 'initial: must be a'),
    'massless': (_reward(mass=0), 'mass: must be greater than or equal to'),
    'negative mass': (_reward(mass=-1), 'mass: must be greater than'),
    'absurd mass': (_reward(mass=1e300), 'mass: must be less than'),
    'mass as a boolean': (_reward(mass=True), 'mass: must be a valid number'),
    'block without size': (_reward(block_size=0), 'block_size: must be gre'),
    'block that would land under the floor': (
        _reward(block_size=0.05),
        'block_size: must be greater than or equal to 0.06, got 0.05',
    ),
    'huge block': (_reward(block_size=5), 'block_size: must be less than'),
    'scale of zero': (_reward(scale=0), 'registers.reward.scale: must be gre'),
    'scale that leaves noise': (_reward(scale=1e-7), 'scale: must be gre'),
    'range beyond arithmetic': (
        _reward(range=[-1e308, 1e308]),
        'registers.reward.range[0]: must be greater than or equal to -100000',
    ),
    'place beyond arithmetic': (
        _reward(place=[1e300, 0]),
        'registers.reward.place.position[0]: must be less than or equal to 100',
    ),
    'unknown register kind': (
        _reward(kind='tow_block'),
        "register kind 'tow_block' is unknown; did you mean 'two_block'?",
    ),
    'unknown role': (
        _reward(role='reward'),
        "role: must be 'feedback', 'meter', 'query' or 'signal', got 'reward'",
    ),
    'unknown channel': (
        _reward(channel='weld'),
        "channel: must be 'embedded', 'welded' or 'secure', got 'weld'",
    ),
    'unknown dof': (_design(dof='fixed'), "dof: must be 'free' or 'planar'"),
    'unknown overflow': (
        _reward(on_overflow='clip'),
        "on_overflow: must be 'saturate' or 'error', got 'clip'",
    ),
    'place of one number': (_reward(place=[1]), 'registers.reward.place'),
    'place in texts': (_reward(place=['1', '2']), "got '1'"),
    'negative spread': (
        _reward(place={'position': [0, 0], 'spread': [-1, 0]}),
        'registers.reward.place.spread[0]: must be greater than or equal to 0',
    ),
    'meter of an undeclared register': (
        _design(meters=[{'measures': 'score', 'writes': 'scores'}]),
        "meters[0].writes: register 'scores' is not declared; declared are"
        " ['reward', 'score']",
    ),
    'meter that writes feedback': (
        _design(meters=[{'measures': 'score', 'writes': 'reward'}]),
        "meters[0].writes: register 'reward' has role 'feedback'; allowed are"
        " ['meter']",
    ),
    'provider that reads what is undeclared': (
        _design(
            providers=[
                {'kind': 'constant', 'reads': ['secret'], 'writes': ['reward']}
            ]
        ),
        "providers[0].reads: register 'secret' is not declared",
    ),
    'provider that writes what is undeclared': (
        _design(providers=[{'kind': 'constant', 'writes': ['secret']}]),
        "providers[0].writes: register 'secret' is not declared",
    ),
    'provider that writes a meter register': (
        _design(providers=[{'kind': 'constant', 'writes': ['score']}]),
        "providers[0].writes: register 'score' has role 'meter'; allowed are"
        " ['feedback', 'signal']",
    ),
    'unknown provider': (
        _design(providers=[{'kind': 'diference', 'writes': ['reward']}]),
        "providers[0].kind: must be one of 'constant', 'demonstration',",
    ),
    'provider without kind': (
        _design(providers=[{'writes': ['reward']}]),
        'providers[0].kind: required key is missing',
    ),
    'provider that reads too much': (
        _design(
            providers=[
                {
                    'kind': 'difference',
                    'reads': ['score', 'reward'],
                    'writes': ['reward'],
                }
            ]
        ),
        'reads: must have at most 1 item',
    ),
    'two providers in a cycle': (
        _constants(a='b', b='a'),
        'providers[0] and providers[1] form a cycle',
    ),
    'three providers in a cycle': (_constants(a='b', b='c', c='a'), 'cycle'),
    'learner that reads a meter register': (
        _design(learner={'kind': 'policy_gradient', 'reward': 'score'}),
        "learner.reward: an agent may not read meter register 'score'"
        ' (feedback providers only)',
    ),
    'learner that reads a meter register among others': (
        _design(learner={'kind': 'multi', 'rewards': ['reward', 'score']}),
        "an agent may not read meter register 'score'",
    ),
    'learner without kind': (
        _design(learner={'reward': 'reward'}),
        'learner.kind: required key is missing',
    ),
    'demonstration without action set': (
        _design(
            providers=[
                {
                    'kind': 'demonstration',
                    'policy': 'no_op',
                    'writes': ['reward'],
                }
            ]
        ),
        'demonstration speaks of action set dmlab_like v1; the design has None',
    ),
    'unknown policy': (
        _design(
            action_set=_ACTION_SET,
            providers=[
                {
                    'kind': 'demonstration',
                    'policy': 'no_opp',
                    'writes': ['reward'],
                }
            ],
        ),
        "policy 'no_opp' is unknown; did you mean 'no_op'?",
    ),
    'options that a policy does not take': (
        _design(
            action_set=_ACTION_SET,
            providers=[
                {
                    'kind': 'demonstration',
                    'policy': 'no_op',
                    'options': {'speed': 1},
                    'writes': ['reward'],
                }
            ],
        ),
        "providers[0].options: unknown key 'speed' (allowed: none)",
    ),
    'advice on what is no query': (
        _design(
            action_set=_ACTION_SET,
            registers={'reward': _REWARD, 'query': {**_QUERY, 'role': 'meter'}},
            meters=[],
            providers=[_advice()],
        ),
        "value_advice reads the query off 'query', whose role is 'meter';"
        ' allowed is query',
    ),
    'paired advice on one query': (
        _design(
            action_set=_ACTION_SET,
            registers={'reward': _REWARD, 'query': _QUERY},
            meters=[],
            providers=[_advice(kind='paired_advice', reads=['query', 'query'])],
        ),
        "providers[0].reads: register 'query' is there twice",
    ),
    'paired advice on what is no query': (
        _design(
            action_set=_ACTION_SET,
            registers={
                'reward': _REWARD,
                'query': _QUERY,
                'other': {**_QUERY, 'role': 'meter'},
            },
            meters=[],
            providers=[_advice(kind='paired_advice', reads=['query', 'other'])],
        ),
        "paired_advice reads a query off 'other', whose role is 'meter';"
        ' allowed is query',
    ),
    'advice with another delay': (
        _design(
            action_set=_ACTION_SET,
            registers={'reward': _REWARD, 'query': _QUERY},
            meters=[],
            providers=[_advice(query_delay=2)],
        ),
        'query_delay: must be 0 or 1, got 2',
    ),
    'advice that its learner takes for that of another action': (
        _design(
            action_set=_ACTION_SET,
            registers={'reward': _REWARD, 'query': _QUERY},
            meters=[],
            providers=[_advice(query_delay=1)],
            learner={
                'kind': 'value_advice',
                'advice': 'reward',
                'query': 'query',
            },
        ),
        'query_delay: 1 values the query of the step before, and the learner'
        ' value_advice takes what it reads',
    ),
    'unknown value function': (
        _design(
            action_set=_ACTION_SET,
            registers={'reward': _REWARD, 'query': _QUERY},
            meters=[],
            providers=[_advice(value_function='oracle')],
        ),
        "value function 'oracle' is unknown",
    ),
    'unknown action set': (
        _design(action_set={'name': 'dmlab', 'version': 1}),
        "action_set: action set 'dmlab' v1 is unknown; known are"
        " ['dmlab_like v1']",
    ),
    'unknown version of an action set': (
        _design(action_set={'name': 'dmlab_like', 'version': 9}),
        "action set 'dmlab_like' v9 is unknown",
    ),
    'schedule out of order': (
        _design(schedule={'meter_substep': 5, 'provider_substep': 3}),
        'meter_substep 5 must not come after provider_substep 3',
    ),
    'negative schedule': (
        _design(schedule={'meter_substep': -1, 'provider_substep': 3}),
        'schedule.meter_substep: must be greater than or equal to 0',
    ),
    'unknown schedule': (_design(schedule='late'), "schedule: must be 'cfmdp'"),
}

# The same, where only the world can tell.
_DOES_NOT_FIT = {
    'unknown place': (
        _reward(place='moon'),
        "registers.reward.place: this world offers no place 'moon'; allowed"
        " are ['centre', 'east_wall'",
    ),
    'unknown measurement': (
        _design(meters=[{'measures': 'scor', 'writes': 'score'}]),
        "design 'd': meters[0].measures: 'scor' cannot be measured in this"
        " world; allowed are ['score']",
    ),
    'sweep leaves the arena': (
        _reward(place=[0, 0], range=[0, 200]),
        "register 'reward' at value 200 would be at (20, 0.25), outside the"
        ' arena (-4, -4) to (4, 4)',
    ),
    'outside the arena': (
        _reward(place=[9.0, 0]),
        "register 'reward' at value -2 would be at (9, 0), outside the arena",
    ),
    'sweep hits a wall': (
        _reward(place=[0, 3.7], range=[0, 1]),
        "inside 'wall_north'; place it elsewhere or narrow its range",
    ),
    'region reaches into a wall': (
        _reward(place={'position': [0, 3], 'spread': [0, 0.7]}, range=[0, 1]),
        "inside 'wall_north'",
    ),
    'sweep hits another register': (
        _reward(place=[-2.9, -3.2]),
        "registers 'reward' and 'score' would be in each other's way",
    ),
    'turn of more than half': (
        _reward(kind='block_orientation', scale=1.0),
        "register 'reward': range [-2.0, 12.0] at scale 1.0 turns the block",
    ),
    'schedule beyond the step': (
        _design(schedule={'meter_substep': 3, 'provider_substep': 10}),
        'schedule.provider_substep: 10 must be less than the 10 substeps of a'
        ' control step',
    ),
    'option that a register does not take': (
        _reward(options={'colour': 'red'}),
        "registers.reward.options: unknown key 'colour' (allowed: none)",
    ),
    'option that is a key of its own': (
        _reward(options={'scale': 0.2}),
        "registers.reward.options: unknown key 'scale' (allowed: none)",
    ),
}


@pytest.mark.parametrize(('data', 'message'), _WRONG.values(), ids=_WRONG)
def test_a_wrong_design_is_refused_in_one_line_that_says_why(
    data: dict[str, Any], message: str
):
  with pytest.raises(errors.SpecError) as caught:
    specs.load(data)
  text = str(caught.value)
  assert text.startswith('design: ')
  assert message in text
  assert '\n' not in text


@pytest.mark.parametrize(
    ('data', 'message'), _DOES_NOT_FIT.values(), ids=_DOES_NOT_FIT
)
def test_a_design_that_does_not_fit_a_world_is_refused_in_one_line(
    data: dict[str, Any], message: str
):
  with pytest.raises(errors.SpecError) as caught:
    suite.load(*_ON_TWO, design=data)
  assert message in str(caught.value)
  assert '\n' not in str(caught.value)


def test_the_design_of_the_tables_is_itself_all_right():
  env = suite.load(*_ON_TWO, design=_DESIGN)
  env.close()
  assert set(env.mechanism.registers) == set(_DESIGN['registers'])


def test_messages_name_the_file(tmp_path: pathlib.Path):
  path = tmp_path / 'mine.yaml'
  path.write_text(yaml.safe_dump(_design(metres=[])), encoding='utf-8')
  with pytest.raises(errors.SpecError, match=r'mine\.yaml: unknown key'):
    specs.load(path)


@pytest.mark.parametrize('design', [3, None, 1.5, ['a'], b'none', object()])
def test_what_is_no_design_at_all_is_refused(design: Any):
  with pytest.raises(errors.SpecError):
    specs.load(design)


@pytest.mark.parametrize(
    'given',
    [
        lambda long: long,
        lambda long: _design(**{long: 1}),
        lambda long: _design(registers={long: _REWARD}),
        lambda long: _reward(kind=long),
        lambda long: _reward(**{long: 1}),
        lambda long: _design(learner={'kind': 'x', long: 'score'}),
        lambda long: _design(
            providers=[{**_DESIGN['providers'][0], 'reads': [long]}]
        ),
    ],
)
def test_a_long_name_or_key_is_cut_in_a_message(given: Any):
  with pytest.raises(errors.SpecError) as caught:
    specs.load(given('k' * 100_000))
  assert 'kkkkk' in str(caught.value)
  assert len(str(caught.value)) < 600


def test_an_unknown_design_is_refused_with_the_known_ones():
  with pytest.raises(errors.UnknownNameError, match='instantaneous_reward'):
    specs.load('instantaneous_rewards')


@pytest.mark.parametrize(
    ('setting', 'message'),
    [
        ({'solver': 'PGS'}, 'option.solver: mjSOL_PGS; meters need Newton or'),
        ({'island': 'disable'}, 'option.flag.island: disabled'),
        ({'noslip_iterations': 3, 'noslip_tolerance': 1e-6}, 'noslip_toleran'),
    ],
)
def test_meters_are_refused_where_the_solver_couples_what_is_far_apart(
    setting: dict[str, Any], message: str
):
  task = _point_task(setting)
  with pytest.raises(errors.SpecError) as caught:
    suite.embed(task, _at_coordinates())
  assert message in str(caught.value)


@pytest.mark.parametrize(
    ('solver', 'has_meters'),
    [('Newton', True), ('CG', True), ('PGS', False)],
)
def test_only_meters_mind_the_solver(solver: str, has_meters: bool):
  design = _at_coordinates()
  if not has_meters:
    design['meters'] = []
  env = suite.embed(_point_task({'solver': solver}), design)
  env.reset()
  assert (
      mujoco.mjtSolver(env.physics.model.opt.solver).name
      == f'mjSOL_{solver.upper()}'
  )
  assert bool(env.mechanism.design.meters) is has_meters
  env.close()


def _point_task(settings: dict[str, Any]) -> composer.Task:
  task = helpers.PointTask()
  option = task.root_entity.mjcf_model.option
  for name, value in settings.items():
    setattr(option.flag if name == 'island' else option, name, value)
  return task


def _at_coordinates() -> dict[str, Any]:
  return _design(
      registers={
          'reward': {**_REWARD, 'place': [3, 3]},
          'score': {**_SCORE, 'place': [-3, -3]},
      }
  )


# Round trips and digests.


def _all_designs() -> list[Any]:
  everything = _design(
      description='All of it.',
      channel='welded',
      dof='planar',
      schedule={'meter_substep': 1, 'provider_substep': 2},
      action_set=_ACTION_SET,
      registers={
          'reward': {
              **_REWARD,
              'place': {'position': [1, 2], 'yaw': 0.5, 'spread': [0.1, 0.2]},
              'scale': 0.2,
              'initial': 1,
              'on_overflow': 'error',
              'channel': 'secure',
              'dof': 'free',
              'block_size': 0.3,
              'mass': 2,
          },
          'score': _SCORE,
      },
      learner={'kind': 'x', 'reward': 'reward', 'rates': [0.1, {'a': None}]},
  )
  return [*specs.DESIGNS, _DESIGN, _design(schedule='cfmdp'), everything]


@pytest.mark.parametrize('design', _all_designs())
def test_a_design_survives_being_written_down(
    design: Any, tmp_path: pathlib.Path
):
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


def test_the_digest_does_not_depend_on_order_or_filled_in_defaults():
  spec = specs.load(_DESIGN)
  backwards = dict(reversed(_DESIGN.items()))
  backwards['registers'] = {
      name: dict(reversed(_DESIGN['registers'][name].items()))
      for name in ('reward', 'score')
  }
  assert list(backwards) != list(_DESIGN)
  filled_in = _design(channel='embedded', dof='free', description='')
  for same in (backwards, filled_in, _reward(scale=0.1, mass=1)):
    assert specs.load(same).digest() == spec.digest()


# For each field, a value that differs from the design's.
_CHANGES = {
    'name': _design(name='e'),
    'description': _design(description='x'),
    'channel': _design(channel='secure'),
    'dof': _design(dof='planar'),
    'registers.kind': _reward(kind='block_position'),
    'registers.role': _reward(role='signal'),
    'registers.place': _reward(place='station_3'),
    'registers.place.position': _reward(place=[0, 0]),
    'registers.place.yaw': _reward(place={'position': [0, 0], 'yaw': 1}),
    'registers.place.spread': _reward(
        place={'position': [0, 0], 'spread': [1, 0]}
    ),
    'registers.range': _reward(range=[-2, 11]),
    'registers.scale': _reward(scale=0.2),
    'registers.initial': _reward(initial=1),
    'registers.on_overflow': _reward(on_overflow='error'),
    'registers.channel': _reward(channel='secure'),
    'registers.dof': _reward(dof='planar'),
    'registers.block_size': _reward(block_size=0.3),
    'registers.mass': _reward(mass=2),
    'registers.options': _reward(kind='test_stubborn'),
    'registers.options.held': _reward(
        kind='test_stubborn', options={'held': 1.0}
    ),
    'meters': _design(meters=[]),
    'meters.measures': _design(
        meters=[{'measures': 'door_unlocked', 'writes': 'score'}]
    ),
    'providers': _design(providers=[]),
    'providers.initial': _design(
        providers=[{**_DESIGN['providers'][0], 'initial': 1.0}]
    ),
    'schedule': _design(schedule='cfmdp'),
    'schedule.meter_substep': _design(
        schedule={'meter_substep': 1, 'provider_substep': 4}
    ),
    'schedule.provider_substep': _design(
        schedule={'meter_substep': 1, 'provider_substep': 5}
    ),
    'action_set': _design(action_set=_ACTION_SET),
    'learner': _design(learner=None),
    'learner.kind': _design(learner={'kind': 'x', 'reward': 'reward'}),
    'learner.rate': _design(learner={**_DESIGN['learner'], 'rate': 0.1}),
}


def test_the_digest_changes_with_every_field():
  designs = {'unchanged': _DESIGN, **_CHANGES}
  kinds = register_kinds.REGISTER_KINDS
  with helpers.registered(kinds, 'test_stubborn', _Stubborn):
    digests = {name: specs.load(d).digest() for name, d in designs.items()}
  assert len(set(digests.values())) == len(digests), digests


def test_the_digest_table_has_every_field():
  # So that a new field comes with a row; versions have one value so far.
  spec = {'registers': specs.RegisterSpec, 'meters': specs.MeterSpec}
  fields = {name for name in specs.DesignSpec.model_fields}
  fields |= {
      f'{name}.{field}' for name, s in spec.items() for field in s.model_fields
  }
  covered = {*_CHANGES, 'schema_version', 'registers', 'meters.writes'}
  assert fields <= covered


def test_designs_that_say_the_same_in_other_types_are_the_same():
  for same in (_reward(range=(-2.0, 12.0)), _reward(range=[-2.0, 12])):
    assert specs.load(same).digest() == specs.load(_DESIGN).digest()


@hypothesis.settings(max_examples=100)
@hypothesis.given(
    path=st.sampled_from(
        [
            'name', 'channel', 'registers', 'registers.reward',
            'registers.reward.range', 'registers.reward.place',
            'registers.reward.initial', 'registers.reward.options', 'meters',
            'meters.0', 'providers', 'providers.0', 'providers.0.reads',
            'schedule', 'action_set', 'learner', 'learner.reward', 'schema',
        ]
    ),
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=5,
    ),
)  # fmt: skip
def test_whatever_a_field_holds_is_a_design_or_a_spec_error(
    path: str, value: Any
):
  data: Any = _design()
  node = data
  *way, last = path.split('.')
  for key in way:
    node = node[int(key) if isinstance(node, list) else key]
  node[int(last) if isinstance(node, list) else last] = value
  # Any other error fails the test.
  with contextlib.suppress(errors.SpecError):
    spec = specs.load(data)
    assert specs.load(spec.to_mapping()).digest() == spec.digest()


def test_a_design_cannot_be_changed():
  spec = specs.load(_DESIGN)
  with pytest.raises(pydantic.ValidationError):
    spec.channel = 'secure'
  with pytest.raises(pydantic.ValidationError):
    spec.registers['reward'].scale = 1.0
  with pytest.raises(pydantic.ValidationError):
    spec.providers[0].initial = 1.0


# Overrides and twins.


def test_overrides_reach_every_depth():
  spec = specs.load(
      'instantaneous_reward',
      (
          'registers.reward.scale=0.2',
          'registers.reward.place=[1, 1]',
          'providers.0.initial=1.5',
          'schedule={meter_substep: 1, provider_substep: 2}',
          'learner.rate=1e-3',
      ),
  )
  assert spec.registers['reward'].scale == 0.2
  assert spec.registers['reward'].place.position == (1.0, 1.0)
  assert spec.providers[0].initial == 1.5
  assert spec.schedule.provider_substep == 2
  assert spec.learner.model_extra['rate'] == 1e-3


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        ('registers.reward.scales=1', "unknown key 'scales'; did you mean 'sc"),
        ('channel', 'expected key=value'),
        ('channel=loose', "channel: must be 'embedded', 'welded' or 'secure'"),
        ('providers.3.initial=1', "index '3' is not one of the 1 entries"),
    ],
)
def test_a_wrong_override_is_refused(override: str, message: str):
  with pytest.raises(errors.SpecError) as caught:
    specs.load('instantaneous_reward', (override,))
  assert message in str(caught.value)


@pytest.mark.parametrize('channel', registers.CHANNELS)
@pytest.mark.parametrize('dof', registers.DOFS)
def test_a_design_has_a_twin_for_each_channel_and_dof(channel: str, dof: str):
  env = suite.load(
      *_ON_TWO,
      {'random': 1},
      design='instantaneous_reward',
      overrides=(f'channel={channel}', f'dof={dof}'),
  )
  assert {r.channel for r in env.mechanism.registers.values()} == {channel}
  twin = env.observation_spec(), env.action_spec()
  env.close()
  original = suite.load(*_ON_TWO, {'random': 1}, design='instantaneous_reward')
  assert twin == (original.observation_spec(), original.action_spec())
  original.close()


@pytest.mark.parametrize(
    ('whole', 'found'),
    [
        ('embedded', {'reward': 'secure', 'score': 'embedded'}),
        ('welded', {'reward': 'welded', 'score': 'welded'}),
        ('secure', {'reward': 'secure', 'score': 'secure'}),
    ],
)
def test_a_twin_is_one_as_a_whole_whatever_its_registers_say(whole, found):
  design = _design(channel=whole, dof='planar')
  design['registers']['reward'] = {**_REWARD, 'channel': 'secure'}
  env = suite.load(*_ON_TWO, design=design)
  channels = {n: r.channel for n, r in env.mechanism.registers.items()}
  env.close()
  assert channels == found


# The JSON Schema, and kinds of one's own.


def test_the_json_schema_has_every_key_and_every_shipped_provider():
  schema = specs.json_schema()
  assert set(schema['properties']) == set(specs.load('none').to_mapping())
  assert {'schema', 'name'} <= set(schema['required'])
  assert schema['additionalProperties'] is False
  text = json.dumps(schema)
  for kind in providers.PROVIDERS:
    assert f'"const": "{kind}"' in text


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


_WITH_DOUBLED = _design(
    providers=[
        {'kind': 'test_doubled', 'reads': ['score'], 'writes': ['reward']}
    ]
)


def test_a_provider_of_ones_own_is_usable_by_name():
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


def test_a_provider_that_is_registered_no_more_is_unknown_again():
  with helpers.registered(providers.PROVIDERS, 'test_doubled', _Doubled):
    specs.load(_WITH_DOUBLED)
  with pytest.raises(errors.SpecError, match=r'providers\[0\].kind: must be'):
    specs.load(_WITH_DOUBLED)


def test_the_json_schema_has_a_provider_of_ones_own():
  with helpers.registered(providers.PROVIDERS, 'test_doubled', _Doubled):
    text = json.dumps(specs.json_schema())
  assert '"const": "test_doubled"' in text
  assert '"const": "test_doubled"' not in json.dumps(specs.json_schema())


@final
class _Stubborn(registers.Register):
  """Holds what it was told to hold, whatever is written."""

  def _build(self, name: str, *, held: float = 0.0, **kwargs: Any) -> None:
    self._held = held
    super()._build(name, **kwargs)

  def _build_blocks(self) -> list[Any]:
    return [self._add_block('block', 'offset_block', (0.0, 0.0))]

  def _put(self, physics: Any, value: np.ndarray) -> None:
    del physics, value

  def _look(self, physics: Any) -> np.ndarray:
    return self.applied(physics) * 0 + self._held


def test_a_register_kind_of_ones_own_is_usable_by_name_with_options():
  design = _reward(kind='test_stubborn', options={'held': 5.5})
  kinds = register_kinds.REGISTER_KINDS
  with helpers.registered(kinds, 'test_stubborn', _Stubborn):
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
    register_kinds.REGISTER_KINDS.add('two_block')(_Stubborn)


@pytest.mark.parametrize(
    ('num_substeps', 'expected'),
    [(10, (3, 6)), (1, (0, 0)), (2, (0, 1)), (3, (1, 2)), (20, (6, 13))],
)
def test_the_default_schedule_is_a_third_and_two_thirds(
    num_substeps: int, expected: tuple[int, int]
):
  schedule = specs.load(_DESIGN).schedule_for(num_substeps)
  assert (schedule.meter_substep, schedule.provider_substep) == expected


@pytest.mark.parametrize('num_substeps', [1, 10])
def test_the_schedule_of_the_cfmdp_comes_before_the_world_ticks(
    num_substeps: int,
):
  schedule = specs.load(_design(schedule='cfmdp')).schedule_for(num_substeps)
  assert (schedule.meter_substep, schedule.provider_substep) == (0, 0)


def test_no_name_of_a_register_is_mixed_up_with_a_part_of_the_world():
  taken = ('feedback', 'avatar', 'apples', 'world', 'floor', 'reward_base')
  design = _design(
      channel='welded',
      registers={
          name: {**_REWARD, 'place': [1.5, i * 0.9 - 2], 'range': [0, 1]}
          for i, name in enumerate(('reward', *taken))
      },
      meters=[],
      providers=[{'kind': 'constant', 'value': 0.5, 'writes': list(taken)}],
  )
  env = suite.load(*_ON_TWO, {'random': 1}, design=design)
  env.reset()
  observation = env.step(helpers.no_op(env)).observation
  env.close()
  assert observation['registers/reward'] == 0
  for name in taken:
    np.testing.assert_allclose(observation[f'registers/{name}'], 0.5)
