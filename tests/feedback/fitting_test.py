"""Ranges that designs do not state give way to what worlds declare."""

import contextlib
from typing import Any

import numpy as np
import pytest
import yaml

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs

_REWARD = 'instantaneous_reward'
_OPEN = {
    'comparisons': 'd6223abda595493a',
    'inspected_reward': '37ab4200e5ed2ad0',
    _REWARD: '6a8db3b9a6da60b8',
    'myopic_approval': 'a790a19fb0be63d2',
}


@pytest.mark.parametrize('name', _OPEN)
def test_designs_keep_their_digest_where_they_fit_and_load_elsewhere(name: str):
  with contextlib.closing(suite.load('unlock_door.near', design=name)) as env:
    assert env.mechanism.design.digest() == _OPEN[name]
  number = 0
  for world in ('off_switch.far', 'assistant.train', 'good_objects.member_1'):
    with contextlib.closing(suite.load(world, design=name)) as env:
      design = env.mechanism.design
      low, high = env.task.measured_ranges['score']
    assert design.digest() != _OPEN[name]
    for spec in design.registers.values():
      number += spec.role == 'meter'
      assert spec.role != 'meter' or spec.range == (low, high)
      assert (spec.range[1] - spec.range[0]) * spec.scale <= 2
  assert number == 3


@pytest.mark.parametrize(
    ('declared', 'score', 'reward'),
    [
        ((0, 0.001), ((0, 20), 0.1), ((-2, 12), 0.1)),
        ((0, 0), ((0, 20), 0.1), ((-2, 12), 0.1)),
        ((-0.1, 0.2), ((-0.1, 0.2), 0.1), ((-2, 12), 0.1)),
        ((-5, -1), ((-5, 0), 0.08), ((-5, 5), 0.08)),
        ((-3, -3), ((-3, 0), 0.1), ((-3, 3), 0.1)),
        ((30, 30), ((0, 30), 0.066), ((-30, 30), 0.013)),
        ((np.float32(-1), 99), ((-1, 99), 0.02), ((-100, 100), 4e-3)),
    ],
)
def test_a_range_is_that_of_the_world_and_takes_no_more_room(
    declared: Any, score: Any, reward: Any
):
  design = specs.load(_REWARD).fitted({'score': declared})
  fitted = [(s.range, s.scale) for s in design.registers.values()]
  assert fitted == [reward, score]
  again = specs.load(specs.load(design, ['dof=planar']), ['dof=free'])
  assert again.digest() == design.fitted({'score': declared}).digest()


def test_a_scale_that_no_one_would_state_is_said():
  text = r"'instantaneous_reward', .*: registers.{} is {}, so a block .* adds"
  design = specs.load(_REWARD)
  with (
      pytest.warns(UserWarning, match=text.format('score.scale', '0.0004')),
      pytest.warns(UserWarning, match=text.format('reward.scale', '0.00039')),
  ):
    fitted = design.fitted({'score': (-1e3, 7)})
  scales = {name: spec.scale for name, spec in fitted.registers.items()}
  assert scales == {'score': 4e-4, 'reward': 3.9e-4}
  stated = specs.load(design, [f'registers.{n}.scale=0.0001' for n in scales])
  stated.fitted({'score': (-1e3, 7)})  # No warning, which would be an error.


@pytest.mark.parametrize('declared', [(-1e6, 1e6), (-np.inf, 0), (0, 1e12)])
def test_a_range_without_room_is_refused(declared: Any):
  text = refusals.refusal(specs.load(_REWARD).fitted, {'score': declared})
  assert text.startswith(f"design '{_REWARD}', with the ranges that this world")
  assert 'registers.' in text


@pytest.mark.parametrize(
    ('scale', 'fitted'),
    [('0.1', 0.1), ('0.001', 0.001), ('{usual: 0.1}', 0.04)],
)
def test_a_stated_scale_stays(scale: str, fitted: float):
  design = specs.load(_REWARD, [f'registers.score.scale={scale}'])
  for one in (design, specs.load(design, ['dof=planar'])):
    score = one.fitted({'score': (-10, 5)}).registers['score']
    assert (score.range, score.scale) == ((-10, 5), fitted)


@pytest.mark.parametrize(
    ('override', 'form'),
    [
        ('range={usul: [0, 20]}', '[low, high]'),
        ('range={usual: 20}', '[low, high]'),
        ('range={usual: [0, 20], low: 3}', '[low, high]'),
        ('scale={usul: 1}', 'scale'),
        ('scale={usual: [1]}', 'scale'),
        ('scale={}', 'scale'),
    ],
)
def test_an_open_value_has_one_form(override: str, form: str):
  override = f'registers.score.{override}'
  said = refusals.refusal(specs.load, _REWARD, [override])
  assert said.startswith(f'override {override!r}: registers.score: ')
  assert said.endswith(f'; must be {form} or {{usual: {form}}}')


def test_only_what_the_world_writes_has_to_fit_a_stated_range():
  world = 'unlock_door.near'
  for name in ('reward', 'score'):
    override = f'registers.{name}.range=[0, 1]'
    with contextlib.ExitStack() as stack:
      if name == 'score':
        stack.enter_context(pytest.raises(errors.SpecError, match='contain'))
      env = suite.load(world, design=_REWARD, overrides=[override])
      stack.callback(env.close)
      assert env.mechanism.registers[name].value_range == (0, 1)


def test_feedback_follows_the_meters_that_it_is_computed_from():
  open_range = {**designs.SCORE, 'range': {'usual': [0, 2]}}
  fine = {'kind': 'inspection', 'reads': ['a', 'c', 'm'], 'penalty': 3}
  paid: dict[str, Any] = {'kind': 'growth', 'reads': ['a'], 'writes': ['f']}
  data = {
      'schema': 1,
      'name': 'd',
      'registers': {
          **{name: open_range for name in 'abc'},
          'm': {**open_range, 'role': 'memory', 'initial': 1},
          **{n: {**open_range, 'role': 'feedback'} for n in 'fgh'},
      },
      'meters': [{'measures': f'measure_{n}', 'writes': n} for n in 'abc'],
      'providers': [
          {'kind': 'relay', 'reads': ['g'], 'writes': ['h']},
          {**paid, 'reads': ['a', 'b'], 'writes': ['g'], 'weights': [1, -2]},
          {**fine, 'pays': paid, 'writes': ['f', 'm']},
      ],
  }
  worlds = {'measure_a': (-1.0, 1.0)}, {'measure_a': (0.0, 4.0)}
  fitted = specs.load(data).fitted(*worlds).registers
  assert fitted['a'].range == (-1, 4)
  assert fitted['f'].range == (-8, 5)  # A growth of 5, less a fine of 3.
  assert fitted['g'].range == fitted['h'].range == (-9, 9)
  assert all(fitted[name].range == (0, 2) for name in 'bcm')


def test_a_resolved_design_is_kept_by_files_twins_batches_and_experiments():
  world = ('off_switch.near', None, {'random': 2}, {'max_steps': 5})
  design: Any = _REWARD
  facts = []
  for _ in ('named', 'written'):
    env, twin = (
        suite.load(*world, design=design, overrides=[f'channel={channel}'])
        for channel in ('embedded', 'secure')
    )
    batch = suite.load_batch(*world, num_envs=2, design=design)
    digest = env.mechanism.design.digest()
    assert batch.mechanism.design.digest() == digest
    ranges = [
        [(r.value_range, r.scale) for r in one.mechanism.registers.values()]
        for one in (env, twin)
    ]
    assert ranges[0] == ranges[1] == [((-24, 24), 0.016), ((-16, 8), 0.025)]
    together = batch.reset().observation
    for key, value in env.reset().observation.items():
      np.testing.assert_array_equal(together[key][0], value)
    step = env.step(helpers.no_op(env))
    facts.append((digest, helpers.to_bytes(step)))
    text = yaml.safe_dump(env.mechanism.design.to_mapping())
    design = yaml.safe_load(text)
  assert facts[0] == facts[1]
  experiment = experiment_specs.load('quick').on_task('off_switch.near')
  copy = experiment_specs.load(experiment.to_copy())
  for one in (experiment, copy):
    assert one.designs['reward'].registers['score'].range == (-16, 8)
  assert copy.designs == experiment.designs


def test_one_design_serves_all_worlds_of_a_class():
  experiment = experiment_specs.load(
      {
          **experiment_specs.load('quick').to_mapping(),
          'task': 'assistant.held_out',
          'runs': {'reward': {'design': _REWARD}},
          'training': {'tasks': ['assistant.train'], 'adaptation': 1000},
      }
  )
  assert experiment.designs['reward'].registers['score'].range == (-6, 6)


def test_true_feedback_is_representable_where_people_and_policies_act():
  for name in ('off_switch.standard', 'assistant.held_out'):
    with contextlib.closing(suite.load(name, task_kwargs={'random': 3})) as env:
      for policy in (env.task.SOLVER, 'random'):
        [result] = evaluate.evaluate(env, policies.make(policy), 1)
        assert [one.saturation for one in result.registers.values()] == [0, 0]
