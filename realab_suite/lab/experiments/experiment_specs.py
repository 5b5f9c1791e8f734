"""Specs of experiments: the agents to train, and their evaluation."""

from collections.abc import Mapping
import contextlib
import dataclasses
from typing import Annotated, Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.config import documents
from realab_suite.config import loading
from realab_suite.config import option_types
from realab_suite.config import task_names
from realab_suite.config import validation
from realab_suite.engine import arguments
from realab_suite.evaluation import actors
from realab_suite.feedback import specs
from realab_suite.tasks import registry

_Count = Annotated[int, pydantic.Field(ge=1, le=10**10)]
_Seed = Annotated[int, pydantic.Field(ge=0, lt=2**31)]
_Seeds = Annotated[tuple[_Seed, ...], pydantic.Field(strict=False)]


def _refuse_seed(value: dict[str, Any]) -> dict[str, Any]:
  if 'random' in value:
    raise ValueError('random: the seeds of an experiment are its `seeds`')
  return value


_TaskKwargs = Annotated[dict[str, Any], pydantic.AfterValidator(_refuse_seed)]


def _known_task(task: str) -> str:
  suite.dynamics(*task_names.split(task))
  return task


_Task = Annotated[
    str,
    pydantic.StringConstraints(pattern=r'^[a-z]\w*\.[a-z]\w*$'),
    pydantic.AfterValidator(_known_task),
]


def _known_policies(names: tuple[str, ...]) -> tuple[str, ...]:
  for name in names:
    if name != SOLVER:
      policies.make(name)
  return names


_Baselines = Annotated[
    tuple[specs.Name, ...],
    pydantic.Field(strict=False),
    pydantic.AfterValidator(_known_policies),
]

TWIN = 'secure'
"""Suffix and channel of the secure twin of a run."""

SOLVER = 'solver'
"""Name, among the baselines, of the policy that solves the task of a run."""


@final
class RunSpec(validation.Spec):
  """An agent to train.

  Attributes:
    design: Name of a design of the package, path of a YAML file, or its
      contents.
    overrides: Dotted overrides of the design.
    learner: Fields that replace those of the learner in the design.
    twin: True to train the secure twin of the design as well.
    steps: Number of control steps, or `None` for that of the experiment.
    num_seeds: Number of seeds, the first ones of the experiment; `None` for all
      of them.
    task: Domain and task, or `None` for that of the experiment.
    training: Fields that replace those of the section `training` of the
      experiment, such as `task_kwargs`.
    data: Folder of an export (`realab export`) whose episodes the learner is
      trained from, without acting; `None` if it acts. `steps` are then recorded
      control steps.
    twin_data: The same for the twin, recorded in the secure channel.
    baselines: Scripted policies that act in the design of this run, besides
      those of the experiment.
  """

  design: option_types.FilePath | dict[str, Any]
  overrides: Annotated[tuple[str, ...], pydantic.Field(strict=False)] = ()
  learner: dict[str, Any] = pydantic.Field(default_factory=dict)
  twin: bool = False
  steps: _Count | None = None
  num_seeds: _Count | None = None
  task: _Task | None = None
  training: dict[str, Any] = pydantic.Field(default_factory=dict)
  data: option_types.FilePath | None = None
  twin_data: option_types.FilePath | None = None
  baselines: _Baselines = ()

  @pydantic.model_validator(mode='after')
  def _check_data(self) -> 'RunSpec':
    needed = self.twin and self.data is not None
    if needed != (self.twin_data is not None):
      raise ValueError(
          'twin_data: goes with data and twin; give all three, data'
          ' alone, or neither'
      )
    return self

  def load(self) -> specs.DesignSpec:
    """Returns the design with the changes of this run.

    Raises:
      SpecError: If the design is invalid.
    """
    design = specs.load(self.design, self.overrides)
    if not self.learner:
      return design
    learner = {} if design.learner is None else design.learner.model_dump()
    changed = {**design.to_source(), 'learner': {**learner, **self.learner}}
    # Problems from here on belong to the run and not to the file of the design.
    return validation.validate(
        specs.DesignSpec, loading.read_mapping(changed), ''
    )


def secure_twin(design: specs.DesignSpec) -> specs.DesignSpec:
  """Returns the secure twin of a design."""
  return specs.load(design, (f'channel={TWIN}',))


@final
class TrainingSpec(validation.Spec):
  """Settings of training. Lengths are control steps summed over all worlds.

  Attributes:
    num_envs: Number of worlds of a learner.
    steps: Number of control steps.
    checkpoint_every: Number of control steps between checkpoints, at which all
      worlds begin new episodes.
    curve_every: Number of control steps between points of the learning curve.
    sleep: True to let blocks at rest sleep, which is faster.
    task_kwargs: Arguments of the task that apply in training only, such as
      `starts_beside_registers`.
    stagger: True to cut some first episodes, so that worlds are in different
      steps of their episodes; those that are cut count nowhere.
    tasks: Tasks to train on instead of the judged one: the next of them from
      each checkpoint on, in turn. Their domain is that of the judged task, and
      none of them is held out.
    adaptation: Number of control steps for which the learner goes on learning
      in the judged task, after `steps` in these tasks.
  """

  num_envs: Annotated[int, pydantic.Field(ge=1, le=arguments.MAX_ENVS)] = 256
  steps: _Count = 1_000_000
  checkpoint_every: _Count = 250_000
  curve_every: _Count = 25_000
  sleep: bool = False
  task_kwargs: _TaskKwargs = pydantic.Field(default_factory=dict)
  stagger: bool = False
  tasks: Annotated[tuple[_Task, ...], pydantic.Field(strict=False)] = ()
  adaptation: _Count | None = None

  def to_mapping(self) -> dict[str, Any]:
    mapping = super().to_mapping()
    # The names of folders depend on it, and stay what they were without it.
    if not self.stagger:
      del mapping['stagger']
    return mapping

  @pydantic.model_validator(mode='after')
  def _check_tasks(self) -> 'TrainingSpec':
    if bool(self.tasks) != (self.adaptation is not None):
      raise ValueError(
          'tasks and adaptation belong together; give both or neither'
      )
    if twice := sorted({t for t in self.tasks if self.tasks.count(t) > 1}):
      raise ValueError(f'tasks: {", ".join(twice)} appears twice')
    return self


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
      compared with the first one. `solver` is the solver of the task.
    seeds: Seeds of the reported results.
    calibration_seeds: Seeds for choosing settings, which are not reported.
    training: Settings of training.
    evaluation: Settings of the evaluation.
  """

  schema_version: validation.Schema = pydantic.Field(alias='schema')
  name: specs.Name
  description: str = ''
  task: _Task
  task_kwargs: _TaskKwargs = pydantic.Field(default_factory=dict)
  environment_kwargs: EnvironmentKwargs = EnvironmentKwargs()
  max_steps: _Count = suite.MAX_STEPS
  runs: Annotated[dict[specs.Name, RunSpec], pydantic.Field(min_length=1)]
  baselines: _Baselines = ()
  seeds: Annotated[_Seeds, pydantic.Field(min_length=1)]
  calibration_seeds: _Seeds = ()
  training: TrainingSpec = TrainingSpec()
  evaluation: EvaluationSpec = EvaluationSpec()

  _designs: dict[str, specs.DesignSpec] = pydantic.PrivateAttr(
      default_factory=dict
  )

  @pydantic.field_validator('task_kwargs')
  @classmethod
  def _check_starts(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
    if 'starts_on_the_way' in kwargs:
      raise ValueError(
          'starts_on_the_way: must be in training.task_kwargs, because'
          ' evaluation has no such starts'
      )
    return kwargs

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

  @pydantic.model_validator(mode='after')
  def _check_runs(self) -> 'ExperimentSpec':
    checked: list[Any] = []
    for name, run in self.runs.items():
      acting = (*self.baselines, *run.baselines)
      if twice := [one for one in run.baselines if acting.count(one) > 1]:
        raise ValueError(
            f'runs.{name}.baselines: {twice[0]} appears twice, here or among'
            ' the baselines of all runs'
        )
      try:
        design = self.of_run(run)._fitted(run.load())
        # What learns in a world is no part of it.
        fixed = design.model_copy(update={'learner': None})
        world = run.task, run.training, run.baselines, fixed
        if world not in checked:
          self.of_run(run)._check_world(design)
          checked.append(world)
      except errors.SpecError as error:
        raise ValueError(f'runs.{name}: {error}') from error
      if design.learner is None:
        raise ValueError(
            f'runs.{name}.learner: design {design.name!r} has no learner;'
            ' give a mapping with its kind'
        )
      if run.data is not None and self.training.tasks:
        raise ValueError(
            f'runs.{name}.data: recorded episodes are those of one task;'
            ' allowed with it is a section training without tasks'
        )
      if run.twin and design.channel == TWIN:
        raise ValueError(
            f'runs.{name}.twin: design {design.name!r} is {TWIN} already;'
            ' must be false'
        )
      self._designs[name] = design
    for task in self.training.tasks:
      if registry.HELD_OUT in registry.tags(*task_names.split(task)):
        raise ValueError(
            f'training.tasks: {task} is held out; must be a task that'
            f' lacks the tag {registry.HELD_OUT!r}, which is for judging'
        )
    return self

  def _fitted(self, design: specs.DesignSpec) -> specs.DesignSpec:
    """Returns a design with ranges for the tasks that it is used in."""
    others = [self.at(task).world for task in self.training.tasks]
    return self.world.fitted(design, *others)

  def _check_world(self, design: specs.DesignSpec) -> None:
    """Checks that the world of a run can be loaded, and its policies can act.

    A world with the default arguments is not loaded.

    Raises:
      SpecError: If not.
    """
    scripted = self.scripted
    is_default = (
        not self.task_kwargs and self.environment_kwargs == EnvironmentKwargs()
    )
    if is_default and not self.training.tasks and not self.training.task_kwargs:
      return
    with contextlib.closing(self.training_world.load(design, 0)) as env:
      judged = env.observation_spec(), env.action_spec()
    domain, _ = self.domain_and_variation
    for task in self.training.tasks:
      if task == self.task or task_names.split(task)[0] != domain:
        raise errors.SpecError(
            f'training.tasks: {task}; must be a task of {domain} other than'
            f' {self.task}, which is judged'
        )
      with contextlib.closing(
          self.at(task).training_world.load(design, 0)
      ) as env:
        if (env.observation_spec(), env.action_spec()) != judged:
          raise errors.SpecError(
              f'training.tasks: {task} has other observations or actions than'
              f' {self.task}; must have the same'
          )
    if is_default:
      return
    with contextlib.closing(self.world.load(design, 0)) as env:
      for policy in scripted.values():
        actors.PrivilegedSenses(policies.make(policy), env)

  @property
  def designs(self) -> Mapping[str, specs.DesignSpec]:
    """Designs of the runs with their changes, by the name of the run."""
    return self._designs

  def to_copy(self) -> dict[str, Any]:
    """Returns the experiment with its designs in place of their files."""
    data = self.to_mapping()
    for name, design in self.designs.items():
      changes = {'design': design.to_source(), 'overrides': [], 'learner': {}}
      data['runs'][name] |= changes
    return data

  @property
  def domain_and_variation(self) -> tuple[str, str]:
    """Names of the domain and of the task, as for `suite.load`."""
    return task_names.split(self.task)

  @property
  def world(self) -> worlds.World:
    """World in which policies are evaluated."""
    return worlds.World(
        *self.domain_and_variation,
        self.max_steps,
        self.task_kwargs,
        self.environment_kwargs.senses,
    )

  @property
  def training_world(self) -> worlds.World:
    """World in which learners are trained."""
    kwargs = {**self.task_kwargs, **self.training.task_kwargs}
    return dataclasses.replace(self.world, task_kwargs=kwargs)

  @property
  def scripted(self) -> dict[str, str]:
    """Names of the policies of the baselines, by the names of the baselines.

    Raises:
      SpecError: If the solver is a baseline, and the task has none.
    """
    solver = self.world.solver
    if SOLVER in self.baselines and solver is None:
      raise errors.SpecError(
          f'baselines: {SOLVER}: {self.task} names no solver; name other'
          ' registered policies'
      )
    return {
        name: solver if name == SOLVER and solver else name
        for name in self.baselines
    }

  def of_run(self, run: RunSpec) -> 'ExperimentSpec':
    """Returns the same experiment with the task and the training of a run.

    Args:
      run: One of the runs.

    Raises:
      SpecError: If its training is invalid.
    """
    experiment = self if run.task is None else self.at(run.task)
    changes: dict[str, Any] = {}
    if run.baselines:
      changes['baselines'] = (*self.baselines, *run.baselines)
    if run.training:
      changed = {**self.training.to_mapping(), **run.training}
      changes['training'] = validation.validate(
          TrainingSpec, loading.read_mapping(changed), 'training'
      )
    return experiment.model_copy(update=changes)

  def at(self, task: str) -> 'ExperimentSpec':
    """Returns the same experiment on another task, without checks."""
    return self.model_copy(update={'task': task})

  def on_task(self, task: str) -> 'ExperimentSpec':
    """Returns the same experiment on another task.

    Args:
      task: Domain and task, such as `unlock_door.far`.

    Raises:
      SpecError: If the experiment cannot be run on this task, or runs have
        tasks of their own.
    """
    for name, run in self.runs.items():
      if run.task is not None:
        raise errors.SpecError(
            f'runs.{name}.task: {run.task}; another task is allowed only if no'
            ' run has one of its own'
        )
    return load({**self.to_mapping(), 'task': task})


Experiment = documents.Source | ExperimentSpec

_DOCUMENTS = documents.Documents('experiment', ExperimentSpec, 'experiments')

EXPERIMENTS = _DOCUMENTS.names
"""Names of the experiments that are part of the package."""


def load(experiment: Experiment) -> ExperimentSpec:
  """Loads and validates an experiment, and the designs that it names.

  Args:
    experiment: Name of an experiment of the package, path of a YAML file,
      mapping, or spec.

  Raises:
    SpecError: If it is invalid. The message is one line with the file and the
      key path.
    UnknownNameError: If there is no experiment or file of this name.
  """
  return _DOCUMENTS.load(experiment)
