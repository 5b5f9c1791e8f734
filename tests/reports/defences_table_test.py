"""Tests of the table of defences, on a made-up sweep."""

import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from docs.results import defences_table
from realab_suite.lab.experiments import studies
from realab_suite.lab.verdicts import study
from tests.lab.experiments import fake_sweep

_PLAIN = {'design': 'instantaneous_reward', 'overrides': ['dof=planar']}
_GATED = {
    'kind': 'q_learning',
    'gate': {'threshold': 1.0, 'fit_steps': 1000},
}
_ELSEWHERE = ['registers.reward.place=station_3']


def _run(kind=None, more=(), **options):
  run = {**_PLAIN, 'overrides': [*_PLAIN['overrides'], *more], 'twin': True}
  if kind:
    run['learner'] = {'defence': {'kind': kind, **options}}
  return run


@pytest.fixture(scope='module')
def found(tmp_path_factory):
  # Names say nothing: neither of defences nor of worlds.
  runs = {
      'a': _run(),
      'b': {**_run('cap', high=3.0), 'steps': 6_000},
      'c': _run('orpo', trusted={'policy': 'random'}, gradients=5),
      'd': _run(more=_ELSEWHERE),
      'e': _run('cap', total=4.0, more=_ELSEWHERE),
      'f': {**_run('cap', total=9.0), 'task': 'unlock_door.standard'},
      'g': {'design': 'inspected_reward', 'overrides': ['dof=planar']},
      'h': {**_run(more=_ELSEWHERE), 'learner': _GATED},
  }
  one = fake_sweep.experiment(
      runs=runs, seeds=[0], baselines=[],
      evaluation={'episodes': 3},
      training={'num_envs': 8, 'steps': 4_000, 'curve_every': 1_000},
  )  # fmt: skip
  folder = tmp_path_factory.mktemp('defences') / 'results'
  with pytest.MonkeyPatch.context() as patch:
    metrics = {
        'changed': 0.25, 'num_updates': 40.0,
        # Of 3,000 steps since it opened.
        'gate_is_open': 1.0, 'gate_unexpected': 600.0,
    }  # fmt: skip
    patch.setattr(fake_sweep, 'METRICS', metrics)
    fake_sweep.build(folder, one)
  return defences_table.entries(folder)


def _cells(found, column):
  header, *rows = defences_table.lines(found)
  return {
      row[header.index('run')].strip('`'): row[header.index(column)]
      for row in rows
  }


def test_runs_are_compared_in_their_own_world(found):
  near = 'unlock_door.near'
  assert _cells(found, 'world') == {
      'a': f'{near}, as a', 'b': f'{near}, as a', 'c': f'{near}, as a',
      'd': f'{near}, as d', 'e': f'{near}, as d', 'f': 'unlock_door.standard',
      'g': f'{near}, as a', 'h': f'{near}, as d',
  }  # fmt: skip
  beside = {one.own.run.name: one.plain for one in found}
  names = {name: one and one.run.name for name, one in beside.items()}
  assert names == dict(
      a=None, b='a', c='a', d=None, e='d', f=None, g='a', h='d'
  )


def test_what_a_defence_costs_is_relative_to_reward_learning(found):
  twins = {one.own.run.name: one.twin for one in found}
  earned = {
      name: sum(row.true_return for row in twin.run.rows)
      for name, twin in twins.items()
      if twin
  }
  tax = _cells(found, 'tax (%)')
  taken = 100 * (1 - earned['e'] / earned['d'])
  assert tax['e'].estimate == pytest.approx(taken)
  assert [tax[name] for name in 'adfg'] == [None] * 4
  # 6 points of the curve instead of 4.
  times = dict(a=None, b=1.5, c=1.0, d=None, e=1.0, f=None, g=1.0, h=1.0)
  assert _cells(found, 'training time') == times
  steps = _cells(found, 'own gradient steps')
  assert {name: n for name, n in steps.items() if n} == {'c': 5 * 40.0}
  looks = _cells(found, 'inspections')
  assert {name: n for name, n in looks.items() if n} == {'g': 249.0}


def test_an_agent_that_silences_an_alarm_is_not_cleared(found, tmp_path):
  # All registers of the made-up agents are corrupted, by more than a metre.
  silenced = _cells(found, 'alarm corrupted (%)')
  assert {name: n for name, n in silenced.items() if n is not None} == dict(
      g=100
  )
  # This one gains nothing, but corrupts by 3 cm where its control does by 1.
  runs = {'decoupled': {'design': 'inspected_reward', 'twin': True}}
  folder = fake_sweep.build(
      tmp_path / 'results',
      fake_sweep.experiment(runs=runs, seeds=[0], baselines=[]),
  )
  judged = study.judge(studies.read_sweep(folder))
  assert judged.loc['decoupled', study.ALL]['hacked'] == 0
  reason = judged.loc['decoupled', '0']['reason']
  assert reason.startswith("it corrupts 'alarm', which is not consumed, in 40 ")


def test_only_changes_of_suspicious_steps_are_false_alarms(found):
  alarms = _cells(found, 'false alarms (%)')
  assert {name: n for name, n in alarms.items() if n is not None} == dict(
      b=25, e=25, f=25, h=20
  )


def test_the_best_and_the_worst_world_of_a_defence_are_named(found):
  _, *rows = defences_table.worlds(found)
  # Of reward learning, and of caps that differ in their totals alone.
  assert [row[0] for row in rows] == ['`a`', '`e`']
  canvas = defences_table.draw(found)
  titles = [axes.get_title(loc='left') for axes in canvas.axes[::2]]
  near = 'unlock_door.near'
  worlds = [f'{near}, as a', f'{near}, as d', 'unlock_door.standard']
  assert titles == worlds
  assert [len(axes.get_yticks()) for axes in canvas.axes[::2]] == [4, 3, 1]
