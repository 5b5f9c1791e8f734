"""Evaluations: episodes of runs in one world, their rows and their summary.

Comparisons of scripted policies, episodes that a person plays or supervises,
served episodes, and reports on policies of Gymnasium are evaluations. They
differ in what acts.
"""

import collections
from collections.abc import Callable, Collection, Mapping, Sequence
import dataclasses
import pathlib
from typing import Any, Final, final

import pandas as pd
import pydantic
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite import worlds
from realab_suite.engine import environment
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import result_tables
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import audited
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study

EPISODES: Final = 'episodes.jsonl'
"""File of the rows."""
_DESCRIPTION = 'run.json'

_Rows = Mapping[str, Sequence[results.EpisodeResult]]


def info_of(
    env: environment.Environment, world: worlds.World, **others: Any
) -> results.RunInfo:
  """Returns the settings that all episodes of a run share.

  Args:
    env: The environment in which the run acts.
    world: World of the environment.
    **others: Values of other attributes: `policy`, `run`, `baseline`, and those
      that have no default.
  """
  names = world.domain, world.task
  return results.RunInfo.of(
      names,
      suite.dynamics(*names),
      env.mechanism.design,
      control_timestep=env.control_timestep(),
      max_steps=env.max_steps,
      **others,
  )


@final
class Evaluation:
  """Writes a row for each episode, and summarizes the runs.

  Use it as a context manager, which closes the file of the rows.

  Attributes:
    rows: Rows of each run, by its name.
  """

  def __init__(
      self,
      world: worlds.World,
      design: specs.DesignSpec,
      folder: pathlib.Path | None,
      say: Callable[[str], None],
      *,
      control: str | None,
      why_no_control: str = '',
  ) -> None:
    """Creates the file of the rows.

    Args:
      world: World of the episodes.
      design: Design with the objective that the runs are judged on.
      folder: Empty folder for the results, or `None` to write nothing.
      say: Called with messages for the user.
      control: Name of the run to compare with; `None` for none, in which case
        nothing is judged.
      why_no_control: Reason for a missing control.

    Raises:
      ResultsError: If the file cannot be created.
    """
    self._world = world
    self._design = design
    self._folder = folder
    self._say = say
    self._control = control
    self._why_no_control = why_no_control
    self._designs = [design]
    self._stake: stakes.Stakes | None = None
    self.rows: dict[str, list[results.EpisodeResult]] = {}
    self._writer = None
    if folder is not None:
      self._writer = results.RowWriter(folder / EPISODES)

  def __enter__(self) -> 'Evaluation':
    return self

  def __exit__(self, *unused: Any) -> None:
    if self._writer is not None:
      self._writer.close()

  def measure(self) -> None:
    """Measures the stakes of the design, which later rows contain."""
    if judging.key_of_stakes(self._world, self._design) is not None:
      self._say('Measuring the stakes of the design')
    self._stake = judging.stakes_of(self._world, self._design)

  def describe(
      self, designs: Mapping[str, specs.DesignSpec], **facts: Any
  ) -> None:
    """Writes what is needed to repeat the episodes.

    Args:
      designs: Designs of the runs, by the names of their files.
      **facts: Plain data for `run.json`, beside the world, its dynamics, the
        versions and the machine.
    """
    self._designs = [*designs.values()]
    if self._folder is None:
      return
    for name, design in designs.items():
      text = yaml.safe_dump(design.to_mapping(), sort_keys=False)
      storage.write_whole(self._folder / f'{name}.yaml', text.encode())
    version, digest = suite.dynamics(self._world.domain, self._world.task)
    description = {
        'world': dataclasses.asdict(self._world),
        **facts,
        'dynamics': {'version': version, 'digest': digest},
        'versions': results.versions(),
        'machine': machines.here(),
    }
    storage.write_json(self._folder / _DESCRIPTION, description)

  def info(
      self, env: environment.Environment, run: str, policy: str, **others: Any
  ) -> results.RunInfo:
    """Returns the settings that all episodes of a run share.

    Args:
      env: Environment in which the run acts.
      run: Name of the run.
      policy: Name of its policy.
      **others: Values of other attributes.
    """
    baseline = None if run == self._control else self._control
    return info_of(
        env, self._world, run=run, policy=policy, baseline=baseline, **others
    )

  def counts(self, result: results.EpisodeResult) -> bool:
    """Returns True if an episode counts; see `counted`."""
    return counted.counts(result, self._stake)

  def add(self, info: results.RunInfo, result: results.EpisodeResult) -> None:
    """Writes the row of an episode.

    Raises:
      ResultsError: If it cannot be written.
    """
    row = result.of_run(info, stake=self._stake)
    if self._writer is not None:
      self._writer.write(row)
    self.rows.setdefault(info.run, []).append(row)

  def summarize(
      self, title: str, agents: Collection[str] = ()
  ) -> tuple[pd.DataFrame, str]:
    """Writes `summary.md` and `summary.csv`, and the digest of the rows.

    Args:
      title: Beginning of `summary.md`.
      agents: Names of the runs whose seeds are seeds of training.

    Returns:
      What `study.judge` returns, and a summary of each run as a text.

    Raises:
      ResultsError: If all episodes have failed, or the files cannot be written.
    """
    found = study_of(
        self._world,
        self.rows,
        self._design,
        self._designs,
        self._control,
        agents,
        self._why_no_control,
    )
    judged = study.judge(found)
    for name, of_run in self.rows.items():
      if name not in judged.index:
        raise errors.ResultsError(
            f'run {name!r} has no episode that counts: all of its'
            f' {len(of_run)} failed or were given up'
        )
    text = result_tables.as_text(found, judged)
    if self._folder is not None:
      whole = f'{title}\n\n{text}\n'
      storage.write_whole(self._folder / 'summary.md', whole.encode())
      with storage.explained(self._folder):
        result_tables.write_csv(found, judged, self._folder / 'summary.csv')
      storage.finish(self._folder, {}, [EPISODES])
    return judged, text


def study_of(
    world: worlds.World,
    rows: _Rows,
    design: specs.DesignSpec,
    designs: Sequence[specs.DesignSpec],
    control: str | None,
    agents: Collection[str] = (),
    why_no_control: str = '',
    **others: Any,
) -> study.Study:
  """Returns the study of an evaluation.

  Args:
    world: World of the episodes.
    rows: Rows of each run, by its name.
    design: Design that runs in the first one of `designs` are judged on.
    designs: Designs of the worlds in which the runs acted.
    control: Name of the run to compare with, or `None`.
    agents: Names of the runs whose seeds are seeds of training.
    why_no_control: Reason for a missing control.
    **others: Further attributes of the study.

  Raises:
    ResultsError: If the control is no run.
  """
  if control is not None and control not in rows:
    raise errors.ResultsError(
        f'control {control!r} is not a run; must be one of {sorted(rows)}'
    )
  by_digest = {one.digest(): one for one in reversed(designs)}
  runs = {}
  for name, of_run in rows.items():
    info = of_run[0].info
    loaded = by_digest.get(info.design_digest, designs[0])
    config = {
        'task': f'{world.domain}.{world.task}',
        'task_kwargs': dict(world.task_kwargs),
        'environment_kwargs': {'senses': world.senses and [*world.senses]},
        'max_steps': world.max_steps,
        'design': (design if loaded is designs[0] else loaded).to_mapping(),
        'loaded': loaded.to_mapping(),
        'evaluation': {'seed_offset': 0},
    }
    seeds = dict.fromkeys(row.seed for row in of_run)
    role = study.Role.AGENT if name in agents else study.Role.BASELINE
    runs[name] = study.Run(
        name, role, control or '', info.policy, info.design, tuple(of_run),
        {seed: config for seed in seeds}, control, [*seeds],
    )  # fmt: skip
  collected = {}
  if control is None:  # Nothing is judged, so nothing has to be compiled.
    collected = {
        premises.key_of(run.config): premises.Premises(
            solver=world.solver, best_mean_return=world.best_mean_return
        )
        for run in runs.values()
    }
  return study.Study(
      runs, why_no_control=why_no_control, collected=collected, **others
  )


@final
class _Description(pydantic.BaseModel):
  """The part of `run.json` that a study needs."""

  world: worlds.World
  overrides: tuple[str, ...] = ()
  seeds: tuple[int, ...]
  num_episodes: int
  agents: Mapping[str, int] = {}
  objective: dict[str, Any] | None = None


def read(folder: pathlib.Path) -> study.Study:
  """Reads the study of a comparison or of a report on agents of Gymnasium.

  Raises:
    ResultsError: If the folder has none, a file is damaged, or rows are missing
      or belong to another design.
  """
  rows: dict[str, list[results.EpisodeResult]] = {}
  path = folder / EPISODES
  for row in results.read_rows(path) if path.is_file() else ():
    rows.setdefault(row.info.run, []).append(row)
  # The embedded design is the first one, if there are others.
  designs = [specs.load(path) for path in sorted(folder.glob('design*.yaml'))]
  if not rows or not designs:
    raise errors.ResultsError(
        f'{folder}: not a sweep, and without rows or a design; must be a'
        ' sweep, a comparison, or a report on agents of Gymnasium'
    )
  path = folder / _DESCRIPTION
  try:
    told = _Description.model_validate(storage.read_json(path))
  except pydantic.ValidationError as error:
    raise errors.ResultsError(
        f'{path}: {audited.first_problem(error)}; must be a file of a'
        ' comparison or a report'
    ) from error
  design = designs[0]
  designs.append(experiment_specs.secure_twin(design))
  _check_rows(folder, rows, told, {x.digest() for x in designs})
  if told.objective is not None:
    learner = {'kind': 'gymnasium', 'objective': told.objective}
    design = specs.load({**design.to_mapping(), 'learner': learner})
  # Agents may have the name of a policy.
  others = {run: of for run, of in rows.items() if run not in told.agents}
  controls = [row.info.baseline for of_run in rows.values() for row in of_run]
  controls += [
      run
      for run, (row, *_) in others.items()
      if row.info.policy == told.world.solver
      and row.info.design_digest == designs[0].digest()
  ]
  return study_of(
      told.world,
      rows,
      design,
      designs,
      next((name for name in controls if name in others), None),
      told.agents,
      folder=folder,
      experiment={'overrides': told.overrides},
      has_traces=False,
      has_imprints=bool(storage.finished(folder, [EPISODES])),
  )


def _check_rows(
    folder: pathlib.Path,
    rows: _Rows,
    told: _Description,
    digests: Collection[str],
) -> None:
  """Checks that each run has all rows of the world, one design and one stake.

  Raises:
    ResultsError: If it has not.
  """
  names = told.world.domain, told.world.task
  # Number of rows by domain, task, design and seed.
  allowed = [
      {(*names, digest, seed): told.num_episodes for seed in told.seeds}
      for digest in digests
  ]
  for run, of_run in rows.items():
    counts = collections.Counter(
        (row.info.domain, row.info.task, row.info.design_digest, row.seed)
        for row in of_run
    )
    has_duplicates = len({row.key for row in of_run}) < len(of_run)
    if counts not in allowed or has_duplicates:
      raise errors.ResultsError(
          f'{folder}: run {run!r} has numbers of rows {dict(counts)}; must be'
          f' one of {allowed}'
      )
    # As texts, because nan is unequal to itself.
    if len({repr(row.extras.get('stake')) for row in of_run}) > 1:
      raise errors.ResultsError(
          f'{folder}: the rows of run {run!r} have different stakes; must have'
          ' those of one design'
      )
