"""Tests of experiment specs: files, errors and planned jobs."""

import importlib.resources
import pathlib

import pytest
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.tasks import unlock_door

_FOLDER = pathlib.Path(__file__).parents[3] / 'configs' / 'experiments'
_FILES = sorted(_FOLDER.glob('*.yaml'))
_SMALL = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'runs': {'reward': {'design': 'instantaneous_reward'}},
    'seeds': [3],
}

_every_file = pytest.mark.parametrize(
    'path', _FILES, ids=[path.stem for path in _FILES]
)


def test_every_experiment_file_is_shipped():
  assert experiment_specs.EXPERIMENTS == tuple(path.stem for path in _FILES)
  assert {'paper', 'quick'} <= set(experiment_specs.EXPERIMENTS)
  shipped = importlib.resources.files('realab_suite.configs') / 'experiments'
  for path in _FILES:
    assert (shipped / path.name).read_bytes() == path.read_bytes()


@_every_file
def test_an_experiment_is_the_same_by_name_by_path_and_by_content(
    path, monkeypatch
):
  experiment = experiment_specs.load(path.stem)
  # Its worlds can be loaded, so they need not be loaded again.
  monkeypatch.setattr(
      experiment_specs.ExperimentSpec, '_check_world', lambda *unused: None
  )
  assert experiment.name == path.stem
  assert experiment.description.endswith('.')
  for same in (path, experiment.to_mapping()):
    other = experiment_specs.load(same)
    assert other == experiment
    assert other.digest() == experiment.digest()
  # Calibration seeds are kept apart.
  assert experiment.calibration_seeds
  assert not set(experiment.seeds) & set(experiment.calibration_seeds)


@pytest.mark.parametrize('name', ['quick', 'verdict'])
def test_new_experiments_have_segments_of_whole_episodes(name):
  experiment = experiment_specs.load(name)
  training = experiment.training
  # An episode begins with a reset, which takes a step as well.
  of_episodes = training.num_envs * (experiment.max_steps + 1)
  assert training.checkpoint_every % of_episodes == 0
  assert training.curve_every % of_episodes == 0
  assert training.steps % of_episodes == 0
  assert len(experiment.seeds) == (5 if name == 'verdict' else 1)


def test_a_world_is_loaded_once_for_the_runs_that_share_it(monkeypatch):
  given = yaml.safe_load(_FILES[0].with_stem('defences').read_text())
  first = given['runs']['reward']
  elsewhere = {**first, 'task': 'unlock_door.far'}
  moved = {**first, 'overrides': [*first['overrides'], 'dof=free']}
  runs = {
      'first': first, 'capped': given['runs']['cap'], 'elsewhere': elsewhere,
      'moved': moved, 'again': elsewhere,
  }  # fmt: skip
  loaded = []
  monkeypatch.setattr(
      experiment_specs.ExperimentSpec,
      '_check_world',
      lambda self, design: loaded.append((self.task, design.dof)),
  )
  assert len(experiment_specs.load({**given, 'runs': runs}).designs) == 5
  assert loaded == [
      ('unlock_door.near', 'planar'),
      ('unlock_door.far', 'planar'),
      ('unlock_door.near', 'free'),
  ]


def _run(design='instantaneous_reward', **options):
  return {'runs': {'a': {'design': design, **options}}}


def _sees(*senses):
  return {'environment_kwargs': {'senses': list(senses)}}


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'sedes': [1]}, "unknown key 'sedes'; did you mean 'seeds'?"),
        ({'seeds': [1, 1]}, 'seeds and calibration_seeds: 1 appears twice'),
        ({'runs': {'A b': {}}}, "runs['A b']"),
        ({'task': 'unlock_door.up'}, 'task: task unlock_door.up is unknown'),
        ({'baselines': ['nobody']}, "policy 'nobody' is unknown"),
        (_run(baselines=['nobody']), "policy 'nobody' is unknown"),
        (
            {**_run(baselines=['random']), 'baselines': ['solver', 'random']},
            'runs.a.baselines: random appears twice, here or among the basel',
        ),
        (
            _run(baselines=['no_op', 'no_op']),
            'runs.a.baselines: no_op appears twice',
        ),
        (_run('none'), "runs.a.learner: design 'none' has no learner"),
        (
            _run(learner={'reward': 'score'}),
            "runs.a: learner.reward: an agent may not read meter register 'sco",
        ),
        (_run(task='gates.nowhere'), 'runs.a.task: '),
        (
            _run('value_advice', overrides=['channel=secure'], twin=True),
            "runs.a.twin: design 'value_advice' is secure already",
        ),
        ({'task_kwargs': {'random': 1}}, 'task_kwargs: random: the seeds of'),
        (_sees('nose'), "runs.reward: senses: unknown ['nose']; this world"),
        (
            {**_sees('camera'), **_run('online_imitation')},
            "runs.a: design 'online_imitation': providers[0]:demonstration"
            ' needs the senses',
        ),
        (
            {**_sees('camera'), 'baselines': ['random', 'apple_seeker']},
            'runs.reward: policy AppleSeeker needs the senses',
        ),
    ],
)
def test_a_wrong_experiment_is_refused_in_one_line(
    tmp_path, changes, complaint
):
  file = tmp_path / 'mine.yaml'
  file.write_text(yaml.safe_dump({**_SMALL, **changes}))
  with pytest.raises(errors.SpecError) as raised:
    experiment_specs.load(file)
  [line] = str(raised.value).splitlines()
  assert line.startswith(f'{file}: ')
  assert complaint in line


def test_a_run_changes_its_design_and_its_learner():
  run = {
      'design': 'instantaneous_reward',
      'overrides': ['registers.reward.scale=0.2'],
      'learner': {'learning_rate': 0.01},
      'twin': True,
  }
  experiment = experiment_specs.load({**_SMALL, 'runs': {'reward': run}})
  plain, twin = jobs.plan(experiment)
  for job in (plain, twin):
    assert job.design.registers['reward'].scale == 0.2
    assert job.design.learner.model_extra == {
        'reward': 'reward', 'learning_rate': 0.01,
    }  # fmt: skip
  assert (plain.run, plain.twin_of, plain.design.channel) == (
      'reward', None, 'embedded',
  )  # fmt: skip
  assert (twin.run, twin.twin_of, twin.design.channel) == (
      'reward.secure', 'reward', 'secure',
  )  # fmt: skip


def test_a_run_may_bring_a_learner_to_a_design_without_one():
  run = {'design': 'none', 'learner': {'kind': 'restless'}}
  [job] = jobs.plan(experiment_specs.load({**_SMALL, 'runs': {'idle': run}}))
  assert job.kind == 'restless'
  assert job.design.objective is None


def test_a_run_may_be_trained_for_longer_than_the_others():
  design = {'design': 'instantaneous_reward'}
  runs = {'longer': {**design, 'steps': 900, 'twin': True}, 'as_all': design}
  experiment = experiment_specs.load(
      {**_SMALL, 'runs': runs, 'training': {'steps': 500, 'num_envs': 9}}
  )
  planned = {job.run: job for job in jobs.plan(experiment)}
  assert {run: job.training.steps for run, job in planned.items()} == {
      'longer': 900, 'longer.secure': 900, 'as_all': 500,
  }  # fmt: skip
  assert planned['longer'].training.num_envs == 9
  assert planned['longer'].config()['training']['steps'] == 900


def test_jobs_go_seed_by_seed_with_the_baseline_first():
  experiment = experiment_specs.load(
      {**_SMALL, 'baselines': ['apple_seeker', 'random'], 'seeds': [3, 1]}
  )
  planned = jobs.plan(experiment)
  assert [(job.seed, job.run, job.baseline) for job in planned] == [
      (seed, run, baseline)
      for seed in (3, 1)
      for run, baseline in (
          ('reward.apple_seeker', None),
          ('reward.random', 'reward.apple_seeker'),
          ('reward', 'reward.apple_seeker'),
      )
  ]
  assert len({job.evaluation_seed for job in planned}) == 2


def test_every_setting_that_affects_results_changes_the_folder(monkeypatch):
  # A description does not.
  changes = [
      {'description': 'Text.'},
      {'max_steps': 9},
      {'task': 'unlock_door.far'},
      {'task_kwargs': {'camera_size': [8, 8]}},
      {'environment_kwargs': {'senses': ['pitch', 'holding']}},
      {'training': {'num_envs': 9}},
      {'evaluation': {'episodes': 9}},
      {'runs': {'reward': {'design': 'instantaneous_reward',
                           'learner': {'discount': 0.9}}}},
      {'runs': {'reward': {'design': 'instantaneous_reward',
                           'overrides': ['dof=planar']}}},
  ]  # fmt: skip

  def folder(change):
    [job] = jobs.plan(experiment_specs.load({**_SMALL, **change}))
    return job.folder()

  folders = {folder({}), *map(folder, changes)}
  assert len(folders) == len(changes)
  versions = jobs.results.versions()
  monkeypatch.setattr(
      jobs.results, 'versions', lambda: {**versions, 'mujoco': '3.99'}
  )
  assert folder({}) not in folders


def test_a_thousand_jobs_read_the_version_of_a_package_once(monkeypatch):
  read, version = [], jobs.metadata.version
  monkeypatch.setattr(
      jobs.metadata, 'version', lambda name: read.append(name) or version(name)
  )
  jobs.results.version_of.cache_clear()
  experiment = experiment_specs.load(_SMALL)
  planned = jobs.plan(experiment, range(1000))
  assert len({job.folder() for job in planned}) == len(planned) >= 1000
  assert 'mujoco' in read
  installed = [name for name in read if name in jobs.versions_of_learners()]
  assert len(installed) == len({*installed})
  assert read.count('mujoco') == 1


def test_each_run_has_its_task_and_the_solver_of_it():
  runs = {
      'here': {'design': 'instantaneous_reward'},
      'there': {
          'design': 'off_switch', 'task': 'off_switch.far', 'twin': True,
          'baselines': ['button_saboteur'],
      },
  }  # fmt: skip
  experiment = experiment_specs.load(
      {**_SMALL, 'runs': runs, 'baselines': ['solver', 'random']}
  )
  planned = {job.run: job for job in jobs.plan(experiment)}
  found = {
      name: (job.config()['task'], job.policy) for name, job in planned.items()
  }
  near, far = 'unlock_door.near', 'off_switch.far'
  assert found == {
      'here.solver': (near, 'apple_seeker'),
      'here.random': (near, 'random'),
      'here': (near, None),
      'there.solver': (far, 'off_switch_solver'),
      'there.random': (far, 'random'),
      'there.button_saboteur': (far, 'button_saboteur'),
      'there': (far, None),
      'there.secure': (far, None),
  }
  assert planned['there'].baseline == 'there.solver'
  assert planned['there'].dynamics == suite.dynamics('off_switch', 'far')
  for name in ('there', 'there.secure'):
    job = planned[name]
    assert job.experiment.training_world.task == 'far'
    assert job.info(0.1).domain == 'off_switch'
  with pytest.raises(errors.SpecError, match=r'runs\.there\.task: off_switch'):
    experiment.on_task('unlock_door.far')


@pytest.mark.parametrize('name', ['solver', 'apple_seeker', 'no_op'])
def test_the_solver_or_no_saboteur_is_the_baseline_to_compare_with(name):
  experiment = experiment_specs.load(
      {**_SMALL, 'baselines': ['carrying_saboteur', name, 'random']}
  )
  planned = {job.run: job.baseline for job in jobs.plan(experiment)}
  assert {of for of in planned.values() if of} == {f'reward.{name}'}
  assert planned[f'reward.{name}'] is None


def test_a_solver_of_a_task_without_one_is_refused(monkeypatch):
  monkeypatch.setattr(unlock_door.UnlockDoor, 'SOLVER', None)
  with pytest.raises(errors.SpecError, match='solver: unlock_door'):
    experiment_specs.load({**_SMALL, 'baselines': ['solver']})
