"""Tests of the command lines of the launchers."""

import importlib
import json
import os
import pathlib
import re
import subprocess
import sys
import types

from absl import flags as absl_flags
from absl.testing import flagsaver
import pytest

from realab_suite import errors
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import scripted
from realab_suite.launchers import compare
from realab_suite.launchers import explore
from realab_suite.launchers import film
from realab_suite.launchers import flags
from realab_suite.launchers import label
from realab_suite.launchers import renderers
from realab_suite.launchers import serve
from realab_suite.launchers import stake
from realab_suite.launchers import supervise
from realab_suite.launchers import sweep  # noqa: F401 - defines --workers.
from realab_suite.launchers import train  # noqa: F401 - defines --parent.
from tests import patience
from tests import registries
from tests.lab.experiments import small
from tests.launchers import in_process

_ROOT = pathlib.Path(__file__).parents[2]
_EXPERIMENT = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'runs': {'reward': {'design': 'instantaneous_reward'}},
}


def _run(*arguments, module='realab_suite.launchers.compare', **environment):
  return subprocess.run(
      [sys.executable, '-W', 'error', '-m', module, *arguments],
      cwd=_ROOT,
      env={**os.environ, **environment},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )


_SAYS = """
import sys
from realab_suite.launchers import program

def main():
  for i in range(3):
    program.say(f'line {i}')
    sys.stderr.write('more\\n')
  return 7

program.start(main)
"""


@pytest.mark.parametrize('ends', ['', '2>&1', '>&-', '2>&1 >&-', '>&- 2>&-'])
def test_programs_outlive_the_readers_of_their_output(ends):
  read, write = os.pipe()
  os.close(read)
  ran = subprocess.run(
      ['sh', '-c', f'exec {sys.executable} -c "$0" {ends}', _SAYS],
      stdout=write,
      stderr=subprocess.PIPE,
      timeout=patience.SECONDS,
      check=False,
  )
  os.close(write)
  assert (ran.returncode, ran.stderr) == (
      7,
      b'' if '2>' in ends else b'more\n' * 3,
  )


def _seeds(text):
  with flagsaver.flagsaver(seeds=text):
    return flags.seeds()


def test_the_main_job_runs_from_the_command_line(tmp_path):
  output = tmp_path / 'results'
  ran = _run(
      '--policies=no_op', '--channels=embedded,secure', '--seeds=7,',
      '--episodes=1', '--max_steps=5', '--set=registers.reward.scale=0.2',
      '--output=~/results',
      HOME=str(tmp_path),
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  assert ran.stderr == ''
  said = ran.stdout.splitlines()
  assert said[-1] == f'Results are in {output}'
  rows = small.rows(output)
  assert [(row.seed, row.num_steps) for row in rows] == [(7, 5), (7, 5)]
  again = in_process.complaint(
      compare, '--policies=no_op', f'--output={output}'
  )
  assert 'not empty' in again
  assert small.rows(output) == rows


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--polices=random'], "'polices'"),
        (['--episodes=many'], '--episodes=many'),
        (['--output=results', 'random'], "['random']"),
        (['--output=results', '--seeds=a'], '--seeds=a'),
        (['--output='], '--output: missing'),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(arguments, complaint):
  assert complaint in in_process.complaint(compare, *arguments)


@pytest.mark.parametrize(
    'name', ['input', 'output', 'video', 'design', 'experiment']
)
def test_home_folders_in_paths_are_expanded(name, monkeypatch):
  monkeypatch.setenv('HOME', '/home/ada')
  # The parser alone, because a flag remembers that it was parsed.
  parser = flags._SHARED[name].parser
  assert parser.parse('~/a,b~,~/c') == '/home/ada/a,b~,/home/ada/c'


def test_home_folders_in_lists_of_designs_are_expanded(monkeypatch):
  monkeypatch.setenv('HOME', '/home/ada')
  said = in_process.complaint(label, '--designs=~/no.yaml', '--output=new')
  assert "'/home/ada/no.yaml'" in said


@pytest.mark.parametrize(
    ('text', 'seeds'),
    [('3', (0, 1, 2)), ('3,4,5', (3, 4, 5)), ('7,', (7,))],
)
def test_seeds_are_a_count_or_a_list(text, seeds):
  assert _seeds(text) == seeds


@pytest.mark.parametrize(
    'text', ['0', '10001', '9' * 5000, '٣', '1_0', ',', '2147483648,']
)
def test_wrong_seeds_are_refused_in_one_line(text):
  with pytest.raises(errors.SpecError, match='must be a number') as raised:
    _seeds(text)
  message = str(raised.value)
  assert message.startswith(f'--seeds={text[:40]}')
  assert len(message) < 200


def test_the_most_and_the_largest_seeds_are_accepted():
  assert _seeds('10000') == tuple(range(10_000))
  assert _seeds('0,2147483647') == (
      0,
      flags.LARGEST_SEED,
  )
  # Files of experiments, and so their runs, have the same limit.
  experiment_specs.load({**_EXPERIMENT, 'seeds': [flags.LARGEST_SEED]})
  with pytest.raises(errors.SpecError, match='2147483648'):
    experiment_specs.load({**_EXPERIMENT, 'seeds': [flags.LARGEST_SEED + 1]})


@pytest.mark.parametrize(
    'argument',
    ['--seed=-1', '--episodes=0', '--workers=0', '--max_steps=many'],
)
def test_a_number_out_of_range_is_refused_when_flags_are_parsed(argument):
  with (
      flagsaver.flagsaver(),
      pytest.raises(absl_flags.IllegalFlagValueError, match=argument[:12]),
  ):
    absl_flags.FLAGS(['program', argument])


@pytest.mark.parametrize('name', ['', '.mine', 'a,b'])
def test_wrong_names_of_modules_are_refused(name):
  with flagsaver.flagsaver():
    absl_flags.FLAGS(['program', f'--import={name}'])
    with pytest.raises(errors.SpecError, match='must be a module') as raised:
      flags.load_imports()
    assert str(raised.value).endswith('for several, repeat the option')


def test_every_launcher_imports_the_user_s_module(tmp_path, monkeypatch):
  # The register, the provider, the task and the design of the page.
  page = (_ROOT / 'docs' / 'your_own.md').read_text()
  blocks = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
  [design] = re.findall(r'```yaml\n(# watched.yaml\n.*?)```', page, re.DOTALL)
  (tmp_path / 'mine.py').write_text(
      '\n'.join(b for b in blocks if 'class ' in b)
  )
  (tmp_path / 'watched.yaml').write_text(design)
  arguments = [
      '--task=stay.standard', '--policies=no_op', '--seeds=1', '--episodes=1',
      '--max_steps=3', '--import=mine',
      f'--design={tmp_path / "watched.yaml"}', f'--output={tmp_path / "out"}',
  ]  # fmt: skip
  monkeypatch.syspath_prepend(str(tmp_path))
  with registries.preserved():
    ended = in_process.run(compare, *arguments)
  assert (ended.status, ended.stderr) == (0, '')
  [row] = small.rows(tmp_path / 'out')
  assert row.info.domain == 'stay'
  for module in ('compare', 'train', 'sweep', 'report', 'serve'):
    importlib.import_module(f'realab_suite.launchers.{module}')
    assert 'import' in {
        flag.name
        for flag in absl_flags.FLAGS.get_key_flags_for_module(
            f'realab_suite.launchers.{module}'
        )
    }


def test_a_sweep_passes_imports_to_its_runs():
  with flagsaver.flagsaver():
    absl_flags.FLAGS(['program', '--import=one', '--import=two'])
    assert flags.import_arguments() == ['--import=one', '--import=two']
    with pytest.raises(errors.SpecError, match='--import=one: No module named'):
      flags.load_imports()


def test_exploring_without_a_renderer_gives_one_line(tmp_path):
  ran = _run(
      f'--video={tmp_path / "film.mp4"}',
      module='realab_suite.launchers.explore', MUJOCO_GL='disable',
  )  # fmt: skip
  assert ran.returncode == 2
  assert len(ran.stderr.splitlines()) == 1
  assert 'no renderer for a film: MUJOCO_GL=disable (' in ran.stderr
  assert 'set MUJOCO_GL to egl (headless), glfw' in ran.stderr


@pytest.mark.usefixtures('egl')
def test_exploring_without_a_display_makes_a_film(tmp_path):
  film = tmp_path / 'film.mp4'
  ran = _run(
      '--task=collect_apples.standard',
      '--max_steps=8',
      f'--video={film}',
      module='realab_suite.launchers.explore',
      MUJOCO_GL='egl',
  )
  assert ran.returncode == 0, ran.stderr
  first, last = ran.stdout.splitlines()
  # A saboteur, where no policy is named.
  assert first.startswith('Filming an episode of carrying_saboteur; ')
  assert last == f'The film is {film}'
  assert film.stat().st_size > 5_000


@pytest.mark.parametrize(
    ('display', 'renderer', 'problem'),
    [
        ('', '', 'there is no display'),
        (':0', 'egl', 'the viewer needs glfw, and MUJOCO_GL=egl'),
    ],
)
def test_exploring_where_no_window_opens_names_the_flag_of_a_film(
    monkeypatch, display, renderer, problem
):
  monkeypatch.setenv('DISPLAY', display)
  monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
  monkeypatch.setenv('MUJOCO_GL', renderer)
  complaint = in_process.complaint(explore)
  assert f'opened: {problem}; --video=world.mp4' in complaint


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
  monkeypatch.setattr(renderers, 'why_no_window', lambda: '')
  with flagsaver.flagsaver():
    absl_flags.FLAGS(['explore', '--policy=random', '--task=unlock_door.far'])
    explore.main()
  assert lengths == [5, 5]


def test_a_task_of_a_comparison_may_have_its_domain(monkeypatch, tmp_path):
  given = []
  monkeypatch.setattr(scripted, 'run', lambda one, *unused: given.append(one))
  in_process.run(compare, '--task=collect_apples.near', f'--output={tmp_path}')
  [settings] = given
  world = settings.world
  assert (world.domain, world.task) == ('collect_apples', 'near')


def test_a_renderer_that_does_not_work_is_refused_in_one_line(monkeypatch):
  monkeypatch.setenv('MUJOCO_GL', 'crayons')
  problem = renderers.choose_renderer()
  assert problem is not None
  assert problem.startswith('MUJOCO_GL=crayons (')
  assert len(problem.splitlines()) == 1
  assert os.environ['MUJOCO_GL'] == 'disable'


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['--input=a'], '--run: missing'),
        (['--input=a', '--run=b', '--video=c.mp4'], 'film: MUJOCO_GL=disable'),
    ],
)
def test_a_film_needs_a_run_and_a_renderer(monkeypatch, arguments, complaint):
  monkeypatch.setenv('MUJOCO_GL', 'disable')
  assert complaint in in_process.complaint(film, *arguments)


def test_a_film_shows_the_episode_that_is_named():
  rows = [types.SimpleNamespace(key=(7, world, 0)) for world in range(12)]
  run = types.SimpleNamespace(name='reward', rows=rows)
  assert film._named(run, '7,3,0') is rows[3]
  with pytest.raises(errors.SpecError) as raised:
    film._named(run, '7,12,0')
  assert str(raised.value) == (
      '--episode=7,12,0: no evaluation episode of reward; must be one of its'
      ' 12, from 7,0,0 to 7,11,0'
  )


@pytest.mark.skipif(sys.platform != 'linux', reason='EGL exists on Linux')
@pytest.mark.parametrize(
    ('given', 'display', 'named'),
    [('', ':0', 'egl'), ('', '', ''), ('disable', ':0', 'disable')],
)
def test_frames_of_programs_get_no_window(monkeypatch, given, display, named):
  monkeypatch.setenv('MUJOCO_GL', given)
  monkeypatch.setenv('DISPLAY', display)
  monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
  renderers.render_on_demand()
  assert os.environ['MUJOCO_GL'] == named


def test_a_renderer_that_works_is_chosen(monkeypatch):
  monkeypatch.setenv('MUJOCO_GL', '')
  tried = []

  def ran(command, env, **unused):
    tried.append(env['MUJOCO_GL'])
    return subprocess.CompletedProcess(command, 0, '', '')

  monkeypatch.setattr(renderers.subprocess, 'run', ran)
  assert renderers.choose_renderer() is None
  assert [os.environ['MUJOCO_GL']] == tried


@pytest.mark.parametrize(
    ('module', 'arguments'),
    [
        (compare, ['--output=OUTPUT']),
        (label, ['--output=OUTPUT', '--policies=random']),
        (serve, ['--output=OUTPUT', '--agent_command=false']),
        (stake, []),
    ],
)
def test_an_option_that_a_learner_lacks_is_refused_in_one_line(
    module, arguments, tmp_path
):
  design = {**specs.load('instantaneous_reward').to_mapping(), 'name': 'mine'}
  design['learner']['lr'] = 0.1
  file = tmp_path / 'mine.yaml'
  file.write_text(json.dumps(design))
  arguments = [one.replace('OUTPUT', f'{tmp_path}/new') for one in arguments]
  flag = 'designs' if module is label else 'design'
  for where, wrong in (
      ('instantaneous_reward', '--set=learner.lr=0.1'),
      (str(file), f'--{flag}={file}'),
  ):
    line = in_process.complaint(
        module, '--task=near', '--max_steps=5', *arguments, wrong
    )
    assert f"{where}: learner: unknown key 'lr' (allowed: " in line
  assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize('flag', ['--asks=correction', '--wait'])
def test_a_design_of_a_person_has_questions_of_its_own(flag, tmp_path):
  line = in_process.complaint(
      supervise, f'--output={tmp_path}', '--design=mine.yaml', flag
  )
  name = flag.partition('=')[0]
  assert f'{name}: without effect beside --design' in line
