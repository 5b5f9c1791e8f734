"""Evaluations: episodes of runs in one world, their rows and their summary.

Comparisons of scripted policies, episodes that a person plays or supervises,
served episodes, and reports on policies of Gymnasium are evaluations. They
differ in what acts.
"""

from collections.abc import Callable, Collection, Mapping
import dataclasses
import pathlib
from typing import Any, Final, final

import yaml

from realab_suite import suite
from realab_suite import worlds
from realab_suite.engine import environment
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import result_tables
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import queries
from realab_suite.lab.verdicts import stakes

EPISODES: Final = 'episodes.jsonl'
"""File of the rows."""


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
    why = judging.why_no_stakes(world, design)
    self._why_not_judged = why or why_no_control
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
    storage.write_json(self._folder / 'run.json', description)

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
  ) -> tuple[list[result_tables.Line], str]:
    """Writes `summary.md` and `summary.csv`, and the digest of the rows.

    Args:
      title: Beginning of `summary.md`.
      agents: Names of the runs whose seeds are seeds of training.

    Returns:
      The summary of each run, and all of them as a text.

    Raises:
      ResultsError: If all episodes have failed, or the files cannot be written.
    """
    world, design, stake = self._world, self._design, self._stake
    obstacles: list[str] = []
    apart: list[str] = []
    solver = None
    if self._control is not None:
      obstacles = judging.obstacles_of(world, design, stake)
      of_task, apart = judging.coupling(world, design)
      solver = world.solver if of_task else None
    rules = result_tables.Rules(
        self._control,
        gains.consumed(design),
        stake,
        self._why_not_judged,
        agents,
        obstacles,
        solver,
        apart,
        queries.is_coupled(design),
    )
    lines = result_tables.summarize(self.rows, rules)
    text = result_tables.as_text(lines)
    if self._folder is not None:
      whole = f'{title}\n\n{text}\n'
      storage.write_whole(self._folder / 'summary.md', whole.encode())
      with storage.explained(self._folder):
        result_tables.write_csv(lines, self._folder / 'summary.csv')
      storage.finish(self._folder, {}, [EPISODES])
    return lines, text
