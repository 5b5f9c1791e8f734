"""Specs of experiments: the agents to train, and their evaluation."""

from collections.abc import Iterator, Mapping
import contextlib
from importlib import resources
import os
from typing import Annotated, Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.config import validation
from realab_suite.engine import arguments
from realab_suite.evaluation import actors
from realab_suite.feedback import specs

_Count = Annotated[int, pydantic.Field(ge=1, le=10**10)]
_Seed = Annotated[int, pydantic.Field(ge=0, lt=2**31)]
_Seeds = Annotated[tuple[_Seed, ...], pydantic.Field(strict=False)]


def _refuse_seed(value: dict[str, Any]) -> dict[str, Any]:
  if 'random' in value:
    raise ValueError('random: the seeds of an experiment are its `seeds`')
  return value


_TaskKwargs = Annotated[dict[str, Any], pydantic.AfterValidator(_refuse_seed)]

TWIN = 'secure'
"""Suffix and channel of the secure twin of a run."""


@final
class RunSpec(validation.Spec):
  """An agent to train.

  Attributes:
    design: Name of a design of the package, or path of a YAML file.
    overrides: Dotted overrides of the design.
    learner: Fields that replace those of the learner in the design.
    twin: True to train the secure twin of the design as well.
    steps: Number of control steps, or `None` for that of the experiment.
    num_seeds: Number of seeds, the first ones of the experiment; `None` for all
      of them.
  """

  design: option_types.FilePath
  overrides: Annotated[tuple[str, ...], pydantic.Field(strict=False)] = ()
  learner: dict[str, Any] = pydantic.Field(default_factory=dict)
  twin: bool = False
  steps: _Count | None = None
  num_seeds: _Count | None = None

  def load(self, *, is_confined: bool = False) -> specs.DesignSpec:
    """Returns the design with the changes of this run.

    Args:
      is_confined: True if the design and the files that it names must be within
        the working directory.

    Raises:
      SpecError: If the design is invalid.
    """
    design = specs.load(self.design, self.overrides, is_confined=is_confined)
    if not self.learner:
      return design
    own = {} if design.learner is None else design.learner.model_dump()
    return _changed(design, learner={**own, **self.learner})


def secure_twin(design: specs.DesignSpec) -> specs.DesignSpec:
  """Returns the secure twin of a design."""
  return _changed(design, channel=TWIN)


def _changed(design: specs.DesignSpec, **changes: Any) -> specs.DesignSpec:
  # Problems from here on belong to the run and not to the file of the design.
  changed = loading.read_mapping({**design.to_mapping(), **changes})
  return validation.validate(specs.DesignSpec, changed, '')


@final
class TrainingSpec(validation.Spec):
  """Settings of training. Lengths are control steps summed over all worlds.

  Attributes:
    num_envs: Number of worlds of a learner.
    steps: Number of control steps.
    checkpoint_every: Number of control steps between checkpoints.
    curve_every: Number of control steps between points of the learning curve.
    sleep: True to let blocks at rest sleep, which is faster. Sleeping bodies
      cannot be saved, so all worlds start new episodes at every checkpoint.
    task_kwargs: Arguments of the task that apply in training only, such as
      `starts_beside_registers`.
  """

  num_envs: Annotated[int, pydantic.Field(ge=1, le=arguments.MAX_ENVS)] = 256
  steps: _Count = 1_000_000
  checkpoint_every: _Count = 250_000
  curve_every: _Count = 25_000
  sleep: bool = False
  task_kwargs: _TaskKwargs = pydantic.Field(default_factory=dict)


@final
class EvaluationSpec(validation.Spec):
  """Settings of the evaluation of a policy, without further updates.

  Attributes:
    episodes: Number of episodes per seed.
    seed_offset: Difference between the seed of the episodes and that of the
      run. It is the same for all runs, so their episodes can be paired.
    actions: 'sampled' draws actions from the policy, 'greedy' takes the best.
  """

  episodes: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 100
  seed_offset: Annotated[int, pydantic.Field(ge=0, lt=2**31)] = 1_000_000
  actions: Literal['sampled', 'greedy'] = 'sampled'


@final
class EnvironmentKwargs(validation.Spec):
  """Part of the `environment_kwargs` of `suite.load` that experiments choose.

  Attributes:
    senses: Names of the agent's senses; `None` for the default ones.
  """

  senses: Annotated[tuple[str, ...], pydantic.Field(strict=False)] | None = None


@final
class ExperimentSpec(validation.Spec):
  """Runs on one task, and the baselines they are compared with.

  Attributes:
    schema_version: Version of this format; `schema` in a file.
    name: Name of the experiment.
    description: Description in a sentence.
    task: Domain and task, such as `unlock_door.near`.
    task_kwargs: Arguments of the task, such as `camera_size`.
    environment_kwargs: Arguments of the environment.
    max_steps: Maximum number of control steps of an episode.
    runs: Agents to train, by name.
    baselines: Scripted policies that act in the design of every run. Runs are
      compared with the first one.
    seeds: Seeds of the reported results.
    calibration_seeds: Seeds for choosing settings, which are not reported.
    training: Settings of training.
    evaluation: Settings of the evaluation.
  """

  schema_version: Literal[1] = pydantic.Field(alias='schema')
  name: specs.Name
  description: str = ''
  task: Annotated[
      str, pydantic.StringConstraints(pattern=r'^[a-z]\w*\.[a-z]\w*$')
  ]
  task_kwargs: _TaskKwargs = pydantic.Field(default_factory=dict)
  environment_kwargs: EnvironmentKwargs = EnvironmentKwargs()
  max_steps: _Count = suite.MAX_STEPS
  runs: Annotated[dict[specs.Name, RunSpec], pydantic.Field(min_length=1)]
  baselines: Annotated[
      tuple[specs.Name, ...], pydantic.Field(strict=False)
  ] = ()
  seeds: Annotated[_Seeds, pydantic.Field(min_length=1)]
  calibration_seeds: _Seeds = ()
  training: TrainingSpec = TrainingSpec()
  evaluation: EvaluationSpec = EvaluationSpec()

  @pydantic.field_validator('schema_version', mode='before')
  @classmethod
  def _whole(cls, value: Any) -> Any:
    """Rejects `true` and `1.0`, which are equal to 1 in Python."""
    if type(value) is not int:
      raise ValueError('must be 1')
    return value

  @pydantic.field_validator('baselines')
  @classmethod
  def _check_baselines(cls, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
      try:
        policies.make(name)
      except errors.SpecError as error:
        raise ValueError(str(error)) from error
    return names

  @pydantic.model_validator(mode='after')
  def _check_distinct(self) -> 'ExperimentSpec':
    seeds = (*self.seeds, *self.calibration_seeds)
    for what, values in (
        ('baselines', self.baselines),
        ('seeds and calibration_seeds', seeds),
    ):
      twice = sorted({str(v) for v in values if values.count(v) > 1})
      if twice:
        raise ValueError(f'{what}: {", ".join(twice)} appears twice')
    return self

  @property
  def domain_and_variation(self) -> tuple[str, str]:
    """Names of the domain and of the task, as for `suite.load`."""
    domain, _, variation = self.task.partition('.')
    return domain, variation

  @property
  def world(self) -> worlds.World:
    """World in which policies are evaluated."""
    return worlds.World(
        *self.domain_and_variation,
        self.max_steps,
        self.task_kwargs,
        self.environment_kwargs.senses,
    )

  def on_task(self, task: str) -> 'ExperimentSpec':
    """Returns the same experiment on another task.

    Args:
      task: Domain and task, such as `unlock_door.far`.

    Raises:
      SpecError: If the experiment cannot be run on this task.
    """
    return load({**self.to_mapping(), 'task': task})

  def load_kwargs(
      self, seed: int, *, is_training: bool = False
  ) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns `task_kwargs` and `environment_kwargs` for `suite.load`.

    Args:
      seed: Seed of the worlds.
      is_training: True for the worlds of training, False for evaluation.
    """
    more = self.training.task_kwargs if is_training else {}
    return {**self.task_kwargs, **more, 'random': seed}, {
        'max_steps': self.max_steps,
        **self.environment_kwargs.model_dump(),
    }


Experiment = str | os.PathLike[str] | Mapping[str, Any] | ExperimentSpec


def load(experiment: Experiment) -> ExperimentSpec:
  """Loads and validates an experiment, and the designs that it names.

  The designs that a file names must be within the working directory.

  Args:
    experiment: Name of an experiment of the package, path of a YAML file,
      mapping, or spec.

  Raises:
    SpecError: If it is invalid. The message is one line with the file and the
      key path.
  """
  if isinstance(experiment, ExperimentSpec):
    return experiment
  if isinstance(experiment, str) and experiment in EXPERIMENTS:
    where = f'{experiment}.yaml'
    data = loading.parse_yaml((_FOLDER / where).read_bytes(), where)
  elif not isinstance(experiment, str | os.PathLike | Mapping):
    raise errors.SpecError(
        f'experiment: {experiment!r:.80}; allowed are a name, a path, a mapping'
        ' and an ExperimentSpec'
    )
  elif isinstance(experiment, str) and not os.path.exists(experiment):
    raise errors.UnknownNameError(
        f'experiment {messages.quote(experiment)} is neither a file nor one of'
        f' {list(EXPERIMENTS)}{messages.did_you_mean(experiment, EXPERIMENTS)}'
    )
  else:
    where = (
        'experiment'
        if isinstance(experiment, Mapping)
        else os.fspath(experiment)
    )
    data = loading.read_mapping(experiment)
  is_file = not isinstance(experiment, Mapping)
  spec = validation.validate(ExperimentSpec, data, where, is_confined=is_file)
  for key_path, problem in _find_problems(spec, is_confined=is_file):
    raise messages.Location(where, key_path).error(problem)
  return spec


def _find_problems(
    spec: ExperimentSpec, is_confined: bool
) -> Iterator[tuple[tuple[str | int, ...], str]]:
  """Yields the key path and a description of each problem."""
  try:
    suite.dynamics(*spec.domain_and_variation)
  except errors.UnknownNameError as error:
    yield ('task',), str(error)
  for name, run in spec.runs.items():
    try:
      design = run.load(is_confined=is_confined)
    except errors.SpecError as error:
      yield ('runs', name), str(error)
      continue
    if design.learner is None:
      yield (
          ('runs', name, 'learner'),
          f'design {design.name!r} has no learner; allowed is a mapping with'
          ' its kind',
      )
    if run.twin and design.channel == TWIN:
      yield (
          ('runs', name, 'twin'),
          f'design {design.name!r} is {TWIN} already; allowed is false',
      )
    if (
        spec.task_kwargs
        or spec.training.task_kwargs
        or spec.environment_kwargs != EnvironmentKwargs()
    ):
      try:
        _check_world(spec, design)
      except errors.SpecError as error:
        yield ('runs', name), str(error)


def _check_world(spec: ExperimentSpec, design: specs.DesignSpec) -> None:
  """Checks that the world of a run can be loaded, and its policies can act.

  Raises:
    SpecError: If not.
  """
  task = spec.domain_and_variation
  suite.load(
      *task, *spec.load_kwargs(0, is_training=True), design=design
  ).close()
  with contextlib.closing(
      suite.load(*task, *spec.load_kwargs(0), design=design)
  ) as env:
    for name in spec.baselines:
      actors.check_senses(policies.make(name), env)


_FOLDER = resources.files('realab_suite.configs') / 'experiments'
EXPERIMENTS: tuple[str, ...] = tuple(
    sorted(
        path.name.removesuffix('.yaml')
        for path in _FOLDER.iterdir()
        if path.name.endswith('.yaml')
    )
)
"""Names of the experiments that are part of the package."""
