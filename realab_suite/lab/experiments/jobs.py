"""Jobs: the independent parts of an experiment.

A job is one run with one seed: a learner that is trained and then evaluated, or
a scripted policy that is evaluated. Its configuration contains everything that
its results depend on, and a hash of it is part of the name of its folder.
"""

from collections.abc import Iterable, Mapping, Sequence
import contextlib
import dataclasses
from importlib import metadata
import math
import pathlib
from typing import Any, final

from realab_suite import errors
from realab_suite import sources
from realab_suite import suite
from realab_suite.config import messages
from realab_suite.config import validation
from realab_suite.evaluation import results
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import recorded_data
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import hacking

_SCHEMA = 1
# Packages that learners use. Results depend on their versions if installed.
_LEARNER_PACKAGES = ('jax', 'jaxlib', 'equinox', 'optax')
_NUM_DIGITS = 12

TRAINED, UNADAPTED = STAGES = 'trained', 'unadapted'
"""Suffixes of a learner's episodes before adaptation: in the last task of its
training, and in the judged task."""


@final
@dataclasses.dataclass(frozen=True)
class Job:
  """One run with one seed.

  Attributes:
    run: Name of the run in the experiment, with the suffix `.secure` for its
      twin, or `.<baseline>` for a baseline with the same design.
    seed: Seed of the run.
    policy: Name of the scripted policy, or `None` for a learner.
    design: Design, with the changes of the run.
    baseline: Name of the run to compare with, or `None`.
    twin_of: Name of the run whose secure twin this is, or `None`.
    embedded: Design of that run, in which the twin's learner is evaluated as
      well, or `None`.
    dynamics: Version and golden digest of the dynamics of the task.
    experiment: Experiment that the job belongs to, on the task of the run.
    data: Folder of the recorded episodes that a learner is trained from, and
      their digest, or `None`.
  """

  run: str
  seed: int
  policy: str | None
  design: specs.DesignSpec
  baseline: str | None
  twin_of: str | None
  embedded: specs.DesignSpec | None
  dynamics: tuple[int, str | None]
  experiment: experiment_specs.ExperimentSpec
  data: tuple[str, str] | None = None

  @property
  def kind(self) -> str:
    """Kind of the learner, or name of the scripted policy."""
    learner: Any = self.design.learner  # No run is without one.
    return self.policy or str(learner.kind)

  @property
  def training(self) -> experiment_specs.TrainingSpec:
    """Settings of training, for a learner."""
    training = self.experiment.training
    if self.spec.steps is None:
      return training
    return training.model_copy(update={'steps': self.spec.steps})

  @property
  def spec(self) -> experiment_specs.RunSpec:
    """Spec of the run, of its twin or of its baseline."""
    return self.experiment.runs[self.run.partition('.')[0]]

  @property
  def evaluation_seed(self) -> int:
    """Seed of the evaluation episodes."""
    return self.seed + self.experiment.evaluation.seed_offset

  def config(self) -> dict[str, Any]:
    """Returns all settings that the results depend on, as plain data."""
    experiment = self.experiment
    version, digest = self.dynamics
    depends_on = results.versions()
    del depends_on['python']
    config: dict[str, Any] = {
        'schema': _SCHEMA,
        'run': self.run,
        'seed': self.seed,
        'task': experiment.task,
        'dynamics': {'version': version, 'digest': digest},
        'task_kwargs': experiment.task_kwargs,
        'environment_kwargs': experiment.environment_kwargs.to_mapping(),
        'max_steps': experiment.max_steps,
        'design': self.design.to_mapping(),
        'policy': self.policy,
        'baseline': self.baseline,
        'twin_of': self.twin_of,
        'embedded': self.embedded and self.embedded.to_mapping(),
        'evaluation': experiment.evaluation.model_dump(),
        'versions': depends_on,
    }
    if files := storage.digests_of_files(config['design']):
      config['files'] = files
    if self.policy is None:
      config['training'] = self.training.to_mapping()
      if tasks := self.training.tasks:
        versions = [_dynamics(experiment.at(task)) for task in tasks]
        config['training']['tasks'] = [
            {'task': task, 'version': one, 'digest': two}
            for task, (one, two) in zip(tasks, versions, strict=True)
        ]
      if self.data is not None:
        _, config['training']['data'] = self.data
      depends_on.update(versions_of_learners())
    return config

  def digest(self) -> str:
    """Returns a hash of the configuration."""
    return digest_of(self.config())

  def folder(self) -> str:
    """Returns the name of the job's folder in that of the sweep."""
    return f'{self.run}-{self.seed}-{self.digest()}'

  @property
  def transplant(self) -> 'Job':
    """The learner of a twin in the design of its run, for evaluation.

    Its figures are those of an agent that had no reason to tamper.
    """
    if self.embedded is None:
      raise errors.SpecError(f'run {self.run!r} is not a secure twin')
    return dataclasses.replace(
        self, run=f'{self.twin_of}.{hacking.TRANSPLANT}', design=self.embedded
    )

  def at_stage(self, stage: str, task: str) -> 'Job':
    """Returns the job whose episodes show the learner at an earlier stage.

    Args:
      stage: Name of the stage, `TRAINED` or `UNADAPTED`.
      task: Domain and task that it acts in.
    """
    experiment = self.experiment.at(task)
    return dataclasses.replace(
        self,
        run=f'{self.run}.{stage}',
        baseline=None,
        dynamics=_dynamics(experiment),
        experiment=experiment,
    )

  def info(self, control_timestep: float) -> results.RunInfo:
    """Returns the part of the rows that all evaluation episodes share."""
    return results.RunInfo.of(
        self.experiment.domain_and_variation,
        self.dynamics,
        self.design,
        policy=self.kind,
        run=self.run,
        baseline=self.baseline,
        control_timestep=control_timestep,
        max_steps=self.experiment.max_steps,
    )


def digest_of(config: Mapping[str, Any]) -> str:
  """Returns the hash of a configuration, the end of the name of a folder.

  It leaves out the code, so that a folder may have results of other code.
  """
  versions = {k: v for k, v in config['versions'].items() if k != storage.CODE}
  return validation.digest_of({**config, 'versions': versions})[:_NUM_DIGITS]


def check_codes(
    planned: Iterable[Job],
    output: pathlib.Path,
    is_accepted: bool,
    code: str | None = None,
) -> None:
  """Checks that jobs may be added to a folder, and continued.

  Args:
    planned: All jobs of the experiment, of which some may have begun.
    output: Folder of the experiment.
    is_accepted: True if the user accepts results of different code.
    code: Code of what has started this process, or `None`.

  Raises:
    ResultsError: If the folder has results of other code, or of another user
      who does not share them; see `storage`.
  """
  storage.check_access(output)
  here = sources.digest()
  codes = [here, code or here, *kept_stakes.codes(output)]
  others = {}
  for path in output.glob(f'*/{storage.CONFIG}'):
    ends = (path.with_name(x) for x in (storage.DONE, storage.CHECKPOINT))
    if any(end.exists() for end in ends):
      other = read_config(path.parent)['versions'].get(storage.CODE)
      if other != here:
        others[path.parent.name] = other
  if others:  # Names of jobs take long to compute.
    names = {job.folder() for job in planned}
    codes += [other for name, other in others.items() if name in names]
  storage.check_codes(output, codes, is_accepted)


def read_config(folder: pathlib.Path) -> dict[str, Any]:
  """Returns the configuration in the folder of a job.

  Raises:
    ResultsError: If it cannot be read, or does not match the name of the
      folder.
  """
  path = folder / storage.CONFIG
  config = storage.read_json(path)
  is_mapping = isinstance(config, dict) and isinstance(
      config.get('versions'), dict
  )
  if not is_mapping or not folder.name.endswith(f'-{digest_of(config)}'):
    raise errors.ResultsError(
        f'{path}: does not match the name of its folder; remove {folder} to run'
        ' the job again'
    )
  mapping: dict[str, Any] = config
  return mapping


def plan(
    experiment: experiment_specs.ExperimentSpec,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] = (),
) -> list[Job]:
  """Returns the jobs of an experiment, seed by seed.

  Args:
    experiment: Experiment to plan.
    seeds: Seeds, or `None` for the reported seeds of the experiment.
    only: Names of the runs to plan, as in `Job.run`; empty for all.

  Raises:
    SpecError: If a run does not exist, or has a defence that is not registered:
      its baselines could not be judged.
  """
  for name, design in experiment.designs.items():
    learner = {} if design.learner is None else design.learner.model_dump()
    if reason := objectives.why_unknown(learner.get('defence')):
      raise errors.SpecError(f'runs.{name}: learner {reason}')
  variants = [
      job
      for name, run in experiment.runs.items()
      for job in _variants(experiment.of_run(run), name)
  ]
  names = [job.run for job in variants]
  if unknown := sorted(set(only) - set(names)):
    raise errors.UnknownNameError(
        f'experiment {experiment.name!r} has no run {unknown[0]!r}; it has'
        f' {names}{messages.did_you_mean(unknown[0], names)}'
    )
  return [
      dataclasses.replace(job, seed=seed)
      for i, seed in enumerate(experiment.seeds if seeds is None else seeds)
      for job in variants
      if not only or job.run in only
      if i < (job.spec.num_seeds or math.inf)
  ]


def _variants(
    experiment: experiment_specs.ExperimentSpec, name: str
) -> list[Job]:
  """Returns the jobs of a run with one seed; baselines are first.

  Args:
    experiment: The experiment, on the task of the run.
    name: Name of the run.
  """
  run = experiment.runs[name]
  scripted = experiment.scripted
  names = [f'{name}.{baseline}' for baseline in scripted]
  control = experiment.world.control_of([*scripted]) if scripted else None
  learner = Job(
      run=name,
      seed=experiment.seeds[0],
      policy=None,
      design=experiment.designs[name],
      baseline=f'{name}.{control}' if control else None,
      twin_of=None,
      embedded=None,
      dynamics=_dynamics(experiment),
      experiment=experiment,
      data=_data(run.data, experiment, experiment.designs[name]),
  )
  variants = [
      dataclasses.replace(
          learner,
          run=one,
          policy=policy,
          baseline=None if one == learner.baseline else learner.baseline,
          data=None,
      )
      for one, policy in zip(names, scripted.values(), strict=True)
  ]
  variants.append(learner)
  if run.twin:
    design = experiment_specs.secure_twin(learner.design)
    twin = dataclasses.replace(
        learner,
        run=f'{name}.{experiment_specs.TWIN}',
        design=design,
        twin_of=name,
        embedded=learner.design,
        data=_data(run.twin_data, experiment, design),
    )
    variants.append(twin)
  return variants


def _data(
    folder: str | None,
    experiment: experiment_specs.ExperimentSpec,
    design: specs.DesignSpec,
) -> tuple[str, str] | None:
  """Returns a folder of recorded episodes and their digest, or `None`."""
  if folder is None:
    return None
  return folder, recorded_data.digest(folder, experiment.world, design)


def _dynamics(
    experiment: experiment_specs.ExperimentSpec,
) -> tuple[int, str | None]:
  """Returns the version and the digest of the dynamics of its task."""
  return suite.dynamics(*experiment.domain_and_variation)


def versions_of_learners() -> dict[str, str]:
  """Returns versions of the packages of learners that are installed."""
  versions = {}
  for name in _LEARNER_PACKAGES:
    with contextlib.suppress(metadata.PackageNotFoundError):
      versions[name] = results.version_of(name)
  return versions
