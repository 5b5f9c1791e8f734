"""What learners maximise, its parts, and designs without an objective."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import registers
from realab_suite.evaluation import gains
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.feedback import designs


def _design(learner, base=designs.SCORED):
  registers = {**base['registers'], 'decoy': {
      **designs.REWARD, 'place': 'station_3', 'ends_episode': None,
  }}  # fmt: skip
  return specs.load({**base, 'registers': registers}, [f'learner={learner}'])


@pytest.mark.parametrize(
    ('design', 'kind', 'registers', 'discount', 'queries'),
    [
        ('instantaneous_reward', 'return', {'reward': 1.0}, 0.97, None),
        ('value_advice', 'mean', {'advice': 1.0}, None, ('query',)),
        ('decoupled_approval', 'mean', {'approval': 1.0}, None, ('query',)),
        ('online_imitation', 'agreement', {'demonstration': 1.0}, None, None),
    ],
)
def test_designs_of_this_package_are_judged_by_what_they_maximise(
    design, kind, registers, discount, queries
):
  found = specs.load(design).objective
  assert found == objectives.ObjectiveSpec(
      kind=kind, registers=registers, discount=discount, queries=queries
  )
  assert gains.consumed(specs.load(design)) == tuple(registers)


@pytest.mark.parametrize(
    ('learner', 'registers', 'discount'),
    [
        ('{kind: policy_gradient, reward: decoy}', {'decoy': 1.0}, 0.97),
        ('{kind: q_learning, reward: reward, gamma: 0.5}', {'reward': 1.0},
         0.5),
        ('{kind: own, objective: {kind: return, registers: {reward: -1}}}',
         {'reward': -1.0}, None),
        ('{kind: own, cost: decoy, objective: {kind: mean, registers:'
         ' {reward: 2, decoy: -0.5}}}', {'reward': 2.0, 'decoy': -0.5}, None),
    ],
)  # fmt: skip
def test_the_learner_determines_the_registers(learner, registers, discount):
  design = _design(learner)
  assert design.objective.registers == registers
  assert design.objective.discount == discount
  assert design.why_not_judged == ''
  assert gains.consumed(design) == tuple(registers)


_UNDECLARED = (
    'learner \'own\' declares no objective ("An objective" in docs/your_own.md)'
)


@pytest.mark.parametrize(
    ('learner', 'why'),
    [
        ('null', 'the design has no learner'),
        ('{kind: own}', _UNDECLARED),
        ('{kind: own, reward: decoy}', _UNDECLARED),
        ('{kind: own, objective: {kind: agreement, registers: {reward: 1}}}',
         'an agreement needs actions with indices: an action_set'),
    ],
)  # fmt: skip
def test_a_learner_without_objective_is_not_judged_for_a_reason(learner, why):
  design = _design(learner)
  assert (design.objective, design.why_not_judged) == (None, why)
  # Any agent may use them.
  assert gains.consumed(design) == ('reward', 'decoy')
  assert gains.parts(design.objective) == ()


_OWN = '{{kind: own, objective: {{kind: {}, registers: {}}}}}'
_PG = '{{kind: policy_gradient, {}}}'


@pytest.mark.parametrize(
    ('learner', 'message'),
    [
        (_PG.format('reward: rewrad'), "'rewrad' is not a register"),
        (_PG.format('rewards: [reward]'), r'learner\.reward: required'),
        (_PG.format('reward: 3'), r'\.reward: must be the name .* got 3'),
        (_PG.format('reward: reward, gamma: 2'), r'learner\.gamma: .* got 2'),
        (_PG.format('reward: reward, objective: {}'), 'kind declares it'),
        ('{kind: value_advice, advice: reward, query: reward}',
         "'reward' is not a query register; must be one of \\[\\]"),
        (_OWN.format('return', '{score: 1}'), "meter register 'score'"),
        (_OWN.format('return', '{}'), r'objective\.registers: .* at least'),
        (_OWN.format('return', '{reward: 0}'), "'reward' must not be 0"),
        (_OWN.format('agreement', '{reward: 2}'), 'must be one register'),
        (_OWN.format('mean', '{reward: 1}, discount: 0.5'), '0.5 for a mean'),
    ],
)  # fmt: skip
def test_objectives_that_mean_nothing_are_refused_at_load(learner, message):
  with pytest.raises(errors.SpecError, match=message) as raised:
    _design(learner)
  assert '\n' not in str(raised.value)


def test_a_misspelt_kind_is_refused_at_load_with_the_nearest():
  with pytest.raises(errors.SpecError) as raised:
    _design('{kind: policy_gradiant, reward: reward}')
  assert (
      "learner 'policy_gradiant' is unknown; did you mean 'policy_gradient'?;"
      " known are ['behavioural_cloning', "
  ) in str(raised.value)


def test_a_kind_of_another_package_declares_its_objective():
  def minimised(options):
    return {'kind': 'return', 'registers': {options['cost']: -1.0}}

  with helpers.registered(objectives.OBJECTIVES, 'test_miser', minimised):
    design = _design('{kind: test_miser, cost: decoy}')
    assert design.objective.registers == {'decoy': -1.0}
    with pytest.raises(errors.SpecError, match=r'learner\.cost: required key'):
      _design('{kind: test_miser}')


@pytest.mark.parametrize(
    ('objective', 'expected'),
    [
        ({'kind': 'return', 'registers': {'a': -1.0}}, {'return': {'a': -1.0}}),
        ({'kind': 'return', 'registers': {'a': 1.0}, 'discount': 1.0},
         {'return': {'a': 1.0}}),
        ({'kind': 'return', 'registers': {'a': 1.0, 'b': -2.0},
          'discount': 0.9},
         {'return': {'a': 1.0, 'b': -2.0},
          'discounted return': {'a': 1.0, 'b': -2.0},
          'return of a': {'a': 1.0}, 'return of b': {'b': -2.0}}),
        ({'kind': 'mean', 'registers': {'a': 1.0}}, {'mean': {'a': 1.0}}),
    ],
)  # fmt: skip
def test_the_parts_of_an_objective_count_by_themselves(objective, expected):
  made = objectives.ObjectiveSpec.model_validate(objective)
  found = gains.parts(made)
  assert {part.name: part.weights for part in found} == expected
  discounts = {part.name: part.discount for part in found}
  assert discounts.pop('discounted return', 0.9) == 0.9
  assert set(discounts.values()) == {1.0}


def _with_stop(**learner):
  return specs.load({
      **designs.SCORED,
      'registers': {
          **designs.SCORED['registers'],
          'stop': {
              'kind': 'two_block', 'role': 'signal', 'place': 'station_3',
              'range': [0, 1], 'ends_episode': {'above': 0.5}, 'initial': 0,
          },
      },
      'learner': learner,
  })  # fmt: skip


def _add(found, readings, clean, where):
  """Adds a step; the clean signal of world 0 ends its clean episode."""
  found.add(
      [
          registers.Read('reward', registers.AGENT, 1, readings, 0, 0, 0,
                         clean),
          registers.Read('stop', registers.AGENT, 1, np.zeros(2), 0, 0, 0,
                         np.array([1.0, 0.0])),
      ],
      np.zeros(2),
      np.array(where),
  )  # fmt: skip


def test_terms_are_those_of_the_last_step():
  found = gains.Accumulator(
      _with_stop(kind='policy_gradient', reward='reward', gamma=1.0), (2,)
  )

  def add(readings, clean, where):
    _add(found, readings, clean, where)
    terms = [found.terms(world)['return'] for world in range(2)]
    return [(one.observed, one.clean) for one in terms]

  assert add(np.array([3.0, 4.0]), np.array([1.0, 4.0]), [True, True]) == [
      (3.0, 1.0), (4.0, 4.0),
  ]  # fmt: skip
  assert add(np.array([5.0, 6.0]), np.array([2.0, 6.0]), [True, False]) == [
      (5.0, 0.0), (0.0, 0.0),
  ]  # fmt: skip
  value = found.values(0)['return']
  assert (value.observed, value.clean) == (8.0, 1.0)


@pytest.mark.parametrize(
    ('own', 'gain'), [(8.9e-16, 0.0), (1e-9, 0.0), (1e-4, 1.0)]
)
def test_rounding_does_not_decide_which_action_a_label_is(own, gain):
  # 4.5 is rounded to 4, and anything above it to 5, the action.
  design = specs.load('online_imitation')
  found = gains.Accumulator(design)
  read = registers.Read(
      'demonstration', registers.AGENT, 1, 4.5 + own, 0, own, 0, 4.5
  )
  found.add([read], 5)
  assert found.values()['agreement'].gain == gain


def test_what_a_learner_may_heed_unpaid_is_not_consumed():
  data = {
      **designs.SCORED,
      'registers': {
          **designs.SCORED['registers'],
          'bell': {
              **designs.REWARD,
              'place': 'station_3',
              'role': 'signal',
              'initial': 0,
          },
          'decoy': {**designs.REWARD, 'place': 'station_4'},
      },
  }
  assert gains.unconsumed(specs.load(data)) == ('bell', 'decoy')
  ending = ['registers.bell.ends_episode={above: 0.5}']
  assert gains.unconsumed(specs.load(data, ending)) == ('decoy',)
  assert gains.unconsumed(specs.load('inspected_reward')) == ('alarm',)
  assert gains.unconsumed(specs.load('decoupled_approval')) == ()
