"""Experiments as data: which agents are trained, and how they are judged."""

from collections.abc import Iterator, Mapping
from importlib import resources
import os
from typing import Annotated, Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.config import validation
from realab_suite.feedback import specs

_Count = Annotated[int, pydantic.Field(ge=1, le=10**10)]
_Seed = Annotated[int, pydantic.Field(ge=0, lt=2**31)]
_Seeds = Annotated[tuple[_Seed, ...], pydantic.Field(strict=False)]

TWIN = 'secure'
"""What the secure twin of a run is called, and its channel."""

ProbePlayer = Literal['saboteur', 'random']
"""Who gets to the states of a probe: see `probes.make`."""


@final
class RunSpec(validation.Spec):
  """An agent to train.

  Attributes:
    design: The name of a design that ships with the package, or a path.
    overrides: Dotted overrides of it.
    learner: Fields of the design's learner that differ from the design.
    twin: Whether to train it on the design's secure twin as well.
    steps: For how many control steps; `None` takes the experiment's.
  """

  design: option_types.FilePath
  overrides: Annotated[tuple[str, ...], pydantic.Field(strict=False)] = ()
  learner: dict[str, Any] = pydantic.Field(default_factory=dict)
  twin: bool = False
  steps: _Count | None = None

  def load(self, *, is_confined: bool = False) -> specs.DesignSpec:
    """Returns the design, with the changes of the run.

    Args:
      is_confined: True if the design, and files that it names, have to be
        within the working directory.

    Raises:
      SpecError: If the design is not valid.
    """
    design = specs.load(self.design, self.overrides, is_confined=is_confined)
    if not self.learner:
      return design
    own = {} if design.learner is None else design.learner.model_dump()
    return _changed(design, learner={**own, **self.learner})


def secure_twin(design: specs.DesignSpec) -> specs.DesignSpec:
  """Returns a design whose registers nothing can tamper with."""
  return _changed(design, channel=TWIN)


def _changed(design: specs.DesignSpec, **changes: Any) -> specs.DesignSpec:
  # A problem now is one of the run, and the design's file has no part in it.
  changed = loading.read_mapping({**design.to_mapping(), **changes})
  return validation.validate(specs.DesignSpec, changed, '')


@final
class TrainingSpec(validation.Spec):
  """How long agents are trained; lengths are control steps of all worlds.

  Attributes:
    num_envs: How many worlds a learner has.
    steps: How many control steps.
    checkpoint_every: After how many there is a checkpoint.
    curve_every: After how many there is a point of the learning curve.
    sleep: Whether blocks at rest fall asleep. That is faster; who sleeps cannot
      be saved, so at every checkpoint all worlds begin new episodes.
  """

  num_envs: _Count = 256
  steps: _Count = 1_000_000
  checkpoint_every: _Count = 250_000
  curve_every: _Count = 25_000
  sleep: bool = False


@final
class EvaluationSpec(validation.Spec):
  """How a policy is judged, once it has stopped to learn.

  Attributes:
    episodes: How many episodes of each seed.
    seed_offset: What is added to a run's seed for the seed of the episodes, the
      same for all runs, so that they can be compared in pairs.
    actions: Whether actions are drawn from the policy, or are its best ones.
    probe_states: In how many states beside a register a learner is probed, if
      its readings are maximised (`evaluation.incentives`); 0 for no probe.
    probe_player: Who gets to these states.
  """

  episodes: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 100
  seed_offset: Annotated[int, pydantic.Field(ge=0, lt=2**31)] = 1_000_000
  actions: Literal['sampled', 'greedy'] = 'sampled'
  probe_states: Annotated[int, pydantic.Field(ge=0, le=10_000)] = 0
  probe_player: ProbePlayer = 'saboteur'


@final
class ExperimentSpec(validation.Spec):
  """Runs on one task, and what they are compared with.

  Attributes:
    schema_version: The version of this format; `schema` in a file.
    name: The name of the experiment.
    description: What it is, in a sentence.
    task: The world and its variation, as in `unlock_door.near`.
    max_steps: After how many control steps an episode ends.
    runs: Which agents are trained, by name.
    baselines: Scripted policies that act in the design of every run. Runs are
      compared with the first one.
    seeds: Those that are reported.
    calibration_seeds: Those to choose settings with; none of them is reported.
    training: How long agents are trained.
    evaluation: How policies are judged.
  """

  schema_version: Literal[1] = pydantic.Field(alias='schema')
  name: specs.Name
  description: str = ''
  task: Annotated[
      str, pydantic.StringConstraints(pattern=r'^[a-z]\w*\.[a-z]\w*$')
  ]
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
    """Keeps `true` and `1.0`, which Python takes for 1, from being versions."""
    if type(value) is not int:
      raise ValueError('must be 1')
    return value

  @pydantic.field_validator('baselines')
  @classmethod
  def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
      try:
        policies.make(name)
      except errors.SpecError as error:
        raise ValueError(str(error)) from error
    return names

  @pydantic.model_validator(mode='after')
  def _distinct(self) -> 'ExperimentSpec':
    seeds = (*self.seeds, *self.calibration_seeds)
    for what, values in (
        ('baselines', self.baselines),
        ('seeds and calibration_seeds', seeds),
    ):
      twice = sorted({str(v) for v in values if values.count(v) > 1})
      if twice:
        raise ValueError(f'{what}: {", ".join(twice)} is there twice')
    return self

  @property
  def domain_and_variation(self) -> tuple[str, str]:
    """The two names that `suite.load` takes."""
    domain, _, variation = self.task.partition('.')
    return domain, variation


Experiment = str | os.PathLike[str] | Mapping[str, Any] | ExperimentSpec


def load(experiment: Experiment) -> ExperimentSpec:
  """Loads and validates an experiment, and the designs that it names.

  Designs that a file names have to be within the working directory.

  Args:
    experiment: The name of an experiment that ships with the package, a path to
      a YAML file, a mapping, or a spec.

  Raises:
    SpecError: Where the file or key path is wrong, in one line.
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
        f' {list(EXPERIMENTS)}'
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
  for key_path, problem in _problems(spec, is_confined=is_file):
    raise messages.Location(where, key_path).error(problem)
  return spec


def _problems(
    spec: ExperimentSpec, is_confined: bool
) -> Iterator[tuple[tuple[str | int, ...], str]]:
  """Yields where an experiment names what there is not, and what is wrong."""
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
          f'design {design.name!r} is {TWIN} itself; allowed is false',
      )


_FOLDER = resources.files('realab_suite.configs') / 'experiments'
EXPERIMENTS: tuple[str, ...] = tuple(
    sorted(
        path.name.removesuffix('.yaml')
        for path in _FOLDER.iterdir()
        if path.name.endswith('.yaml')
    )
)
"""Names of the experiments that ship with the package."""
