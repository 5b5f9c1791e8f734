"""Jobs: an experiment, taken apart into runs that do not know of each other.

A job is one run of one seed: a learner that is trained and then judged, or a
scripted policy that is judged alike. Its configuration says everything that its
results depend on, and its folder is named after a hash of it.
"""

from collections.abc import Mapping, Sequence
import dataclasses
from importlib import metadata
import pathlib
from typing import Any, final

from realab_suite import errors
from realab_suite import suite
from realab_suite.config import validation
from realab_suite.evaluation import results
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import storage
from realab_suite.feedback import specs

_SCHEMA = 1
# What learners are made of; results depend on it where it is installed.
_LEARNERS_DEPEND_ON = ('jax', 'jaxlib', 'equinox', 'optax')
_NUM_DIGITS = 12


@final
@dataclasses.dataclass(frozen=True)
class Job:
  """One run of one seed.

  Attributes:
    run: The name of the run: that of the experiment, with `.secure` for its
      twin, and with `.<policy>` for a baseline in the same design.
    seed: The seed.
    policy: The scripted policy, or `None` for a learner.
    design: The design, with all that the run changes.
    baseline: The run to compare with, or `None`.
    twin_of: The run that this is the secure twin of, or `None`.
    dynamics: The version and the golden digest of the world's dynamics.
    experiment: What it is part of.
  """

  run: str
  seed: int
  policy: str | None
  design: specs.DesignSpec
  baseline: str | None
  twin_of: str | None
  dynamics: tuple[int, str | None]
  experiment: experiment_specs.ExperimentSpec

  @property
  def kind(self) -> str:
    """What acts: the kind of the learner, or the policy."""
    if self.policy is not None:
      return self.policy
    if self.design.learner is None:
      raise errors.SpecError(f'run {self.run!r}: its design has no learner')
    return self.design.learner.kind

  @property
  def training(self) -> experiment_specs.TrainingSpec:
    """How long it is trained, if it learns."""
    name, _, _ = self.run.partition('.')
    training = self.experiment.training
    steps = self.experiment.runs[name].steps
    if steps is None:
      return training
    return training.model_copy(update={'steps': steps})

  @property
  def evaluation_seed(self) -> int:
    """The seed of the episodes that the policy is judged by."""
    return self.seed + self.experiment.evaluation.seed_offset

  def config(self) -> dict[str, Any]:
    """Returns everything that the results depend on, as plain data."""
    experiment = self.experiment
    version, digest = self.dynamics
    depends_on = results.versions()
    del depends_on['python']
    config = {
        'schema': _SCHEMA,
        'run': self.run,
        'seed': self.seed,
        'task': experiment.task,
        'dynamics': {'version': version, 'digest': digest},
        'max_steps': experiment.max_steps,
        'design': self.design.to_mapping(),
        'policy': self.policy,
        'baseline': self.baseline,
        'twin_of': self.twin_of,
        'evaluation': experiment.evaluation.model_dump(),
        'versions': depends_on,
    }
    if self.policy is None:
      config['training'] = self.training.model_dump()
      depends_on.update(_installed(_LEARNERS_DEPEND_ON))
    return config

  def digest(self) -> str:
    """Returns a hash of the configuration."""
    return digest_of(self.config())

  def folder(self) -> str:
    """Returns the name of the folder of the results."""
    return f'{self.run}-{self.seed}-{self.digest()}'

  def info(self, control_timestep: float) -> results.RunInfo:
    """Returns what the rows of its episodes have in common."""
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
  """Returns the hash of a configuration that ends the name of a folder."""
  return validation.digest_of(config)[:_NUM_DIGITS]


def read_config(folder: pathlib.Path) -> dict[str, Any]:
  """Returns the configuration that the folder of a job is named after.

  Raises:
    ResultsError: If it cannot be read, or is another one.
  """
  path = folder / storage.CONFIG
  config = storage.read_json(path)
  is_one = isinstance(config, dict)
  if not is_one or not folder.name.endswith(f'-{digest_of(config)}'):
    raise errors.ResultsError(
        f'{path}: not the configuration that the folder is named after; remove'
        f' {folder} to run it again'
    )
  found: dict[str, Any] = config
  return found


def is_done(folder: pathlib.Path) -> bool:
  """Returns whether the job of a folder is over.

  Raises:
    ResultsError: If a result or the configuration has been changed or removed
      since.
  """
  if not storage.is_done(folder):
    return False
  read_config(folder)
  return True


def plan(
    experiment: experiment_specs.ExperimentSpec,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] = (),
) -> list[Job]:
  """Returns the jobs of an experiment, seed by seed.

  Args:
    experiment: The experiment.
    seeds: The seeds; `None` for those that the experiment reports.
    only: The names of the runs to keep, as `Job.run` has them; none for all.

  Raises:
    SpecError: If there is no such run.
  """
  variants = [
      variant
      for name, run in experiment.runs.items()
      for variant in _variants(experiment, name, run)
  ]
  names = [run for run, *_ in variants]
  if unknown := sorted(set(only) - set(names)):
    raise errors.UnknownNameError(
        f'experiment {experiment.name!r} has no run {unknown[0]!r}; it has'
        f' {names}'
    )
  dynamics = suite.dynamics(*experiment.domain_and_variation)
  return [
      Job(run, seed, policy, design, baseline, twin_of, dynamics, experiment)
      for seed in (experiment.seeds if seeds is None else seeds)
      for run, policy, design, baseline, twin_of in variants
      if not only or run in only
  ]


_Variant = tuple[str, str | None, specs.DesignSpec, str | None, str | None]


def _variants(
    experiment: experiment_specs.ExperimentSpec,
    name: str,
    run: experiment_specs.RunSpec,
) -> list[_Variant]:
  """Returns the jobs of a run but for their seeds: baselines come first."""
  design = run.load()
  scripted = [f'{name}.{policy}' for policy in experiment.baselines]
  baseline = scripted[0] if scripted else None
  variants: list[_Variant] = [
      (
          one,
          policy,
          design,
          baseline if one != baseline else None,
          None,
      )
      for one, policy in zip(scripted, experiment.baselines, strict=True)
  ]
  variants.append((name, None, design, baseline, None))
  if run.twin:
    twin = experiment_specs.secure_twin(design)
    variants.append(
        (f'{name}.{experiment_specs.TWIN}', None, twin, baseline, name)
    )
  return variants


def _installed(names: Sequence[str]) -> dict[str, str]:
  """Returns the versions of what is installed, without importing it."""
  versions = {}
  for name in names:
    try:
      versions[name] = metadata.version(name)
    except metadata.PackageNotFoundError:
      continue
  return versions
