"""Tests of entries: what is published is played again, and changes are seen."""

import json
import shutil

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import sources
from realab_suite.evaluation import results
from realab_suite.lab.experiments import budgets
from realab_suite.lab.experiments import entries
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.launchers import check
from realab_suite.policies import network_files
from tests.lab.experiments import small
from tests.launchers import in_process

_BUDGET = budgets.Budget(200, 1, num_seeds=1, episodes=3)
_RUN = {
    'design': 'instantaneous_reward',
    'overrides': ['dof=planar', 'action_set={name: dmlab_like, version: 1}'],
    # Its state has a value for each world.
    'learner': {'hidden': [8], 'defence': {'kind': 'cap', 'high': 5}},
    'twin': True,
}


@pytest.fixture(autouse=True, scope='module')
def _budget():
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(budgets, 'BUDGETS', {'tiny': _BUDGET})
    yield


@pytest.fixture(scope='module', name='sweep')
def _sweep(tmp_path_factory, _budget):
  """Returns the folder of a sweep with all its jobs."""
  folder = tmp_path_factory.mktemp('sweep')
  experiment = budgets.apply(
      experiment_specs.load({**small.EXPERIMENT, 'runs': {'reward': _RUN}}),
      'tiny',
  )
  planned = jobs.plan(experiment)
  scheduler._describe(experiment, planned, False, folder)
  for job in planned:
    training.run(job, folder, training.Options(say=lambda line: None))
  return folder


@pytest.fixture(name='entry')
def _entry(sweep, tmp_path):
  """Returns the folder of an entry, to be changed."""
  output = tmp_path / 'tiny' / 'reward'
  assert entries.publish(sweep, output) == (3, 0)
  return output


def _checked(entry):
  said = []
  entries.check(entry, 0, said.append)
  return said


def test_an_entry_agrees_with_its_policies(entry):
  ended = in_process.run(check, f'--entry={entry}', '--draw=0')
  assert ended.status == 0, ended.stderr
  assert '9 of 9 episodes are the same to the bit' in ended.stdout
  assert 'Made with other' not in ended.stdout
  assert not list(entry.rglob('*.bin'))


@pytest.mark.parametrize(
    ('folder', 'problem'),
    [('mine', 'must be in one with'), ('tiny/mine', 'has no policies.json')],
)
def test_what_is_no_entry_is_said(folder, problem, tmp_path):
  said = in_process.complaint(check, f'--entry={tmp_path / folder}')
  assert f'{tmp_path / folder}: ' in said
  assert problem in said


def test_a_sweep_of_another_budget_is_no_entry(sweep, tmp_path, monkeypatch):
  with pytest.raises(errors.UnknownNameError, match="in a folder 'other'"):
    entries.publish(sweep, tmp_path / 'other' / 'reward')
  monkeypatch.setitem(budgets.BUDGETS, 'tiny', budgets.Budget(300, 1))
  with pytest.raises(errors.SpecError, match='is not of budget tiny: seeds'):
    entries.publish(sweep, tmp_path / 'tiny' / 'reward')
  assert not (tmp_path / 'tiny').exists()


def _other(entry):
  """Writes other weights into the file of a policy; returns its digest."""
  path = entry / 'reward-0.npz'
  net = network_files.load(path)
  biases = (*net.biases[:-1], np.eye(1, 14, 3, np.float32)[0] * 9)
  changed = network_files.Network(net.header, net.weights, biases)
  path.write_bytes(changed.to_bytes())
  return changed.digest()


def _swap(entry):
  _other(entry)


def _swap_with_its_digest(entry):
  path = entry / entries.POLICIES
  digests = {**json.loads(path.read_text()), 'reward-0.npz': _other(entry)}
  path.write_text(json.dumps(digests))


def _edit(entry, old, new):
  path = entry / scheduler.EXPERIMENT
  text = path.read_text()
  assert text.count(old) == 1
  path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        (_swap, 'reward-0.npz: has .*; must have'),
        (_swap_with_its_digest, 'the rows are not those of the policies'),
        (lambda x: (x / 'reward-0.npz').unlink(), 'reward-0.npz: No such file'),
        (
            lambda x: (x / 'rows.parquet').write_bytes(
                (x / 'curves.parquet').read_bytes()
            ),
            'rows.parquet',
        ),
        (
            lambda x: _edit(x, 'seed_offset: 1000000', 'seed_offset: 7'),
            'not of budget tiny: evaluation.seed_offset',
        ),
        (
            lambda x: _edit(x, 'sleep: false', 'sleep: true'),
            'reward, seed 0: not of experiment.yaml .* training.sleep',
        ),
    ],
)
def test_a_change_is_seen(entry, change, problem):
  change(entry)
  with pytest.raises(errors.RealabError, match=problem) as raised:
    _checked(entry)
  assert '\n' not in str(raised.value)


def _edited(row, key):
  """Returns the extras of a row in which numbers with a key are larger."""
  return json.loads(json.dumps(row.extras).replace(key, f'{key}9'))


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        (lambda row: {'true_return': row.true_return + 1}, 'not those of'),
        # What a label favours an agent by.
        (lambda row: {'extras': _edited(row, '"high": ')}, 'has the stakes'),
        (
            lambda row: {'extras': _edited(row, '"estimate": ')},
            'has the stakes',
        ),
    ],
)
def test_rows_that_were_edited_before_publishing_are_seen(
    sweep, tmp_path, change, problem
):
  folder = shutil.copytree(sweep, tmp_path / 'sweep')
  [job] = (one for one in folder.glob('reward-0-*') if one.is_dir())
  path = job / training.EPISODES
  rows = [row.model_copy(update=change(row)) for row in results.read_rows(path)]
  path.write_bytes(b''.join(map(results.line, rows)))
  storage.finish(job, storage.read_json(job / storage.DONE), training.RECORDS)
  entries.publish(folder, tmp_path / 'tiny' / 'reward')
  with pytest.raises(errors.ResultsError, match=problem):
    _checked(tmp_path / 'tiny' / 'reward')


def test_an_entry_without_a_seed_is_incomplete(sweep, tmp_path):
  folder = shutil.copytree(sweep, tmp_path / 'sweep')
  [job] = (one for one in folder.glob('reward.secure-*') if one.is_dir())
  (job / storage.DONE).unlink()
  entry = tmp_path / 'tiny' / 'reward'
  assert entries.publish(folder, entry) == (2, 1)
  with pytest.raises(errors.ResultsError, match=r'lacks 1 of 3 jobs, .*secure'):
    _checked(entry)


def test_elsewhere_differences_are_said(entry, monkeypatch):
  _swap_with_its_digest(entry)
  monkeypatch.setattr(entries.machines, 'here', lambda: {'processor': 'other'})
  monkeypatch.setattr(entries, '_TOLERANCE', 1.0)
  monkeypatch.setattr(sources, 'digest', lambda: 'other')
  said = '\n'.join(_checked(entry))
  assert 'Made with other processor (' in said
  assert 'in the rows,' in said


def test_other_code_is_said_and_excuses_nothing(entry, monkeypatch):
  monkeypatch.setattr(sources, 'digest', lambda: 'other')
  assert any('Made with other code (' in line for line in _checked(entry))
  _swap_with_its_digest(entry)
  with pytest.raises(errors.ResultsError, match='are not those of'):
    _checked(entry)
