"""Tests for designs that are refused: one line with the key and the reason."""

import contextlib
from typing import Any, Literal

from dm_control import composer
import pytest

from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import stubs

_NOTE = (
    'registers.note={kind: two_block, role: memory, place: station_3, range:'
    ' [0, 1]}'
)
# Overrides of a design, separated by ' & ', and a part of the message.
_WRONG = {
    'metres=[]': "unknown key 'metres'; did you mean 'meters'?",
    'providers.0.initail=1':
        "providers[0]: unknown key 'initail'; did you mean 'initial'?",
    'schema=2': 'schema: must be 1, got 2',
    'name="a\\n"': 'name: must be at most 64 of',
    f'name={"a" * 65}': 'name: must be at most 64 of',
    'registers.Reward=null':
        "of which a letter is the first, got 'Reward'",
    'registers.reward.range=[3, -3]':
        'registers.reward: range [3.0, -3.0] must have low < high',
    'registers.reward.range=[-1e308, 1e308]':
        'registers.reward.range[0]: must be greater than or equal to -100000',
    'registers.reward.initial=50':
        'initial 50.0 must be in range [-2.0, 12.0]',
    'registers.reward.block_size=0.05':
        'block_size: must be greater than or equal to 0.06, got 0.05',
    'registers.reward.place=[1e300, 0]':
        'registers.reward.place[0]: must be less than or equal to 100',
    'registers.reward.kind=tow_block':
        "register kind 'tow_block' is unknown; did you mean 'two_block'?",
    'registers.reward.role=reward':
        "role: must be 'feedback', 'meter', 'query', 'signal' or 'memory', got",
    'registers.reward.options={held: 1}':
        "registers.reward.options: unknown key 'held'",
    'meters.0.writes=scores':
        "meters[0].writes: register 'scores' is not declared; did you mean"
        " 'score'?; declared are ['reward', 'score']",
    'meters.0.writes=reward':
        "meters[0].writes: register 'reward' has role 'feedback'; must be"
        " one of ['meter']",
    'providers.0.writes=[score]':
        "providers[0].writes: register 'score' has role 'meter'; must be"
        " one of ['feedback', 'signal', 'memory']",
    'providers.0.kind=diference':
        "providers[0].kind: provider kind 'diference' is unknown; did you mean"
        " 'difference'?; known are ['appraisal', ",
    'providers.0.reads=[score, reward]': 'reads: must have at most 1 item',
    'learner.reward=score':
        "learner.reward: an agent may not read meter register 'score'"
        ' (feedback providers only)',
    f'{_NOTE} & learner.reward=note':
        "learner.reward: an agent may not read memory register 'note'",
    f'{_NOTE} & learner={{kind: x, weights: [{{note: 1}}]}}':
        "an agent may not read memory register 'note'",
    f'{_NOTE} & meters.0.writes=note':
        "meters[0].writes: register 'note' has role 'memory'; must be one of"
        " ['meter']",
    'learner={reward: reward}': 'learner.kind: required key is missing',
    'providers.0={kind: demonstration, policy: no_op, writes: [reward]}':
        'demonstration uses action set dmlab_like v1; the design has None',
    'action_set={name: dmlab, version: 1}':
        "action_set: action set 'dmlab v1' is unknown; did you mean"
        " 'dmlab_like v1'?; known are ['dmlab_like v1', ",
    'schedule={meter_substep: 5, provider_substep: 3}':
        'meter_substep 5 must not come after provider_substep 3',
    'registers.extra={kind: two_block, role: feedback, place: station_3, range:'
    ' [-2, 12]}': 'registers.extra: no provider writes this feedback register',
    'meters=[] & registers.score={kind: two_block, role: meter, range: [0, 20],'
    ' place: station_2}':
        "providers[0].reads: no meter writes the register 'score'",
    'providers=[{kind: constant, writes: [reward]},'
    ' {kind: constant, writes: [reward]}]':
        "providers[1].writes: register 'reward' is written by providers[0]"
        ' already; a register must have one writer',
    'meters=[{measures: score, writes: score}, {measures: score, writes:'
    ' score}]': "register 'score' is written by meters[0] already",
    'providers.0={kind: constant, reads: [score, score], writes: [reward]}':
        "providers[0].reads: register 'score' is listed twice",
}  # fmt: skip
_PAIRED = 'providers.0.kind=paired_advice & providers.0.reads='
_WRONG_ADVICE = {
    'providers.0={kind: demonstration, policy: no_opp, writes: [reward]}':
        "policy 'no_opp' is unknown; did you mean 'no_op'?",
    'providers.0.value_function=oracle': "value function 'oracle' is unknown",
    'providers.0={kind: demonstration, policy: no_op, writes: [reward]}':
        'registers.reward.range: [-2.0, 12.0] excludes actions of dmlab_like'
        ' v1, whose indices providers[0] uses; must be a range that contains'
        ' [0, 13]',
    'registers.query.range=[0, 1]':
        'registers.query.range: [0.0, 1.0] excludes actions of dmlab_like v1',
    'providers.0.query_delay=2': 'query_delay: must be 0 or 1, got 2',
    'providers.0.query_delay=1 & learner={kind: value_advice, advice: reward}':
        'providers[0]: query_delay: 1 here, and 0 in the learner value_advice',
    'learner={kind: decoupled_approval, approval: reward, query_delay: 1}':
        'query_delay: 0 here, and 1 in the learner decoupled_approval; must be'
        ' the same in both: 0 for the query of the current step, or 1 for'
        ' that of the previous one',
    'registers.query.role=meter':
        "value_advice reads the query from 'query', whose role is 'meter';"
        ' must be query',
    f'{_PAIRED}[query, reward]':
        "paired_advice reads a query from 'reward', whose role is 'feedback';"
        ' must be query',
}  # fmt: skip
# The same, where the mistake depends on the world.
_DOES_NOT_FIT = {
    'registers.reward.place=moon':
        "registers.reward.place: this world has no place 'moon'; must be"
        " one of ['station_1', 'station_2',",
    'meters.0.measures=scor':
        "design 'd': meters[0].measures: 'scor' cannot be measured in this"
        " world; did you mean 'score'?; must be ['score']",
    'registers.reward.place=[0, 0] & registers.reward.range=[0, 200]':
        "register 'reward' at value 40.625 would be at (4.06, 0.25), outside"
        ' the arena (-4, -4) to (4, 4); change its place, or narrow its range'
        ' (registers.reward.range)',
    'registers.reward.place=[9, 0]':
        "register 'reward' at value -2 would be at (9, 0), outside the"
        ' arena',
    'registers.reward.place=[0, 3.7] & registers.reward.range=[0, 1]':
        "inside 'wall_north'; place it elsewhere or narrow its range",
    'registers.reward.place={position: [0, 3], spread: [0, 0.7]} &'
    ' registers.reward.range=[0, 1]': "inside 'wall_north'",
    'registers.reward.place=[-2.9, -3.2]':
        "registers 'reward' and 'score' would be in each other's way",
    'registers.reward.kind=block_orientation & registers.reward.scale=1':
        "register 'reward': range [-2.0, 12.0] at scale 1.0 turns the block",
    'schedule={meter_substep: 3, provider_substep: 10}':
        'schedule.provider_substep: 10 must be less than the 4 substeps of a'
        ' control step',
}  # fmt: skip


@pytest.mark.parametrize(('base', 'overrides', 'problem'), [
    *((designs.SCORED, o, problem) for o, problem in _WRONG.items()),
    *((designs.ADVISED, o, problem) for o, problem in _WRONG_ADVICE.items())
])  # fmt: skip
def test_a_wrong_design_is_refused_with_the_reason(
    base: dict[str, Any], overrides: str, problem: str
):
  design = designs.changed(*overrides.split(' & '), base=base)
  text = refusals.refusal(specs.load, design)
  assert text.startswith('design: ')
  assert problem in text


@pytest.mark.parametrize(
    ('overrides', 'problem'), _DOES_NOT_FIT.items(), ids=_DOES_NOT_FIT
)
def test_a_design_that_does_not_fit_its_world_is_refused(
    overrides: str, problem: str
):
  design = designs.changed(*overrides.split(' & '))
  task = 'collect_apples', 'standard'
  assert problem in refusals.refusal(suite.load, *task, design=design)


_REWARD = 'instantaneous_reward'
_DETECTS = 'meters.0.measures={kind: detector, of: [reward]}'


@pytest.mark.parametrize(
    ('world', 'design', 'overrides', 'problem'),
    [
        (
            'off_switch.standard',
            'instantaneous_reward',
            ['registers.score.range=[0, 20]'],
            'score.range: [0, 20]; must contain [-16, 8], the range of'
            " 'score' (meters.0) in this world; give it a smaller"
            ' registers.score.scale if it then lacks room',
        ),
        (
            'off_switch.standard',
            'off_switch',
            ['registers.apples.range=[0, 3]'],
            'apples.range: [0, 3]; must contain [0, 8], the range of'
            " 'apples_eaten' (meters.0) in this world.",
        ),
        (
            'good_objects.member_1',
            'inspected_reward',
            ['registers.meter.range.1=20'],
            'meter.range: [0, 20]; must contain [-6, 6]',
        ),
        (
            'assistant.held_out',
            'instantaneous_reward',
            ['meters.0.measures={kind: score}', 'registers.score.range.0=0'],
            'score.range: [0, 20]; must contain [-1.2, 2.4]',
        ),
        (
            'unlock_door.near',
            'instantaneous_reward',
            ['registers.score.range=[0, 17]'],
            'score.range: [0, 17]; must contain [0, 18]',
        ),
        (
            'unlock_door.near',
            'instantaneous_reward',
            ['registers.score.range=[0, 0.5]', _DETECTS],
            'score.range: [0, 0.5]; must contain [0, 1], the range of',
        ),
        (
            'assistant.train',
            'assistant',
            ['registers.count_a.range=[0, 5]'],
            'count_a.range: [0, 5]; must contain [0, 6]',
        ),
        (
            'assistant.train',
            'assistant',
            ['registers.value.range=[0, 1]'],
            "value.range: [0, 1]; must contain [-1, 1], the range of 'value_a'"
            ' (initial)',
        ),
    ],
)
def test_a_register_that_cannot_hold_what_is_measured_is_refused(
    world: str, design: str, overrides: list[str], problem: str
):
  text = refusals.refusal(suite.load, world, design=design, overrides=overrides)
  assert f'{text}.'.startswith(f'design {design!r}: registers.{problem}')


@pytest.mark.parametrize(
    ('world', 'overrides'),
    [
        ('off_switch.impossible', []),
        ('assistant.train', designs.for_losses('assistant', _REWARD)),
        # Six things that are worth -0.2 or 0.4.
        ('assistant.held_out', ['registers.score.range=[-1.2, 2.4]']),
    ],
)
def test_a_register_that_holds_what_is_measured_is_accepted(
    world: str, overrides: list[str]
):
  env = suite.load(world, design=_REWARD, overrides=overrides)
  with contextlib.closing(env):
    assert 'registers/reward' in env.reset().observation


def test_a_provider_that_fails_in_its_check_is_named():
  class Broken(stubs.Zero):
    kind: Literal['test_broken'] = 'test_broken'

    def check(self, design: Any) -> None:
      raise KeyError('x')

  with helpers.registered(providers.PROVIDERS, 'test_broken', Broken):
    design = designs.changed('providers.0.kind=test_broken')
    text = refusals.refusal(specs.load, design)
  assert text == "design: providers[0]: KeyError: 'x'"


def test_providers_that_form_a_cycle_are_refused():
  order = 'abc'
  design = {
      'schema': 1,
      'name': 'd',
      'registers': {name: designs.REWARD for name in order},
      'providers': [
          {'kind': 'constant', 'reads': [read], 'writes': [write]}
          for read, write in zip(order, order[1:] + order[0], strict=True)
      ],
  }
  text = refusals.refusal(specs.load, design)
  assert 'providers[0]' in text
  assert 'form a cycle' in text


def _point_task(settings: dict[str, Any]) -> composer.Task:
  task = helpers.PointTask()
  option = task.root_entity.mjcf_model.option
  for name, value in settings.items():
    setattr(option.flag if name == 'island' else option, name, value)
  return task


_APART = (
    'registers.reward.place=[3, 3]',
    'registers.score.place=[-3, -3]',
)


@pytest.mark.parametrize(
    ('setting', 'message'),
    [
        ({'solver': 'PGS'}, 'option.solver: mjSOL_PGS; meters need Newton or'),
        ({'island': 'disable'}, 'option.flag.island: disabled'),
        ({'noslip_iterations': 3, 'noslip_tolerance': 1e-6}, 'noslip_toleran'),
    ],
)
def test_meters_are_refused_with_a_solver_that_couples_distant_bodies(
    setting: dict[str, Any], message: str
):
  task = _point_task(setting)
  design = designs.changed(*_APART)
  assert message in refusals.refusal(suite.embed, task, design)


@pytest.mark.parametrize(
    ('solver', 'overrides'),
    [('CG', ()), ('PGS', ('meters=[]',))],
)
def test_other_solvers_and_designs_without_meters_are_accepted(
    solver: str, overrides: tuple[str, ...]
):
  design = designs.changed(*_APART, *overrides)
  env = suite.embed(_point_task({'solver': solver}), design)
  time_step = env.reset()
  assert time_step.first()
  assert [n for n in time_step.observation if n.startswith('registers/')]
  env.close()
