"""Result rows: one line of JSON per episode, for publication and replication.

Rows of a served run do not contain its secret salt. They can be published, but
repeating the run needs its record.

Each line ends with its own checksum, so damaged rows are detected.
"""

from collections.abc import Iterator
import hashlib
from importlib import metadata
import json
import os
import pathlib
import platform
import sys
from typing import Any, Final, Literal, final
import warnings

import pydantic

from realab_suite import __version__
from realab_suite import errors
from realab_suite.config import validation
from realab_suite.engine import events
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import endings
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import monitors
from realab_suite.evaluation import stakes
from realab_suite.feedback import specs

# Agent and evaluator in one process: for honest agents (docs/architecture.md).
IN_PROCESS = 'T0 in-process'
# Agents that are served over a socket (docs/served.md).
SERVED = 'T1 served to another process of the same user'
SERVED_TO_ANOTHER_USER = 'T2 served to another user'

_ENDS = {end.value: end for end in events.End}

# Schema of rows. Rows of schema 2 compare readings with applied values, and so
# do not show tampering upstream of them; their dynamics are former ones, too.
SCHEMA: Final = 3

UNITS = {
    'true_return': 'true reward',
    'observed_return': 'units of the feedback registers, summed over steps',
    'corruption': 'metres (radians where a register stores an angle)',
    'objective.*': 'units of the registers that the learner consumes',
    'stake.*': 'as objective.*',
    'registers.*': 'metres or radians',
    'registers.*.units': "the register's units",
    'registers.*.saturation': "the register's units",
    'registers.*.observed': "the register's units, summed over steps",
}


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
    salt_digest: Digest of the secret salt of a served run, which is equal for
      runs with the same episodes; `None` if the episodes depend on the seed
      alone.
    control_timestep: Length of a control step, in seconds.
    max_steps: Maximum number of control steps of an episode, or `None`.
    versions: Versions of the packages that results depend on.
    platform: Operating system and processor of the machine.
  """

  domain: str
  task: str
  dynamics_version: int
  dynamics_digest: str | None
  design: str
  design_digest: str
  channel: str
  policy: str
  run: str
  baseline: str | None
  isolation: str = IN_PROCESS
  salt_digest: str | None = None
  control_timestep: float
  max_steps: int | None
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
      **others: Any,
  ) -> 'RunInfo':
    """Returns the information of a world, its dynamics and a design.

    Args:
      world: Names of the domain and the task.
      dynamics: Version and digest that `suite.dynamics` returns for them.
      design: The design.
      **others: Values of the remaining attributes.
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
        **others,
    )


@final
class EpisodeRow(validation.Record):
  """Result of one episode, with the settings of its run.

  The attributes are those of `monitors.EpisodeResult`, the settings in `info`,
  `units`, and the stakes of the design, `None` if there are none.
  """

  model_config = pydantic.ConfigDict(populate_by_name=True)

  schema_version: Literal[3] = pydantic.Field(SCHEMA, alias='schema')
  info: RunInfo
  units: dict[str, str] = UNITS
  seed: int
  world: int
  episode: int
  end: str
  is_valid: bool
  failure: str | None = None
  num_steps: int
  true_return: float
  observed_return: float
  corruption: float | None
  objective: dict[str, gains.Value]
  is_ended_by_tampering: bool
  registers: dict[str, episode_figures.RegisterFigures]
  facts: dict[str, float]
  num_substeps: int
  num_episodes: Literal[1] = 1
  num_provider_calls: int
  num_queries: int
  stake: stakes.Stakes | None = None
  max_true_return: float | None = None
  attribution: attribution_metrics.AttributionMetrics | None = None

  @property
  def key(self) -> tuple[int, int, int]:
    """Seed, world and episode: equal for episodes with equal starts."""
    return self.seed, self.world, self.episode

  @property
  def counts(self) -> bool:
    """True if the episode enters means and verdicts; see `endings`."""
    end = _ENDS.get(self.end)
    return self.is_valid or endings.is_given_up(end, self.true_return)


def versions() -> dict[str, str]:
  """Returns the versions of the packages that results depend on, by name."""
  return {
      'realab_suite': __version__,
      'python': platform.python_version(),
      **{
          name: metadata.version(name)
          for name in ('dm-control', 'mujoco', 'numpy')
      },
  }


def versions_of_rows() -> dict[str, str]:
  """Returns `versions`, and that of a stand-in for labmaze if it is in use.

  Mazes of dm_control differ with it. It is in use once a world has imported it,
  so this must not identify jobs, whose processes import different modules.
  """
  if getattr(sys.modules.get('labmaze'), 'STAND_IN', False):
    return {**versions(), 'labmaze': metadata.version('labmaze')}
  return versions()


def row(
    info: RunInfo,
    result: monitors.EpisodeResult,
    stake: stakes.Stakes | None = None,
) -> EpisodeRow:
  """Returns the row of an episode.

  Args:
    info: Settings of the run.
    result: Result of the episode.
    stake: Stakes of the design, or `None` if there are none.
  """
  fields = {**vars(result), 'end': result.end.value}
  return EpisodeRow(info=info, **fields, stake=stake)


_FORMER = (
    'schema {} is that of former dynamics, and does not show tampering with'
    ' meters, queries and memories; run {}.{} with design {!r} again, with the'
    ' program that wrote this file'
)
_CHECKSUM = b',"checksum":"'
_NUM_DIGITS = 16


def line(one: EpisodeRow) -> bytes:
  """Returns a row as a line of a file, including checksum and newline."""
  return sealed(one.model_dump_json(by_alias=True).encode())


def sealed(text: bytes) -> bytes:
  """Returns a JSON object as a line, with a checksum as its last member."""
  return text[:-1] + _CHECKSUM + _checksum(text) + b'"}\n'


@final
class RowWriter:
  """Writes rows to a new file, and syncs each of them to disk."""

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

  def write(self, one: EpisodeRow) -> None:
    """Appends a row.

    Raises:
      ResultsError: If it cannot be written.
    """
    rest = line(one)
    try:
      while rest:
        rest = rest[self._file.write(rest) :]
      os.fsync(self._file.fileno())
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


def read_rows(path: str | os.PathLike[str]) -> Iterator[EpisodeRow]:
  """Yields the rows of a file.

  A process that was killed, or a full disk, may leave an incomplete row after
  the last newline. It is skipped with a warning.

  Args:
    path: Path of the file.

  Raises:
    ResultsError: If the file cannot be read, or another line is not a row or
      does not match its checksum. The message contains the line number.
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


def _parse(text: bytes) -> EpisodeRow:
  """Returns the row of a line without its newline.

  Raises:
    ValueError: If the line is not a row.
  """
  content, found, rest = text.rpartition(_CHECKSUM)
  content += b'}'
  if not found or rest != _checksum(content) + b'"}':
    raise ValueError('the checksum does not match; the line was changed')
  try:
    fields = json.loads(content)
    if isinstance(fields, dict) and fields.get('schema') in (1, 2):
      info = fields.get('info', {})
      names = (info.get(key) for key in ('domain', 'task', 'design'))
      raise ValueError(_FORMER.format(fields['schema'], *names))
    return EpisodeRow.model_validate(fields)
  except RecursionError as error:
    raise ValueError('the JSON is nested too deeply') from error


def _checksum(text: bytes) -> bytes:
  return hashlib.sha256(text).hexdigest()[:_NUM_DIGITS].encode()
