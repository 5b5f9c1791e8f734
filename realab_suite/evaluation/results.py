"""Results of episodes, and files with one of them per line, as JSON."""

from collections.abc import Iterator
import functools
from importlib import metadata
import os
import pathlib
import platform
import sys
from typing import Any, Final, Literal, final
import warnings

import pydantic

from realab_suite import _versions
from realab_suite import errors
from realab_suite import sources
from realab_suite.config import validation
from realab_suite.engine import events
from realab_suite.evaluation import endings
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.feedback import specs

# Agent and evaluator in one process: for honest agents (docs/architecture.md).
IN_PROCESS = 'T0 in-process'
# Agents that are served over a socket (docs/doors.md).
SERVED = 'T1 served to another process'

SCHEMA: Final = 4
"""Version of the format of rows."""


@final
class RunInfo(validation.Record):
  """Settings that all episodes of a run share.

  Attributes:
    domain: Name of the domain.
    task: Name of the task in the domain.
    dynamics_version: Version of the task's dynamics.
    dynamics_digest: Digest of a golden trajectory of these dynamics, or `None`
      if there is none for this version of MuJoCo.
    design: Name of the design.
    design_digest: Digest of all fields of the design.
    channel: Channel of the design: embedded or secure.
    policy: Name of the policy or agent.
    run: Name of the run, by which rows are grouped.
    baseline: Name of the run to compare with, or `None`.
    isolation: Isolation tier of the agent.
    control_timestep: Length of a control step, in seconds.
    max_steps: Maximum number of control steps of an episode, or `None`.
    versions: Versions of the packages that results depend on.
    platform: Operating system and processor of the machine.
  """

  domain: str
  task: str
  dynamics_version: int
  dynamics_digest: str | None = None
  design: str
  design_digest: str
  channel: str
  policy: str
  run: str
  baseline: str | None = None
  isolation: str = IN_PROCESS
  control_timestep: float
  max_steps: int | None = None
  versions: dict[str, str] = pydantic.Field(
      default_factory=lambda: versions_of_rows()
  )
  platform: str = pydantic.Field(default_factory=platform.platform)

  @classmethod
  def of(
      cls,
      world: tuple[str, str],
      dynamics: tuple[int, str | None],
      design: specs.DesignSpec,
      **fields: Any,
  ) -> 'RunInfo':
    """Returns the information of a world, its dynamics and a design.

    Args:
      world: Names of the domain and the task.
      dynamics: Version and digest that `suite.dynamics` returns for them.
      design: The design.
      **fields: Values of the remaining attributes.
    """
    (domain, task), (version, digest) = world, dynamics
    return cls(
        domain=domain,
        task=task,
        dynamics_version=version,
        dynamics_digest=digest,
        design=design.name,
        design_digest=design.digest(),
        channel=design.channel,
        **fields,
    )


@final
class EpisodeResult(validation.Record):
  """Result of one episode, for the evaluator only: a row of a file.

  Attributes:
    schema_version: Version of this format; `schema` in a file.
    settings: Settings of its run, `info` in a file; `None` until the episode
      belongs to a run; see `of_run`.
    seed: Seed of the environment.
    world: Number of the world, which random streams depend on; 0 for a single
      world.
    episode: Number of the episode, from 0.
    end: Reason for the end of the episode.
    is_valid: True if all figures describe a whole episode; see `endings`.
    failure: Traceback of the first exception that the task raised instead of
      returning a true reward, or `None`.
    num_steps: Number of control steps.
    true_return: Sum of true rewards, up to the end of the episode.
    observed_return: Sum of the agent's readings of feedback registers, in their
      units.
    corruption: Corruption from end to end, in metres (radians where a register
      stores an angle): the largest over the registers that the learner
      consumes; `None` if none of them was read.
    objective: Value of each part of the learner's objective, by name, in the
      units of the registers that it consumes; empty if the learner is not
      judged, and before the first control step.
    misnamed: Share of control steps in which a query that should name the
      agent's action named another one; `None` if no query does so, and in rows
      of former versions.
    is_ended_by_tampering: True if only a corrupted signal has ended it.
    registers: Figures of each register, by name.
    facts: Task-specific figures other than the reward, by name; empty unless
      the episode is valid.
    num_substeps: Number of physics steps.
    num_provider_calls: Number of calls of providers with readings.
    num_queries: Number of values that the agent sent to providers.
    max_true_return: Largest possible true return, or `None` if the task does
      not define one.
    extras: What others add to an episode, as JSON by name: the stakes of the
      design (`stakes.of`) and the attribution of the corruption
      (`attribution_metrics.of`).
  """

  model_config = pydantic.ConfigDict(populate_by_name=True)

  schema_version: Literal[4] = pydantic.Field(SCHEMA, alias='schema')
  settings: RunInfo | None = pydantic.Field(None, alias='info')
  seed: int
  world: int
  episode: int
  end: events.End
  is_valid: bool
  failure: str | None = None
  num_steps: int
  true_return: float
  observed_return: float
  corruption: float | None = None
  objective: dict[str, gains.Value] = pydantic.Field(default_factory=dict)
  misnamed: float | None = None
  is_ended_by_tampering: bool
  registers: dict[str, episode_figures.RegisterFigures] = pydantic.Field(
      default_factory=dict
  )
  facts: dict[str, float] = pydantic.Field(default_factory=dict)
  num_substeps: int
  num_provider_calls: int
  num_queries: int
  max_true_return: float | None = None
  extras: dict[str, dict[str, Any]] = pydantic.Field(default_factory=dict)

  @property
  def info(self) -> RunInfo:
    """Settings of the run.

    Raises:
      ResultsError: If the episode belongs to no run.
    """
    if self.settings is None:
      raise errors.ResultsError(f'episode {self.key} belongs to no run')
    return self.settings

  @property
  def key(self) -> tuple[int, int, int]:
    """Seed, world and episode: equal for episodes with equal starts."""
    return self.seed, self.world, self.episode

  @property
  def is_given_up(self) -> bool:
    """True if the agent ended the episode; see `endings`."""
    return endings.is_given_up(self.end, self.true_return)

  def of_run(
      self, info: RunInfo, **extras: validation.Record | None
  ) -> 'EpisodeResult':
    """Returns the result with the settings of its run.

    Args:
      info: Settings of the run.
      **extras: Records to add by name; `None` for those that do not exist.
    """
    added = {
        name: record.model_dump(mode='json', exclude_none=True)
        for name, record in extras.items()
        if record is not None
    }
    return self.model_copy(
        update={'settings': info, 'extras': {**self.extras, **added}}
    )


def versions() -> dict[str, str]:
  """Returns the versions of what results depend on, by name.

  They are those of packages, and `code`, the digest of the sources.
  """
  return {
      'realab_suite': _versions.VERSION,
      'code': sources.digest(),
      'python': platform.python_version(),
      **{name: version_of(name) for name in ('dm-control', 'mujoco', 'numpy')},
  }


@functools.cache
def version_of(package: str) -> str:
  """Returns the version of a package, which is read from a file once.

  Raises:
    PackageNotFoundError: If it is not installed.
  """
  return metadata.version(package)


def versions_of_rows() -> dict[str, str]:
  """Returns `versions`, and that of a stand-in for labmaze if it is in use.

  Mazes of dm_control differ with it. It is in use once a world has imported it,
  so this must not identify jobs, whose processes import different modules.
  """
  if getattr(sys.modules.get('labmaze'), 'STAND_IN', False):
    return {**versions(), 'labmaze': metadata.version('labmaze')}
  return versions()


def line(result: EpisodeResult) -> bytes:
  """Returns a result as a line of a file, including the newline."""
  return result.model_dump_json(by_alias=True).encode() + b'\n'


@final
class RowWriter:
  """Writes results to a new file, one line each."""

  def __init__(self, path: str | os.PathLike[str]) -> None:
    """Creates the file.

    Args:
      path: Path of the file.

    Raises:
      ResultsError: If the file exists, or cannot be created.
    """
    try:
      # Unbuffered, so that closing does not retry a write that has failed.
      self._file = open(path, 'xb', buffering=0)
    except OSError as error:
      raise errors.ResultsError(
          f'cannot create {os.fspath(path)}: {error.strerror}'
      ) from error

  def write(self, result: EpisodeResult) -> None:
    """Appends a row.

    Raises:
      ResultsError: If it cannot be written.
    """
    rest = line(result)
    try:
      while rest:
        rest = rest[self._file.write(rest) :]
    except OSError as error:
      raise errors.ResultsError(
          f'cannot write {self._file.name}: {error.strerror}'
      ) from error

  def close(self) -> None:
    """Closes the file."""
    self._file.close()

  def __enter__(self) -> 'RowWriter':
    return self

  def __exit__(self, *unused: Any) -> None:
    self.close()


def read_rows(path: str | os.PathLike[str]) -> Iterator[EpisodeResult]:
  """Yields the rows of a file.

  A process that was killed, or a full disk, may leave an incomplete row after
  the last newline. It is skipped with a warning.

  Args:
    path: Path of the file.

  Raises:
    ResultsError: If the file cannot be read, or another line is not a row. The
      message contains the line number.
  """
  where = os.fspath(path)
  try:
    data = pathlib.Path(path).read_bytes()
  except OSError as error:
    raise errors.ResultsError(f'cannot read {where}: {error}') from error
  *whole, tail = data.split(b'\n')
  for number, text in enumerate(whole, start=1):
    try:
      yield _parse(text)
    except ValueError as error:
      problem = ': '.join(str(error).splitlines()[:2])
      raise errors.ResultsError(
          f'{where}:{number}: not a row of schema {SCHEMA}: {problem}'
      ) from error
  if not tail:
    return
  try:
    last = _parse(tail)
  except ValueError:
    warnings.warn(
        f'{where}:{len(whole) + 1}: skipped an incomplete row of {len(tail)}'
        f' bytes; the {len(whole)} rows before it are complete',
        stacklevel=2,
    )
  else:
    yield last  # Only the newline is missing.


def _parse(text: bytes) -> EpisodeResult:
  """Returns the result in a line without its newline.

  Raises:
    ValueError: If the line is not a row.
  """
  result = EpisodeResult.model_validate_json(text)
  if result.settings is None:
    raise ValueError('info: required key is missing')
  return result
