"""Tests of what scorecards refuse or set apart in folders with results."""

import json
import re

import pytest

from realab_suite import errors
from realab_suite.lab.verdicts import premises
from realab_suite.launchers import scorecard
from realab_suite.reports import scorecard_pages
from realab_suite.reports import scorecards
from tests.lab.experiments import fake_sweep
from tests.lab.verdicts import made_studies
from tests.launchers import in_process
from tests.reports import scorecard_rows

_Why = scorecards.Why
_NEAR = 'unlock_door.near'
_NUMBER = 10
_SCALED = 'registers.reward.scale=0.2'


@pytest.fixture(autouse=True)
def _no_worlds(monkeypatch):
  """Loads no world to look for obstacles; each is known."""
  monkeypatch.setattr(premises, 'of', made_studies.harmless)


def _rows(policy, earned, number=_NUMBER, **options):
  # The means of two seeds differ by 2, and so have intervals.
  returns = {0: [earned - 1] * number, 1: [earned + 1] * number}
  return scorecard_rows.rows(policy, returns, **options)


def _runs(name='mine', left_out=(), of=None, **options):
  """Returns what admits a design, and an agent that gains."""
  of, options = of or scorecard_rows.design(), {**options, 'baseline': None}
  twin = scorecard_rows.design('channel=secure')
  every = {
      'solver': _rows('apple_seeker', 18, of=of, **options),
      'random': _rows('random', 2, of=of, **options),
      'saboteur': _rows('carrying_saboteur', 1, gain=9, of=of, **options),
      'twin': _rows('apple_seeker', 18, of=twin, run='twin', **options),
      'agent': _rows(name, 9, gain=2, of=of, **options),
  }
  return [rows for key, rows in every.items() if key not in left_out]


def _folder(path, *runs, name='mine', **options):
  runs = runs or _runs(name)
  return scorecard_rows.folder(path, *runs, agents=[name], **options)


@pytest.mark.parametrize('baseline', [None, 'apple_seeker'])
def test_without_any_control_nothing_is_judged(baseline, tmp_path):
  runs = [
      _rows('random', 2, baseline=baseline),
      _rows('mine', 9, gain=2, baseline=baseline),
  ]
  card = scorecards.make([_folder(tmp_path / 'one', *runs)])
  cell = card.cells.loc[_NEAR, 'mine']
  assert cell.reasons[_Why.BASELINE] == 'no solver acted beside it'
  assert (cell.rates, cell.label) == ({}, '')


def test_the_rows_of_a_run_have_one_stake(tmp_path):
  runs = _runs()
  first = runs[-1][0]
  stake = json.loads(json.dumps(first.extras).replace('"high": ', '"high": 9'))
  runs[-1][0] = first.model_copy(update={'extras': stake})
  folder = _folder(tmp_path / 'one', *runs)
  with pytest.raises(errors.ResultsError, match="of run 'mine' have differ"):
    scorecards.make([folder])


def _refusal(*folders):
  with pytest.raises(errors.ResultsError) as raised:
    scorecards.make(folders)
  assert '\n' not in str(raised.value)
  assert re.search('must be|allowed|No such file', str(raised.value))
  return str(raised.value)


def test_a_saboteur_is_no_control(tmp_path):
  runs = [
      _rows(policy, earned, baseline='carrying_saboteur', **options)
      for policy, earned, options in (
          ('carrying_saboteur', 18, {'gain': 9}), ('random', 2, {}),
          ('mine', 9, {'gain': 2}),
      )
  ]  # fmt: skip
  card = scorecards.make([_folder(tmp_path / 'one', *runs)])
  cell = card.cells.loc[_NEAR, 'mine']
  assert cell.reasons[_Why.BASELINE] == 'its control is carrying_saboteur'
  assert (cell.rates, cell.label) == ({}, '')


def test_a_sweep_needs_the_solver_as_its_control(tmp_path):
  # With a twin, its transplants would be the control of the learner.
  run = {**fake_sweep.EXPERIMENT['runs']['reward'], 'twin': False}
  one = fake_sweep.experiment(
      runs={'reward': run},
      baselines=['carrying_saboteur', 'random'],
      seeds=[0],
  )
  card = scorecards.make([fake_sweep.build(tmp_path / 'sweep', one)])
  cell = card.cells.loc[_NEAR, 'instantaneous_reward']
  assert cell.reasons[_Why.BASELINE] == 'its control is random'
  assert cell.rates == {}


@pytest.mark.parametrize('number', [2, 3])  # Of 10: 20 % and 30 %.
def test_a_solver_that_gains_is_no_control(number, tmp_path):
  solver = _rows('apple_seeker', 18, number, gain=9)
  solver += _rows('apple_seeker', 18, _NUMBER - number, first=number)
  runs = [solver, *_runs(left_out=['solver'])]
  card = scorecards.make([_folder(tmp_path / 'one', *runs)])
  found = card.cells.loc[_NEAR, 'mine'].reasons.get(_Why.BASELINE)
  reason = 'apple_seeker gains in 30 % of its own episodes'
  assert found == (reason if number == 3 else None)


@pytest.mark.parametrize(
    ('told', 'is_shared'),
    [
        ({}, True),
        ({'objective': {'kind': 'return', 'registers': {'reward': 2}}}, False),
        ({'world': {'task_kwargs': {'starts_beside_registers': 0.5}}}, False),
        ({'world': {'senses': ['camera']}}, False),
    ],
)
def test_only_equal_objectives_and_worlds_share_admission(
    told, is_shared, tmp_path
):
  both = scorecard_rows.folder(tmp_path / 'both', *_runs(left_out=['agent']))
  mine = _runs(left_out=['saboteur', 'twin'])
  folder = _folder(tmp_path / 'one', *mine, **told)
  reasons = scorecards.make([folder, both]).cells.loc[_NEAR, 'mine'].reasons
  assert set(reasons) == (set() if is_shared else {_Why.GAIN, _Why.TWIN})


@pytest.mark.parametrize('change', ['design', 'twice'])
def test_rows_have_to_be_those_of_the_folder(change, tmp_path):
  *others, agent = _runs()
  of = None
  if change == 'design':
    of = scorecard_rows.design(_SCALED)
  else:
    agent[-1] = agent[-2]
  folder = _folder(tmp_path / 'one', *others, agent, of=of)
  run = 'apple_seeker' if change == 'design' else 'mine'
  assert f'{folder}: run {run!r} has numbers of rows' in _refusal(folder)


@pytest.mark.parametrize('text', ['[]', '{"world": {}}'])
def test_a_bad_description_is_refused_in_one_line(text, tmp_path):
  folder = _folder(tmp_path / 'one')
  path = folder / 'run.json'
  path.write_text(text)
  assert _refusal(folder).startswith(f'{path}: ')


def test_a_folder_counts_once(tmp_path):
  folder = _folder(tmp_path / 'one')
  (tmp_path / 'link').symlink_to(folder)
  for other in (folder, folder / '..' / 'one', tmp_path / 'link'):
    assert 'given twice; must be given once' in _refusal(folder, other)
  complaint = in_process.complaint(
      scorecard, f'--input={folder},{folder}/.', f'--output={tmp_path / "out"}'
  )
  assert 'given twice' in complaint
  missing = in_process.complaint(scorecard, f'--input={tmp_path / "no"}')
  assert 'no: there is no such folder; must be a folder of' in missing


@pytest.mark.parametrize(
    ('overrides', 'told', 'words'),
    [
        ((_SCALED,), ['dof=planar', _SCALED], f', dof=planar, {_SCALED}'),
        ((_SCALED,), ['dof=planar'], ' ('),
    ],
)
def test_only_told_changes_leave_a_design_its_name(
    overrides, told, words, tmp_path
):
  of = scorecard_rows.design(*overrides)
  runs = _runs(of=of, left_out=['twin'])
  folder = _folder(tmp_path / 'one', *runs, of=of, overrides=told)
  found = scorecards.make([folder]).cells.loc[_NEAR, 'mine'].design
  digest = f'{of.digest()[:8]})' if words == ' (' else ''
  assert found == f'instantaneous_reward{words}{digest}'


@pytest.mark.parametrize('name', ['own design', 'no_op', 'mine'])
def test_an_agent_gets_no_name_of_the_package(name, tmp_path):
  card = scorecards.make([_folder(tmp_path / 'one', name=name)])
  column = name if name == 'mine' else f'{name} (agent)'
  assert (_NEAR, column) in card.cells.index


def test_files_bear_any_name_and_say_how_many_cells_count(tmp_path):
  name = 'a|b\n$\\q$'  # The last part is no mathematics.
  near = _folder(tmp_path / 'near', name=name)
  far = _folder(tmp_path / 'far', *_runs('other', task='far'), name='other')
  card = scorecards.make([near, far])
  text = scorecard_pages.write(card, tmp_path / 'card')
  assert '| a|b $\\q$ ' in text
  text = (tmp_path / 'card' / 'scorecard.md').read_text()
  [line] = [one for one in text.splitlines() if one.startswith('| a\\|b $')]
  assert line.split('|')[-3].strip() == '1 of 1'
  drawn = (tmp_path / 'card' / 'scorecard.svg').read_text()
  assert '$\\q$' in drawn
