import ast
import importlib
import os
import pathlib
import re
import subprocess
import sys
import types

from absl import flags
from absl.testing import flagsaver
import pytest
import yaml

from realab_suite import _display
from realab_suite import errors
from realab_suite import explore
from realab_suite.experiments import headless
from realab_suite.experiments import imports_flag
from realab_suite.experiments import run
from tests import patience
from tests.experiments import small

_ROOT = pathlib.Path(__file__).parents[2]


def _run(*arguments, module='realab_suite.experiments.run', **environment):
  return subprocess.run(
      [sys.executable, '-W', 'error', '-m', module, *arguments],
      cwd=_ROOT,
      env={**os.environ, **environment},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )


def test_the_main_job_runs_from_the_command_line(tmp_path):
  output = tmp_path / 'results'
  ran = _run(
      '--policies=no_op', '--channels=embedded,secure', '--seeds=7,',
      '--episodes=1', '--max_steps=5', '--set=registers.reward.scale=0.2',
      f'--output={output}',
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  assert ran.stderr == ''
  said = ran.stdout.splitlines()
  assert sum(line.startswith('videos are skipped: ') for line in said) == 1
  assert said[-1] == f'Everything is in {output}'
  rows = small.rows(output)
  assert [(row.seed, row.num_steps) for row in rows] == [(7, 5), (7, 5)]
  assert small.description(output)['settings']['videos'] is False
  assert {path.name for path in (output / 'plots').iterdir()} == {
      'trajectories.png', 'time_line.png',
  }  # fmt: skip
  again = _run('--policies=no_op', '--novideos', f'--output={output}')
  assert again.returncode == 2
  assert 'not empty' in again.stderr
  assert len(again.stderr.splitlines()) == 1
  assert small.rows(output) == rows


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--polices=random'], "'polices'"),
        (['--episodes=many'], '--episodes=many'),
        ([], '--output'),
        (['--output=results', 'random'], "['random']"),
        (['--output=results', '--seeds=a'], '--seeds=a'),
    ],
)
def test_what_is_wrong_with_a_command_is_said_in_one_line(arguments, complaint):
  ran = _run(*arguments)
  assert ran.returncode == 2
  assert ran.stdout == ''
  [line] = ran.stderr.splitlines()
  assert line.startswith('error: ')
  assert complaint in line


@pytest.mark.parametrize(
    ('text', 'seeds'),
    [('3', (0, 1, 2)), ('3,4,5', (3, 4, 5)), ('7,', (7,)), ('1, 2', (1, 2))],
)
def test_seeds_are_a_count_or_a_list(text, seeds):
  assert run._seeds(text) == seeds


def test_ones_own_module_is_imported_by_every_launcher(tmp_path):
  # The register, the provider, the task and the design of the page.
  page = (_ROOT / 'docs' / 'your_own.md').read_text()
  blocks = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
  [design] = re.findall(
      r'^design = (\{\n.*?^\})', page, re.DOTALL | re.MULTILINE
  )
  (tmp_path / 'mine.py').write_text(
      '\n'.join(b for b in blocks if 'class ' in b)
  )
  (tmp_path / 'watched.yaml').write_text(
      yaml.safe_dump(ast.literal_eval(design))
  )
  arguments = [
      '--domain=stay', '--policies=no_op', '--seeds=1', '--episodes=1',
      '--max_steps=3', '--noplots', '--novideos', '--import=mine',
      f'--design={tmp_path / "watched.yaml"}', f'--output={tmp_path / "out"}',
  ]  # fmt: skip
  ran = _run(*arguments, PYTHONPATH=str(tmp_path))
  assert (ran.returncode, ran.stderr) == (0, '')
  [row] = small.rows(tmp_path / 'out')
  assert row.info.domain == 'stay'
  for module in ('run', 'sweep', 'report', 'serve'):
    importlib.import_module(f'realab_suite.experiments.{module}')
    assert 'import' in {
        flag.name
        for flag in flags.FLAGS.get_key_flags_for_module(
            f'realab_suite.experiments.{module}'
        )
    }


def test_a_sweep_tells_its_runs_what_to_import():
  with flagsaver.flagsaver():
    flags.FLAGS(['program', '--import=one', '--import=two'])
    assert imports_flag.arguments() == ['--import=one', '--import=two']
    with pytest.raises(errors.SpecError, match='--import=one: No module named'):
      imports_flag.load()


def test_where_nothing_renders_exploring_ends_with_one_line(tmp_path):
  ran = _run(
      f'--video={tmp_path / "film.mp4"}', module='realab_suite.explore',
      MUJOCO_GL='disable',
  )  # fmt: skip
  assert ran.returncode == 2
  assert len(ran.stderr.splitlines()) == 1
  assert 'neither a window nor a film' in ran.stderr


@pytest.mark.camera
def test_exploring_without_a_display_makes_a_film(tmp_path):
  film = tmp_path / 'film.mp4'
  ran = _run(
      '--domain=collect_apples', '--policy=no_op', '--max_steps=8',
      f'--video={film}', module='realab_suite.explore',
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  assert ran.stdout == f'The film is {film}\n'
  assert film.stat().st_size > 5_000


def test_with_a_display_the_viewer_gets_a_world_and_a_policy(monkeypatch):
  lengths = []

  def launch(env, policy, title):
    del title
    for _ in range(2):
      time_step, length = env.reset(), 0
      while not time_step.last() and length < 5:
        time_step, length = env.step(policy(time_step)), length + 1
      lengths.append(length)

  viewer = types.SimpleNamespace(launch=launch)
  monkeypatch.setitem(sys.modules, 'dm_control.viewer', viewer)
  monkeypatch.setattr('dm_control.viewer', viewer, raising=False)
  monkeypatch.setenv('DISPLAY', ':0')
  with flagsaver.flagsaver():
    flags.FLAGS(['explore', '--policy=random', '--task=far'])
    explore.main(['explore'])
  assert lengths == [5, 5]


def test_a_renderer_that_does_not_work_is_refused_in_one_line(monkeypatch):
  monkeypatch.setenv('MUJOCO_GL', 'crayons')
  problem = headless.choose_renderer()
  assert problem is not None
  assert problem.startswith('crayons: ')
  assert len(problem.splitlines()) == 1
  assert os.environ['MUJOCO_GL'] == 'disable'


def test_a_renderer_that_works_is_chosen(monkeypatch):
  monkeypatch.setenv('MUJOCO_GL', '')
  monkeypatch.setattr(_display, 'has_display', lambda: True)
  tried = []

  def ran(command, env, **unused):
    tried.append(env['MUJOCO_GL'])
    status = int(env['MUJOCO_GL'] != 'egl')
    return subprocess.CompletedProcess(command, status, '', 'no window')

  monkeypatch.setattr(headless.subprocess, 'run', ran)
  assert headless.choose_renderer() is None
  assert tried == ['glfw', 'egl']
  assert os.environ['MUJOCO_GL'] == 'egl'


def test_missing_modules_are_named_with_what_mends_it():
  assert headless.missing('json', 'os') is None
  problem = headless.missing('json', 'no_such_module')
  assert problem.startswith('no_such_module not installed; run: ')
