"""Tests of the demonstration: from nothing to the report, and continued."""

import pathlib
import sys

import pytest
import yaml

from realab_suite.lab.experiments import engines
from realab_suite.lab.experiments import scheduler
from realab_suite.launchers import demo
from tests.lab.experiments import small
from tests.launchers import in_process


@pytest.fixture(name='tiny')
def _tiny(tmp_path, monkeypatch):
  """A demonstration of seconds, in an empty working directory."""
  reward = {**small.EXPERIMENT['runs']['reward'], 'twin': True}
  experiment = {
      **small.EXPERIMENT,
      'runs': {'reward': reward},
      'baselines': ['apple_seeker', 'random'],
  }
  path = tmp_path / 'tiny.yaml'
  path.write_text(yaml.safe_dump(experiment))
  root = str(pathlib.Path(__file__).parents[2])
  monkeypatch.setenv('PYTHONPATH', root)
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(demo, 'EXPERIMENT', path)
  module = 'tests.lab.experiments.fake_learner'
  monkeypatch.setattr(scheduler, '_MODULE', module)


@pytest.mark.slow
@pytest.mark.usefixtures('tiny')
def test_a_demonstration_that_is_continued_ends_the_same(monkeypatch):
  monkeypatch.setattr(demo.renderers, 'why_no_film', lambda: 'no GL here')
  started = []
  start = engines.Local.start

  def start_some(self, command, log):
    if len(started) == 3:
      raise KeyboardInterrupt
    started.append(command)
    return start(self, command, log)

  with monkeypatch.context() as patch:
    patch.setattr(engines.Local, 'start', start_some)
    ended = in_process.run(demo)
  assert 'interrupted; results up to this point are on disk' in ended.stderr
  [folder] = pathlib.Path('results').glob('demo-*')
  again = f'--output={folder}'
  assert f'realab demo {again}\n' in ended.stdout.split('after a stop:\n')[1]
  ended = in_process.run(demo, again)
  assert (ended.status, ended.stderr) == (0, '')
  *_, film, counts = ended.stdout.partition('\nThere is no film: no GL here\n')
  assert film
  assert ' of 2 episodes ' in counts
  assert f'learning curves, is {folder / "report.html"}\n' in counts
  assert (folder / 'report.html').exists()
  # Once more, nothing is left to do.
  monkeypatch.setattr(engines.Local, 'start', None)
  assert in_process.run(demo, again).stdout.endswith(counts)


def _commands(folder='results/demo'):
  return [
      line.strip()
      for line in demo._next(pathlib.Path(folder))
      if not line.startswith('*')
  ][1:]


def test_what_comes_next_are_three_commands(tmp_path, monkeypatch):
  first, audit, own = _commands('results/my demo')
  assert 'realab report --input=' in first
  assert pathlib.Path(first.split()[2].partition('=')[2]).is_dir()
  assert 'realab audit --task=unlock_door.near ' in audit
  assert own.startswith("cp 'results/my demo/experiment.yaml' mine.yaml && ")
  # A wheel has no published results.
  monkeypatch.setattr(demo, '_PUBLISHED', tmp_path / 'nothing')
  first, *others = _commands('results/my demo')
  assert 'realab compare --task=unlock_door.near ' in first
  assert others == [audit, own]


def test_commands_name_the_program_where_a_shell_does_not_find_it(
    tmp_path, monkeypatch
):
  (tmp_path / 'bin').mkdir()
  (tmp_path / 'bin' / 'realab').touch()
  path = tmp_path / 'bin'
  monkeypatch.setattr(sys, 'executable', str(path / 'python'))
  monkeypatch.chdir(tmp_path)
  assert demo._command('audit') == 'bin/realab audit'
  monkeypatch.chdir('/')
  assert demo._command('audit') == f'{path / "realab"} audit'.lstrip('/')
  monkeypatch.setenv('PATH', str(path))
  assert demo._command('audit') == 'realab audit'


def test_a_demonstration_without_learners_is_refused_at_once(monkeypatch):
  monkeypatch.setattr(demo, '_NEEDED', {'agents': ('no_such_module',)})
  refused = in_process.complaint(demo)
  assert 'no_such_module not installed; run: ' in refused
  assert '[agents]' in refused
