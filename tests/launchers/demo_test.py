"""Tests of the demonstration: from nothing to the report, and continued."""

import dataclasses
import os
import pathlib
import re
import subprocess
import sys

from imageio import v3 as imageio
import pytest
import yaml

from realab_suite import sources
from realab_suite.lab.experiments import engines
from realab_suite.lab.experiments import scheduler
from realab_suite.launchers import demo
from realab_suite.reports import demonstrations
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
  monkeypatch.delenv('UV', raising=False)
  assert demo._command('audit') == 'realab audit'
  # `uvx` adds the folder for this process alone.
  monkeypatch.setenv('UV', '/usr/bin/uv')
  assert demo._command('audit') == f'{path / "realab"} audit'.lstrip('/')


def test_a_demonstration_without_learners_is_refused_at_once(
    tmp_path, monkeypatch
):
  monkeypatch.setattr(demo, '_NEEDED', {'agents': ('no_such_module',)})
  refused = in_process.complaint(demo)
  assert 'no_such_module not installed; run: ' in refused
  assert " -e '.[agents]' " in refused
  # A wheel is not beside a setup.cfg.
  monkeypatch.setattr(sources, 'FOLDER', tmp_path / 'realab_suite')
  refused = in_process.complaint(demo)
  assert refused.endswith(" python -m pip install 'realab-suite[agents]'")


_EXTRAS = ('jax', 'equinox', 'optax', 'imageio', 'av', 'matplotlib', 'jinja2')
_SAID = re.compile(
    r'In 20 of 20 episodes the agent moved the base block of reward and was'
    r' paid [\d,]+ to [\d,]+; honest work earns 18\. .* and its twin 1\d\.\d\.'
    r' Both were .*\.'
)


@pytest.mark.slow
@pytest.mark.parametrize('problem', ['imageio, av not installed', 'MUJOCO_GL'])
def test_trained_agents_are_shown_without_learners_and_films(problem, tmp_path):
  absent = _EXTRAS if 'imageio' in problem else _EXTRAS[:3]
  source = (
      f'import sys; sys.modules.update(dict.fromkeys({absent}));'
      " sys.argv = ['realab', 'demo', '--trained'];"
      ' from realab_suite.launchers import command; command.main()'
  )
  root = str(pathlib.Path(__file__).parents[2])
  ended = subprocess.run(
      [sys.executable, '-c', source],
      env={**os.environ, 'PYTHONPATH': root, 'MUJOCO_GL': 'disable'},
      cwd=tmp_path,
      capture_output=True,
      text=True,
      check=False,
  )
  assert (ended.returncode, ended.stderr) == (0, '')
  said, _, why = ended.stdout.partition('\n\nThere is no film: ')
  assert _SAID.fullmatch(said.replace('\n', ' ')), said
  assert why.startswith(problem)
  assert max(map(len, ended.stdout.splitlines())) <= 80
  assert not list(tmp_path.iterdir())


def test_an_interrupted_film_leaves_no_file(tmp_path, monkeypatch):
  monkeypatch.setattr(demo.renderers, 'why_no_film', lambda: None)
  monkeypatch.setattr(demonstrations, '_EPISODES', 2)
  begun = []

  def shoot(unused_played, path):
    path.write_bytes(b'half a film')
    begun.append(path)
    raise KeyboardInterrupt

  monkeypatch.setattr(demonstrations, 'film_trained', shoot)
  output = f'--output={tmp_path / "results" / "out"}'
  assert in_process.run(demo, '--trained', output).status == 130
  assert begun
  assert not list(tmp_path.iterdir())


def test_a_flag_without_an_effect_on_trained_agents_is_refused():
  refused = in_process.complaint(demo, '--trained', '--accept_other_code')
  assert 'must not be given with --trained' in refused


@pytest.mark.camera
@pytest.mark.slow
def test_trained_agents_are_filmed(tmp_path, monkeypatch):
  world, _ = demonstrations._world_of('twin')
  short = dataclasses.replace(world, max_steps=8)
  world_of = demonstrations._world_of
  monkeypatch.setattr(
      demonstrations, '_world_of', lambda name: (short, world_of(name)[1])
  )
  folder = tmp_path / 'out'
  ended = in_process.run(demo, '--trained', f'--output={folder}')
  assert (ended.status, ended.stderr) == (0, '')
  *_, shown = ended.stdout.split('\n\n')
  shown = shown.replace('\n', ' ')
  assert shown.startswith(f'The film {folder / "film.mp4"} shows an episode')
  assert [path.name for path in folder.iterdir()] == ['film.mp4']
  frames = imageio.imread(folder / 'film.mp4', plugin='pyav')
  assert frames.shape == (9, 450, 644, 3)
  refused = in_process.complaint(demo, '--trained', f'--output={folder}')
  assert 'is not empty' in refused
