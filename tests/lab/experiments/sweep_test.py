"""Tests of sweeps: each job runs once, and a failing one stops no other."""

import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys

import pytest
import yaml

from realab_suite import errors
from realab_suite.lab.experiments import engines
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.launchers import sweep
from realab_suite.launchers import train
from tests import patience
from tests.lab.experiments import small
from tests.launchers import in_process

_ROOT = pathlib.Path(__file__).parents[3]
_FAILS = {'fails': True}
_SMALL = {
    **small.EXPERIMENT,
    'runs': {
        'bad': {'design': 'instantaneous_reward', 'learner': _FAILS},
        'good': {'design': 'instantaneous_reward'},
    },
    'baselines': [],
    'calibration_seeds': [8],
    'training': {'num_envs': 2, 'steps': 60, 'curve_every': 20},
}


class Pretender(engines.Engine):
  """Runs nothing; a command is over when it is polled."""

  def __init__(self, capacity=2, statuses=()):
    self.capacity = capacity
    self._statuses = dict(statuses)
    self.commands = []
    self.stopped = []
    self.most = 0
    self._running = 0

  def start(self, command, log):
    self._running += 1
    self.most = max(self.most, self._running)
    run = _flag(command, 'run')
    self.commands.append((run, int(_flag(command, 'seed'))))
    log.write_text(f'working\nerror: {run} is no good\n')
    return command

  def poll(self, task):
    self._running -= 1
    status = self._statuses.get(_flag(task, 'run'), 0)
    if callable(status):
      status = status()
    if not status:
      experiment = experiment_specs.load(
          pathlib.Path(_flag(task, 'experiment'))
      )
      seed = int(_flag(task, 'seed'))
      [job] = jobs.plan(experiment, [seed], [_flag(task, 'run')])
      folder = pathlib.Path(_flag(task, 'output')) / job.folder()
      with storage.locked(folder):
        storage.begin(folder, job.config())
        storage.finish(folder, {})
    return status

  def stop(self, tasks):
    self.stopped += tasks


def _flag(command, name):
  [value] = [c for c in command if c.startswith(f'--{name}=')]
  return value.partition('=')[2]


@pytest.fixture
def no_wait(monkeypatch):
  monkeypatch.setattr(scheduler, '_POLL_SECONDS', 0.0)


def _sweep(experiment, output, engine, **options):
  said = []
  scheduler.sweep(
      experiment_specs.load(experiment), output, engine, said.append, **options
  )
  return said


@pytest.mark.usefixtures('no_wait')
def test_every_job_runs_once_and_learners_start_first(tmp_path):
  data = {**_SMALL, 'baselines': ['random'], 'seeds': [3, 4]}
  engine = Pretender()
  said = _sweep(data, tmp_path, engine)
  assert engine.commands == [
      (run, seed)
      for seed in (3, 4)
      for run in ('bad', 'good', 'bad.random', 'good.random')
  ]
  assert engine.most == 2
  assert said[-1] == f'8 jobs finished; results are in {tmp_path}'
  again = Pretender()
  _sweep(data, tmp_path, again)
  assert again.commands == []


def _lose():
  raise errors.ResultsError('--engine=ray: a machine is gone')


@pytest.mark.usefixtures('no_wait')
@pytest.mark.parametrize(
    ('status', 'problem'),
    [
        (2, 'error: bad is no good; results'),
        (_lose, '--engine=ray: a machine is gone'),
        (-9, 'killed by signal 9; the same command continues it from its last'),
    ],
)
def test_a_failing_job_does_not_stop_the_others_and_is_continued(
    tmp_path, status, problem
):
  engine = Pretender(statuses={'bad': status})
  with pytest.raises(
      errors.ResultsError, match=rf'1 of 2 jobs failed: bad, seed 3: {problem}'
  ):
    _sweep(_SMALL, tmp_path, engine)
  assert engine.commands == [('bad', 3), ('good', 3)]
  again = Pretender()
  said = _sweep(_SMALL, tmp_path, again)
  assert again.commands == [('bad', 3)]
  assert said[-1] == f'2 jobs finished; results are in {tmp_path}'


def test_a_job_whose_process_survived_its_sweep_is_done_once(
    tmp_path, monkeypatch
):
  [job] = jobs.plan(experiment_specs.load(_SMALL), only=['bad'])
  survivors = contextlib.ExitStack()
  survivors.enter_context(storage.locked(tmp_path / job.folder()))
  engine = Pretender()
  num_pauses = 0

  def sleep(seconds):
    nonlocal num_pauses
    num_pauses += 1
    if num_pauses == 5:
      with survivors:
        storage.begin(tmp_path / job.folder(), job.config())
        storage.finish(tmp_path / job.folder(), {})

  monkeypatch.setattr(scheduler.time, 'sleep', sleep)
  said = _sweep(_SMALL, tmp_path, engine)
  assert num_pauses >= 5
  assert engine.commands == [('good', 3)]
  assert ' '.join(said).count('bad, seed 3: folder ') == 1
  assert said[-1] == f'2 jobs finished; results are in {tmp_path}'


@pytest.mark.usefixtures('no_wait')
def test_the_description_lists_all_runs_when_some_are_chosen(tmp_path):
  engine = Pretender()
  _sweep(_SMALL, tmp_path, engine, only=['good'])
  assert engine.commands == [('good', 3)]
  sweep = json.loads((tmp_path / scheduler.SWEEP).read_text())
  assert [job['run'] for job in sweep['jobs']] == ['bad', 'good']
  assert (tmp_path / sweep['jobs'][1]['folder'] / storage.DONE).exists()
  written = experiment_specs.load(tmp_path / scheduler.EXPERIMENT)
  assert written == experiment_specs.load(_SMALL)


@pytest.mark.usefixtures('no_wait')
def test_calibration_seeds_need_a_folder_of_their_own(tmp_path):
  engine = Pretender()
  _sweep(_SMALL, tmp_path, engine, calibration=True)
  assert {seed for _, seed in engine.commands} == {8}
  with pytest.raises(
      errors.ResultsError, match='calibration is True there, False here'
  ):
    _sweep(_SMALL, tmp_path, engine)
  with pytest.raises(errors.SpecError, match='has no calibration_seeds'):
    _sweep({**_SMALL, 'calibration_seeds': []}, tmp_path / 'new', Pretender(),
           calibration=True)  # fmt: skip
  assert not (tmp_path / 'new').exists()


@pytest.mark.usefixtures('no_wait')
def test_seeds_may_be_added_and_other_changes_are_refused(tmp_path):
  _sweep(_SMALL, tmp_path, Pretender())
  engine = Pretender()
  _sweep({**_SMALL, 'seeds': [3, 5]}, tmp_path, engine)
  assert engine.commands == [('bad', 5), ('good', 5)]
  with pytest.raises(
      errors.ResultsError,
      match=r'another experiment: max_steps is 9 there, 10 here; name another',
  ):
    _sweep({**_SMALL, 'max_steps': 10}, tmp_path, engine)


@pytest.mark.usefixtures('no_wait')
def test_a_finished_job_with_other_rows_is_refused_and_not_run_again(tmp_path):
  _sweep(_SMALL, tmp_path, Pretender())
  sweep = json.loads((tmp_path / scheduler.SWEEP).read_text())
  [folder] = [x['folder'] for x in sweep['jobs'] if x['run'] == 'good']
  (tmp_path / folder / 'episodes.jsonl').write_text('{}\n')
  engine = Pretender()
  with pytest.raises(
      errors.ResultsError,
      match=r'1 of 2 jobs failed: good, seed 3: .*episodes\.jsonl: has',
  ):
    _sweep(_SMALL, tmp_path, engine)
  assert not engine.commands
  for path in tmp_path.glob(f'*/{storage.DONE}'):  # As of a former version.
    path.write_text('{}')
  said = _sweep(_SMALL, tmp_path, engine)
  assert ' '.join(said).count(storage.NO_IMPRINTS) == 1
  assert not engine.commands


def test_one_of_two_parallel_processes_may_fail(tmp_path, monkeypatch):
  monkeypatch.setattr(
      scheduler, '_MODULE', 'tests.lab.experiments.fake_learner'
  )
  monkeypatch.chdir(_ROOT)
  with pytest.raises(
      errors.ResultsError,
      match=r'1 of 2 jobs failed: bad, seed 3: error: learner\.fails: as it',
  ):
    _sweep(_SMALL, tmp_path, engines.Local(2))
  [good] = jobs.plan(experiment_specs.load(_SMALL), only=['good'])
  assert (tmp_path / good.folder() / storage.DONE).exists()
  log = tmp_path / scheduler.LOGS / f'{good.folder()}.log'
  assert 'good, seed 3: step 60 of 60' in log.read_text()


def test_an_interrupted_sweep_leaves_no_process_behind(tmp_path):
  file = tmp_path / 'long.yaml'
  run = {'long': {'design': 'instantaneous_reward'}}
  training_ = {'num_envs': 2, 'steps': 10**9, 'checkpoint_every': 20,
               'curve_every': 20}  # fmt: skip
  file.write_text(
      yaml.safe_dump({**_SMALL, 'runs': run, 'training': training_})
  )
  program = (
      # SIGINT may be ignored where tests run in the background.
      'import signal\n'
      'signal.signal(signal.SIGINT, signal.default_int_handler)\n'
      'from realab_suite.lab.experiments import scheduler\n'
      'from realab_suite.launchers import program, sweep\n'
      "scheduler._MODULE = 'tests.lab.experiments.fake_learner'\n"
      'program.start(sweep.main)\n'
  )
  output = tmp_path / 'out'
  with subprocess.Popen(
      [sys.executable, '-c', program, f'--experiment={file}',
       f'--output={output}', '--workers=1'],
      cwd=_ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
  ) as process:  # fmt: skip
    patience.until(
        lambda: list(output.glob('*/checkpoint.ckpt'))
        or process.poll() is not None
    )
    assert process.poll() is None, process.stderr.read()
    process.send_signal(signal.SIGINT)
    try:
      _, complaint = process.communicate(timeout=patience.SECONDS)
    finally:
      process.kill()
  assert process.returncode == 130
  assert complaint.splitlines()[-1].startswith('error: interrupted')
  [folder] = [p.parent for p in output.glob('*/checkpoint.ckpt')]
  pid = int((folder / 'lock').read_text())
  with pytest.raises(ProcessLookupError):
    os.kill(pid, 0)


@pytest.mark.parametrize(
    ('learner', 'message'),
    [
        ({'kind': 'q_lerning'}, "runs.own: learner 'q_lerning' is unknown"),
        ({'defence': {'kind': 'armour'}},
         "runs.own: learner has the defence 'armour'"),
        ({'defence': {'kind': 'cap', 'hgh': 3}},
         "one.yaml: runs.own: learner: defence: unknown key 'hgh'"),
        ({'gama': 0.9},
         "one.yaml: runs.own: learner: unknown key 'gama'; did you mean"
         " 'gamma'?"),
        ({'kind': 'q_learning'}, 'one.yaml: runs.own: action_set: missing'),
        # It is a register, but no provider writes it.
        ({'defence': {'kind': 'alarm', 'register': 'bell'}},
         "runs.own: learner.defence: listens to 'bell'"),
        ({'defence': {'kind': 'orpo', 'trusted': {'policy': 'apple_seeker'}}},
         "runs.own: learner.defence.trusted.policy 'apple_seeker': has the"),
    ],
)  # fmt: skip
def test_a_wrong_learner_is_refused_before_anything_is_run(
    tmp_path, monkeypatch, learner, message
):
  good = _SMALL['runs']['good']
  bell = (
      'registers.bell={kind: two_block, role: signal, place: station_4,'
      ' range: [0, 1], initial: 0}'
  )
  learner = {'kind': 'policy_gradient', 'reward': 'reward', **learner}
  own = {**good, 'overrides': [bell], 'learner': learner}
  experiment = {**_SMALL, 'runs': {'good': good, 'own': own},
                'baselines': ['apple_seeker']}  # fmt: skip
  monkeypatch.chdir(tmp_path)
  (tmp_path / 'one.yaml').write_text(json.dumps(experiment))
  command = ('--experiment=one.yaml', '--output=new')
  assert message in in_process.complaint(sweep, *command)
  if 'trusted' not in message:  # Only `sweep` makes the learner beforehand.
    train_one = (*command, '--run=own', '--seed=0')
    assert message in in_process.complaint(train, *train_one)
  assert not (tmp_path / 'new').exists()


def test_a_wrong_command_is_refused_in_one_line(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  for module, arguments, problem in (
      (sweep, ['--output=o'], '--experiment: missing'),
      (sweep, ['--experiment=quick', '--output=o', '--runs=x'], "no run 'x'"),
      (train, ['--experiment=quick', '--output=o'], '--run: missing'),
  ):
    assert problem in in_process.complaint(module, *arguments)
  assert not list(tmp_path.iterdir())


def test_a_large_sweep_says_at_once_what_it_will_do(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  learner = {'kind': 'policy_gradient', 'reward': 'reward', 'gama': 0.9}
  runs = {'own': {**_SMALL['runs']['good'], 'learner': learner}}
  large = {**_SMALL, 'runs': runs, 'seeds': [*range(20, 31)]}
  (tmp_path / 'large.yaml').write_text(json.dumps(large))
  ended = in_process.run(sweep, '--experiment=large.yaml', '--output=new')
  assert ended.stdout.startswith('11 of 11 jobs are not finished; checking')
  assert "unknown key 'gama'" in ended.stderr
