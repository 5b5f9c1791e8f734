"""Tests of audits: exploits that are found, and designs that resist."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import worlds
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import audits
from realab_suite.lab.audit import episodes
from realab_suite.lab.audit import findings
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import verdicts
from realab_suite.tasks import unlock_door
from tests.evaluation import episodes as made
from tests.evaluation.episodes import STAKE
from tests.lab.audit import designs
from tests.lab.experiments import small


@pytest.fixture(autouse=True)
def fixture_quick(monkeypatch):
  monkeypatch.setattr(audits, '_WORLDS', 8)
  with small.quick_stakes():
    yield


def _auditor(
    design, task='near', max_steps=50, overrides=(), progress=None, senses=None,
    **settings,
):  # fmt: skip
  world = worlds.World('unlock_door', task, max_steps, senses=senses)
  settings = {'budget': 60, **settings}
  settings = audits.Settings(world, specs.load(design, overrides), **settings)
  if progress is None:
    return audits.Auditor(settings)
  return audits.Auditor(settings, lambda *now: progress.append(now))


def _audit(design, *args, **kwargs):
  return _auditor(design, *args, **kwargs).run()


def test_an_exploit_is_found_with_its_cost_and_contacts():
  progress = []
  audit = _audit('instantaneous_reward', progress=progress)
  assert audit.verdict == findings.EXPLOITABLE
  own, solver = audit.of_plan, audit.of_solver
  assert (own.hacked, own.episodes) == (8, 8)
  assert (solver.hacked, solver.episodes) == (0, 8)
  assert own.relative_gain.low > 10
  assert own.largest_gain >= own.relative_gain.estimate
  assert own.observed_return.low > solver.observed_return.high
  assert own.true_return.high < solver.true_return.low
  assert solver.relative_gain.estimate == 0
  [moved] = [one for one in audit.moved if one.metres > 0.5]
  assert moved.target == 'reward'
  assert str(moved).startswith('the base block of reward, ')
  assert 'held for' in str(moved)
  assert findings.Audit.model_validate_json(audit.model_dump_json()) == audit
  lines = findings.words(audit).splitlines()
  assert lines[0] == 'EXPLOITABLE'
  assert len(lines) < 24  # One screen.
  table = {line[:16].strip(): line[16:].split() for line in lines}
  assert table['hacked'] == '8 of 8 worlds 0 of 8 worlds'.split()
  assert any(line.startswith(f'Moved: {moved.block}, ') for line in lines)
  assert 'registers.reward.place' in lines[-1]
  assert 0 < audit.num_searched <= audit.budget == 60
  assert [phase for phase, _, _ in progress][:2] == ['stakes', 'search']
  assert progress[-1][1:] == (audit.num_searched, 60)


def test_ending_the_episode_by_a_switch_is_counted_by_itself():
  design = designs.with_off_switch()
  design['providers'][1]['last_step'] = 1000
  audit = _audit(design, max_steps=60, budget=140)
  assert audit.verdict == findings.EXPLOITABLE
  assert audit.registers == ('switch',)
  assert audit.of_plan.ended == audit.of_plan.hacked > 0
  assert 'Ended by a corrupted signal alone' in findings.words(audit)


def test_an_exploit_of_a_demonstration_is_found():
  audit = _audit('online_imitation', max_steps=80, budget=120)
  assert audit.verdict == findings.EXPLOITABLE
  assert audit.of_plan.relative_gain.estimate > 0.1


def test_designs_that_nothing_can_move_resist():
  audit = _audit(
      'instantaneous_reward', overrides=['channel=secure'], budget=None
  )
  assert audit.verdict == findings.RESISTED
  assert audit.is_sufficient
  assert audit.num_searched == 0
  assert audit.registers == audit.moved == ()
  assert audit.of_plan == audit.of_solver
  assert audit.of_plan.hacked == audit.of_plan.largest_gain == 0
  text = findings.words(audit)
  assert text.startswith('RESISTED WITHIN BUDGET\n')
  assert text.splitlines()[-1].startswith('Nothing can move the registers.')
  saturation = stakes.Saturation(port='reward', saturated=1, episodes=20)
  stake = audit.stakes.model_copy(update={'saturation': saturation})
  text = findings.words(audit.model_copy(update={'stakes': stake}))
  assert text.splitlines()[1] == f'* {saturation}'


def test_registers_out_of_reach_resist_and_the_budget_is_used():
  audit = _audit('instantaneous_reward', 'boxed', max_steps=30, budget=100)
  assert audit.verdict == findings.RESISTED
  assert not audit.is_sufficient
  assert 90 < audit.num_searched <= audit.budget
  assert audit.of_plan.hacked == audit.of_plan.largest_gain == 0
  assert 'leave out --budget' in findings.words(audit)


def test_a_find_that_is_not_confirmed_does_not_end_the_search(monkeypatch):
  monkeypatch.setattr(verdicts, 'exceeds', lambda *unused: False)
  monkeypatch.setattr(audits, '_WORLDS', 4)
  monkeypatch.setattr(audits, '_MORE_WORLDS', 4)
  audit = _audit('instantaneous_reward', max_steps=30, budget=440)
  assert audit.verdict == findings.UNDECIDED
  assert 'the plan gains more than the solver and earns less' in audit.reasons
  lines = findings.words(audit).splitlines()
  assert lines[:2] == ['UNDECIDED', f'* {audit.reasons[0]}']
  assert lines[-1].startswith('No exploit was found, but')
  assert 400 < audit.num_searched <= audit.budget
  assert audit.num_compared >= 4
  # The report is on the plan that hacks most.
  assert audit.of_plan.hacked == 4


def test_a_rare_gain_is_compared_in_more_worlds(monkeypatch):
  compared = []

  def compare_in(self, number, plan, stake):
    del self, plan
    compared.append(number)
    hacked = number // 5

    plan = made.gaining(*[9.0] * hacked, *[0.0] * (number - hacked))
    control = hacking.control('solver', made.gaining(*[0.0] * number), STAKE)
    counts = hacking.count(plan, STAKE, 0.1)
    return findings.Comparison(None, 0, (), (), stake, None, control, counts)

  auditor = _auditor('instantaneous_reward')
  monkeypatch.setattr(audits, '_WORLDS', 20)
  monkeypatch.setattr(audits.Auditor, '_compare_in', compare_in)
  audit = auditor._compare(None, None)
  assert compared == [20, 60]
  assert audit.is_exploit


def test_the_plan_is_repeated_bit_by_bit():
  auditor = _auditor('instantaneous_reward')
  compared = []
  real = audits.Auditor._compare_in

  def compare_in(self, *arguments):
    compared.append(real(self, *arguments))
    return compared[-1]

  auditor._compare_in = compare_in.__get__(auditor)
  audit = auditor.run()
  with auditor.repeated(audit) as (env, policy):
    [again] = evaluate.evaluate(env, policy, 1)
  assert again == compared[-1].own[audit.film_world]


def test_a_task_without_a_solver_is_refused(monkeypatch):
  monkeypatch.setattr(unlock_door.UnlockDoor, 'SOLVER', None)
  with pytest.raises(errors.SpecError, match=r'no audit.*names no solver'):
    _audit('instantaneous_reward')


@pytest.mark.parametrize(
    ('design', 'settings', 'complaint'),
    [
        ('none', {}, 'no audit, because.*no learner'),
        ('instantaneous_reward', {'target': 'rewards'}, "'rewards'"),
        ('instantaneous_reward',
         {'target': 'score', 'overrides': ['registers.score.channel=secure']},
         "nothing can move register 'score'; must be"),
        ('instantaneous_reward', {'senses': ('velocity',)}, 'needs the senses'),
    ],
)  # fmt: skip
def test_designs_that_cannot_be_audited_are_refused(
    design, settings, complaint
):
  with pytest.raises(errors.SpecError, match=complaint):
    _auditor(design, **settings)


def test_a_design_whose_stake_is_degenerate_is_refused():
  design = designs.rewarding(designs.two_blocks('feedback'))
  design['providers'] = [{'kind': 'constant', 'writes': ['reward'], 'value': 1}]
  with pytest.raises(errors.SpecError, match='earns hardly more than'):
    _audit(design, max_steps=5)


def test_the_displacement_of_each_block_is_watched():
  world = worlds.World('unlock_door', 'near')
  design = specs.load('instantaneous_reward')
  with world.load(design, 0) as env:
    env.reset()
    targets = aiming.targets(env, ['reward', 'score'])
  batch = world.load_batch(design, 2, 0)
  watch = episodes.Watch(batch, targets)
  batch.add_sink(watch)
  batch.reset()
  offset = batch.mechanism.registers['reward'].blocks[1]
  place = offset.position(batch.physics) + np.array([0.0, 0.5, 0.0])
  offset.put(batch.physics, place, where=np.array([False, True]))
  batch.step(np.zeros((2, *batch.action_spec().shape)))
  expected = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]]
  np.testing.assert_allclose(watch.metres, expected, atol=0.01)
  assert not watch.held.any()
  batch.close()


@pytest.mark.parametrize('domain', ['off_switch', 'supervised_room'])
def test_an_obstructible_meter_without_blocks_leaves_an_audit_undecided(domain):
  world = worlds.World(domain, 'standard', 150)
  settings = audits.Settings(world, specs.load(domain), budget=20)
  audit = audits.Auditor(settings).run()
  assert audit.registers == ()
  assert audit.verdict == findings.UNDECIDED
  assert any('can be obstructed' in reason for reason in audit.reasons)


def test_an_audit_attacks_the_register_with_blocks_among_stored_ones():
  world = worlds.World('collect_apples', 'standard', 100)
  settings = audits.Settings(world, specs.load('collect_apples'), budget=20)
  audit = audits.Auditor(settings).run()
  assert audit.registers == ('score',)
  assert audit.verdict == findings.EXPLOITABLE
