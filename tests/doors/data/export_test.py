"""Tests of exports: files, secrecy, and errors that leave nothing behind."""

import os
import stat

import numpy as np
import pytest

pytest.importorskip('pyarrow')

from pyarrow import parquet

from realab_suite import errors
from realab_suite.doors.data import cards
from realab_suite.doors.data import columns
from realab_suite.doors.data import export
from realab_suite.lab.experiments import requirements
from realab_suite.tasks import unlock_door
from tests.doors.data import made

_EVALUATOR = [f'evaluator/{name}.parquet' for name in columns.EVALUATOR]


def _earn(task, physics):
  """Gives a true reward that no agent can guess, at the ends of steps."""
  step = np.asarray(physics.data.time) * 10
  is_end = np.abs(step - np.round(step)) < 0.01
  task.earn(physics, is_end * (0.25 + 0.0625 * np.sin(1.7 * np.round(step))))


@pytest.fixture(name='saboteur', scope='module')
def fixture_saboteur():
  """Episodes of a saboteur whose true reward differs in every step."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(unlock_door.UnlockDoor, 'latch_events', _earn)
    yield made.source()


@pytest.fixture(name='folder', scope='module')
def fixture_folder(saboteur, tmp_path_factory):
  path = tmp_path_factory.mktemp('labelled') / 'dataset'
  return export.labelled([saboteur], path)


def _read(folder, name):
  return parquet.read_table(folder / 'instantaneous_reward' / name)


def test_a_labelled_dataset_has_all_files_and_a_card(folder):
  files = [
      p.relative_to(folder).as_posix() for p in folder.rglob('*') if p.is_file()
  ]
  inside = ['agent/steps.parquet', 'manifest.json', *_EVALUATOR]
  assert sorted(files) == sorted(
      [cards.NAME, *(f'instantaneous_reward/{name}' for name in inside)]
  )
  card = (folder / cards.NAME).read_text()
  assert '| carrying_saboteur (embedded) | carrying_saboteur |' in card
  for table in columns.EVALUATOR.values():
    assert cards.table_of(table) in card


def test_other_users_can_read_the_data_of_the_agent_only(folder):
  group = folder / 'instantaneous_reward'
  modes = {
      path: stat.S_IMODE(path.stat().st_mode)
      for path in (
          group / 'evaluator',
          group / 'manifest.json',
          folder / cards.NAME,
      )
  }
  assert not [path for path, mode in modes.items() if mode & 0o077]
  umask = os.umask(0)
  os.umask(umask)
  readable = 0o444 & ~umask
  agent = (group / 'agent/steps.parquet').stat().st_mode
  assert stat.S_IMODE(agent) & 0o444 == readable


def test_rows_of_the_agent_and_of_the_evaluator_fit_together(folder):
  agent = _read(folder, 'agent/steps.parquet').to_pylist()
  steps = _read(folder, 'evaluator/steps.parquet').to_pylist()
  [episode] = _read(folder, 'evaluator/episodes.parquet').to_pylist()
  registers = _read(folder, 'evaluator/registers.parquet').to_pylist()
  keys = [(row['episode_id'], row['step']) for row in agent]
  assert keys == [(0, step) for step in range(episode['num_steps'] + 1)]
  assert keys == [(row['episode_id'], row['step']) for row in steps]
  observed = sum(row['observed_reward'] for row in agent[1:])
  assert observed == pytest.approx(episode['observed_return'])
  rewards = [row['true_reward'] for row in steps[1:]]
  assert sum(rewards) == pytest.approx(episode['true_return'])
  for name in ('objective', 'clean_objective'):
    terms = [row[name] for row in steps[1:]]
    assert sum(terms) == pytest.approx(episode[name])
  gain = episode['objective'] - episode['clean_objective']
  assert gain / episode['stake'] == pytest.approx(episode['relative_gain'])
  labels = [row['is_tampering'] for row in steps[1:]]
  assert 0 < sum(labels) == episode['num_tampering_steps'] < len(labels)
  assert steps[0]['is_tampering'] is None
  reward = [row for row in registers if row['register'] == 'reward']
  for row, seen in zip(reward, agent, strict=True):
    assert row['observed'] == row['reading'] == seen['registers/reward']
    parts = row['permanent'] + row['temporary'] + row['obstruction']
    assert row['own'] == pytest.approx(parts)
    assert row['own'] == row['reading'] - row['applied']
    assert row['own'] + row['inherited'] == pytest.approx(row['corruption'])
    if row['step']:
      assert row['agent'] + row['world'] == pytest.approx(row['own'])


def _numbers(row):
  """Yields every number in a row, with its column."""
  for name, value in row.items():
    for number in value if isinstance(value, list) else [value]:
      if number is not None:
        yield name, float(number)


def test_the_agents_file_does_not_contain_the_truth(folder):
  agent = _read(folder, 'agent/steps.parquet')
  truth = {
      name for table in columns.EVALUATOR.values() for name in table.names
  } - {'episode_id', 'step'}
  assert not truth & set(agent.schema.names)
  steps = _read(folder, 'evaluator/steps.parquet').to_pylist()
  found_before = False
  checked = 0
  rows = agent.to_pylist()
  for row, before, true in zip(rows[2:], steps[1:-1], steps[2:], strict=True):
    # A meter measures before the reward of its step is earned.
    secrets = [
        one[name]
        for one in (before, true)
        for name in ('true_reward', 'true_return')
    ]
    leaks = {
        name
        for name, number in _numbers(row)
        if any(abs(number - secret) < 1e-6 for secret in secrets)
    }
    if abs(true['corruption']) < 1e-9:
      # An honest register shows the reward, so the search can find it.
      found_before |= 'registers/reward' in leaks
    elif abs(true['corruption']) > 1e-3:
      checked += 1
      assert not leaks, true['step']
  assert found_before
  assert checked > 10


def test_the_agents_file_does_not_name_its_origin(folder, saboteur):
  data = (folder / 'instantaneous_reward/agent/steps.parquet').read_bytes()
  metadata = parquet.read_metadata(
      folder / 'instantaneous_reward/agent/steps.parquet'
  ).metadata
  assert set(metadata or {}) <= {b'ARROW:schema'}
  words = ('saboteur', 'embedded', 'secure', 'true_', 'tamper', 'corrupt')
  for word in (*words, saboteur[0].row.info.design_digest):
    assert word.encode() not in data


def _without_learner(source):
  """Returns a source with other actions: a learner selects discrete ones."""
  design = source[0].design.model_copy(update={'learner': None})
  return [one._replace(design=design) for one in source]


@pytest.fixture(name='still', scope='module')
def fixture_still():
  return made.source('no_op', max_steps=3)


def test_sources_with_other_actions_get_a_group_of_their_own(still):
  discrete = _without_learner(still)
  groups = export.grouped([still, discrete, still])
  assert [(name, len(of)) for name, of in groups] == [
      ('instantaneous_reward', 2), ('instantaneous_reward_2', 1),
  ]  # fmt: skip


def test_a_replay_that_differs_leaves_no_folder(tmp_path, still):
  [recorded] = still
  row = recorded.row.model_copy(update={'observed_return': 77.0})
  wrong = [recorded._replace(row=row)]
  with pytest.raises(errors.ResultsError, match='differs from the results'):
    export.export(wrong, tmp_path / 'new')
  assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(tmp_path, monkeypatch):
  monkeypatch.setattr(
      requirements, 'missing', lambda *names, extra: f'{names[0]} ({extra})'
  )
  with pytest.raises(errors.ResultsError, match=r'pyarrow \(data\)'):
    export.check('parquet', tmp_path / 'new')
