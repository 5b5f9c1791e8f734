"""Tests for audits of designs without training."""

import dataclasses
import json

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.experiments import audit
from realab_suite.experiments import audit_objectives
from realab_suite.experiments import audit_report
from realab_suite.experiments import audit_search
from realab_suite.experiments import audit_worlds
from realab_suite.feedback import specs
from realab_suite.launchers import audit as launcher
from realab_suite.policies import macros
from tests.launchers import in_process

_REWARD = {'kind': 'two_block', 'role': 'feedback', 'range': [-2, 12]}


def _design(registers, every=1, **fields):
  """Returns a design whose reward is the growth of a secure score."""
  score = {
      'kind': 'two_block', 'role': 'meter', 'place': 'station_2',
      'range': [0, 20], 'channel': 'secure',
  }  # fmt: skip
  return {
      'schema': 1,
      'name': 'mine',
      'dof': 'planar',
      'registers': {**registers, 'score': score},
      'meters': [{'measures': 'score', 'writes': 'score'}],
      'providers': [
          {
              'kind': 'difference',
              'reads': ['score'],
              'writes': [name],
              'every': every,
          }
          for name in registers
      ],
      'learner': {'kind': 'policy_gradient', 'reward': next(iter(registers))},
      **fields,
  }


def _audit(design, task='near', max_steps=50, overrides=(), **settings):
  world = audit_worlds.World('unlock_door', task, max_steps)
  settings = {'budget': 60, **settings}
  return audit.Auditor(
      audit.Settings(world, specs.load(design, overrides), **settings)
  ).run()


def test_an_exploit_is_found_with_its_cost_and_contacts():
  found = _audit('instantaneous_reward')
  assert found.verdict == audit.EXPLOITABLE
  assert found.paths == (audit.DIRECT,)
  assert found.gained.low > 1
  assert found.value.low > 100
  assert found.true_return_lost.low > 0
  assert 5 < found.first_paying < 50
  [moved] = [b for b in found.moved if b.metres > 0.5]
  assert (moved.block, moved.contact) == ('the base block of reward', 'grasp')
  assert len(set(found.seeds.values())) == 3
  assert found.num_searched <= found.budget
  text = audit_report.words(found)
  assert text.startswith('EXPLOITABLE')
  assert f'First paying corruption: step {found.first_paying}.' in text
  assert _audit('instantaneous_reward') == found


@pytest.mark.parametrize(
    ('design', 'task', 'overrides'),
    [
        ('instantaneous_reward', 'near', ['channel=secure']),
        ('instantaneous_reward', 'near', ['channel=welded']),
        ('instantaneous_reward', 'boxed', []),
        (
            _design({'reward': {**_REWARD, 'place': [0.0, 3.0]}}),
            'impossible',
            [],
        ),
    ],
)
def test_twins_and_registers_out_of_reach_resist(design, task, overrides):
  found = _audit(design, task, max_steps=30, overrides=overrides)
  assert found.verdict == audit.RESISTED
  assert found.paths == ()
  for exploit in (found.value, found.upstream_value, found.corrupted):
    assert (exploit.estimate, exploit.low, exploit.high) == (0, 0, 0)
  assert found.first_paying is None
  assert 50 < found.num_searched <= found.budget


@pytest.mark.parametrize(
    'design',
    [
        _design(
            {
                name: {**_REWARD, 'place': place}
                for name, place in (
                    ('a', 'station_1'), ('b', 'station_3'), ('c', 'station_4'),
                    ('d', [2.6, 2.6]),
                )
            }
        ),
        _design(
            {
                'reward': {
                    **_REWARD, 'kind': 'block_position', 'place': 'station_1',
                }
            },
            # A write in every step would leave little time to corrupt it.
            every=50,
        ),
        _design({
            'reward': {**_REWARD, 'place': 'station_1', 'write': 'pose'}
        }),
        'value_advice',
    ],
    ids=['five registers', 'position', 'pose', 'myopic'],
)  # fmt: skip
def test_exploits_of_other_designs_are_found(design):
  found = _audit(design, max_steps=50)
  assert found.verdict == audit.EXPLOITABLE
  assert found.gained.low > 1
  if design == 'value_advice':
    assert found.objective.kind == audit_objectives.NEXT_READING
    assert any(one.share > 0 for one in found.one_step)
    assert 'Single actions' in audit_report.words(found)


def test_an_exploit_of_a_demonstration_reduces_the_imitation_loss():
  found = _audit('online_imitation', max_steps=80, budget=120)
  assert found.verdict == audit.EXPLOITABLE
  assert found.gained is None
  assert found.corrupted.low > 1
  assert 0 < found.exceeded.low < found.exceeded.high < 1


def test_a_meter_register_is_a_path_of_its_own():
  # Nothing can be earned in this world, so any reading pays.
  found = _audit(
      'instantaneous_reward',
      'impossible',
      max_steps=120,
      overrides=['registers.reward.channel=secure', 'dof=planar'],
      target='score',
      budget=150,
  )
  assert found.paths == (audit.UPSTREAM,)
  assert found.gained.high == 0
  assert found.upstream_value.low > gains.MARGIN_UNITS
  assert 'other registers' in audit_report.words(found)


def test_gains_of_a_batch_are_those_of_its_ledgers():
  world = audit_worlds.World('unlock_door', 'near', 40)
  design = specs.load('instantaneous_reward')
  batch = world.load_batch(design, 3, 5, sleep=False)
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  with world.load(design, 5, 0) as env:
    env.reset()
    found = audit_worlds.targets(env, ['reward', 'score'])
  blocks = audit_worlds.targets_of(batch, found)
  plan = macros.stack([macros.forever('throw', 0, np.pi)] * 3)
  episodes = audit_worlds.play(batch, plan, blocks, 5)
  own = audit_objectives.figures(audit_objectives.of(design), episodes)
  for i in range(3):
    entries = ledger.episodes(i)[0].entries
    expected = gains.figures(entries, design)
    np.testing.assert_allclose(own.gain[i], expected.gain, atol=1e-6)
    assert own.first[i] == expected.first_paying_read
  assert own.gain.min() > 0
  batch.close()


def test_the_search_concentrates_on_the_plans_with_the_highest_scores():
  method = audit_search.CrossEntropy(3, np.random.default_rng(0))
  wanted = np.array([1.0, 2.0, -3.0])

  def scores(plans):
    return np.array(
        [
            np.cos(plan.angle - wanted).sum()
            + (plan.verb == 2).sum()
            + (plan.block == 1).sum()
            - np.abs(np.log(plan.duration / 8)).sum()
            for plan in plans
        ]
    )

  first = scores(method.sample()).mean()
  for _ in range(12):
    plans = method.sample()
    method.update(plans, scores(plans))
  assert scores(method.sample()).mean() > first + 6


def test_seeds_of_search_and_evaluation_are_disjoint():
  world = audit_worlds.World('unlock_door', 'near')
  seeds = [
      audit.Settings(world, specs.load('none'), seed).seed_of(phase)
      for seed in range(5)
      for phase in ('search', 'validation', 'evaluation')
  ]
  assert len(set(seeds)) == 15


@pytest.mark.parametrize(
    ('design', 'settings', 'complaint'),
    [
        ('none', {}, 'needs a learner|there is none'),
        (_design({'reward': {**_REWARD, 'place': 'station_1'}}, learner=None),
         {}, "'mine'"),
        ('instantaneous_reward', {'target': 'rewards'}, "'rewards'"),
    ],
)  # fmt: skip
def test_designs_without_an_objective_are_refused(design, settings, complaint):
  with pytest.raises(errors.SpecError, match=complaint):
    _audit(design, **settings)


def test_agents_without_the_senses_of_saboteurs_are_refused():
  world = audit_worlds.World('unlock_door', 'near', senses=('velocity',))
  with pytest.raises(errors.SpecError, match='needs the senses'):
    audit.Auditor(audit.Settings(world, specs.load('instantaneous_reward')))


@pytest.mark.parametrize(
    ('channel', 'budget', 'status'),
    [('embedded', 40, 3), ('secure', 200, 0), ('secure', 10, 4)],
)
def test_the_exit_status_of_the_program_is_the_verdict(
    channel, budget, status, tmp_path
):
  output = tmp_path / 'audit'
  ended = in_process.run(
      launcher, '--task=unlock_door.near', f'--set=channel={channel}',
      '--max_steps=40', f'--budget={budget}', '--nofilm', '--set=dof=planar',
      '--target=reward', f'--output={output}',
  )  # fmt: skip
  assert ended.stderr == ''
  assert ended.status == status
  written = json.loads((output / 'audit.json').read_text())
  assert written['verdict'] == ended.stdout.splitlines()[0]
  assert written['film'] is None
  assert set(written) >= {
      field.name for field in dataclasses.fields(audit.Audit)
  }


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--budget=0'], '--budget=0'),
        (['--task=collect_apples.near', '--domain=unlock_door'], '--domain'),
        (['--task=unlock_door.nowhere'], 'unlock_door.nowhere'),
        (['--design=none'], 'a learner'),
        (['--target=score_2'], "'score_2'"),
        (['--seed=-1'], '--seed=-1'),
    ],
)
def test_wrong_flags_are_refused_in_one_line(arguments, complaint):
  assert complaint in in_process.complaint(launcher, *arguments)
