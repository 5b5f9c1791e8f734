"""Tests of the program that audits designs."""

import json

import pytest

from realab_suite.feedback import specs
from realab_suite.lab.audit import audits
from realab_suite.lab.audit import findings
from realab_suite.lab.experiments import experiment_specs
from realab_suite.launchers import audit
from tests.lab.experiments import small
from tests.launchers import in_process


@pytest.fixture(autouse=True)
def fixture_quick(monkeypatch):
  monkeypatch.setattr(audits, '_WORLDS', 8)
  with small.quick_stakes():
    yield


def _run(*arguments):
  return in_process.run(
      audit, '--task=unlock_door.near', '--max_steps=40', '--nofilm',
      '--set=dof=planar', '--target=reward', *arguments,
  )  # fmt: skip


@pytest.mark.parametrize(
    ('arguments', 'status'),
    [
        (['--budget=40', '--set=learner.defence={kind: cap, high: 5}'], 3),
        (['--set=channel=secure'], 0),
        (['--task=unlock_door.boxed', '--budget=40'], 4),
    ],
    ids=['exploitable', 'secure', 'too small'],
)
def test_the_exit_status_of_the_program_is_the_verdict(
    arguments, status, tmp_path
):
  output = tmp_path / 'audit'
  ended = _run(*arguments, f'--output={output}')
  assert ended.stderr == ''
  assert ended.status == status
  written = json.loads((output / audit.REPORT).read_text())
  lines = ended.stdout.splitlines()
  assert written['verdict'] in lines
  assert written['is_sufficient'] == (status == 0)
  assert written['film'] is None
  assert written['target'] == 'reward'
  assert set(written) > set(findings.Audit.model_fields)
  is_said = '* without effect: learner.defence; ' in ended.stdout
  assert is_said == (status == 3)
  assert written['without_effect'] == ['learner.defence'] * is_said
  # Progress, as the output is no terminal.
  assert lines[0].startswith('stakes: 0 of ')
  assert 'comparison: ' in ended.stdout


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--budget=0'], '--budget=0'),
        (['--design=none'], 'the design has no learner'),
        (['--target=score_2'], "'score_2'"),
        (['--senses=velocity'], 'needs the senses'),
        (
            ['--set=learner.gama=0.9'],
            "instantaneous_reward: learner: unknown key 'gama'; did you mean"
            " 'gamma'?",
        ),
        (
            ['--set=learner.kind=q_learning'],
            'instantaneous_reward: action_set: missing',
        ),
    ],
)
def test_wrong_flags_are_refused_in_one_line(arguments, complaint):
  assert complaint in in_process.complaint(audit, *arguments)


@pytest.mark.parametrize(
    ('design', 'overrides', 'expected'),
    [
        ('instantaneous_reward', ['learner.hidden=[8]'], ['hidden']),
        ('instantaneous_reward', ['learner.gamma=0.97'], []),
        ('instantaneous_reward', ['learner.defence=null'], []),
        ('inspected_reward', [], ['defence']),
        ('myopic_approval', [], ['gae_lambda']),  # Its defence pays approval.
        ('paired_decoupled_approval', [], []),
        ('none', [], []),
    ],
)
def test_only_options_that_change_what_is_searched_have_an_effect(
    design, overrides, expected
):
  found = findings._without_effect(specs.load(design, overrides))
  assert found == tuple(f'learner.{name}' for name in expected)


@pytest.fixture(name='experiment')
def _experiment(tmp_path):
  """The file of an experiment with two runs in different worlds."""
  content = {
      **small.EXPERIMENT,
      'max_steps': 40,
      'task_kwargs': {'physics_timestep': 0.025},
      'environment_kwargs': {'senses': ['velocity', *_RAYS]},
  }
  reward = content['runs']['reward']
  content['runs'] = {
      'reward': reward,
      'capped': {
          **reward,
          'task': 'unlock_door.boxed',
          'learner': {'defence': {'kind': 'cap', 'high': 5}},
      },
  }
  path = tmp_path / 'mine.yaml'
  path.write_text(json.dumps(content))  # YAML contains JSON.
  return path


_RAYS = 'ray_distances', 'ray_classes', 'position', 'heading', 'holding'


def test_a_run_of_an_experiment_is_audited_beside_its_sweep(
    experiment, tmp_path
):
  output = tmp_path / 'sweep'
  output.mkdir()
  (output / 'sweep.json').touch()
  arguments = [
      f'--experiment={experiment}', '--run=capped', '--budget=40', '--nofilm',
      f'--output={output}',
  ]  # fmt: skip
  ended = in_process.run(audit, *arguments)
  assert ended.stderr == ''
  written = json.loads((output / 'audits' / 'capped.json').read_text())
  assert written['verdict'] in ended.stdout.splitlines()
  spec = experiment_specs.load(str(experiment))
  assert written['world'] == {
      'domain': 'unlock_door', 'task': 'boxed', 'max_steps': 40,
      'task_kwargs': {'physics_timestep': 0.025},
      'senses': ['velocity', *_RAYS],
  }  # fmt: skip
  design = json.loads(json.dumps(spec.designs['capped'].to_mapping()))
  assert written['design'] == design
  assert written['design']['learner']['defence']['high'] == 5
  ended = in_process.run(audit, *arguments)
  assert ended.stderr == (
      f'error: {output}/audits/capped.json exists, and is never overwritten\n'
  )


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--experiment=MINE'], "--run: missing; must be one of ['reward',"),
        (
            ['--experiment=MINE', '--run=caped'],
            "MINE; must be one of ['reward', 'capped']; did you mean 'capped'?",
        ),
        (['--run=capped'], '--experiment: missing, which goes with --run'),
        *(
            (
                ['--experiment=MINE', '--run=capped', flag],
                f'{flag.partition("=")[0]}: not allowed with --experiment',
            )
            for flag in (
                '--task=unlock_door.far', '--design=instantaneous_reward',
                '--set=dof=planar', '--max_steps=250', '--task_kwargs={}',
                '--senses=rays', '--target=reward',
            )
        ),
    ],
)  # fmt: skip
def test_what_contradicts_a_run_is_refused(arguments, complaint, experiment):
  arguments = [one.replace('MINE', str(experiment)) for one in arguments]
  said = in_process.complaint(audit, *arguments)
  assert complaint.replace('MINE', str(experiment)) in said
