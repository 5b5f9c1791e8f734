"""Result rows: a line of JSON per episode, enough to publish and to repeat.

The rows of a served run can be published, and only its record repeats it: they
do not have its salt.

Each line ends with a checksum of itself, so that a row which has been damaged
is never taken for one that has not.
"""

from collections.abc import Iterator
import dataclasses
import hashlib
from importlib import metadata
import json
import math
import os
import pathlib
import platform
from typing import Any, Literal, final
import warnings

import pydantic

from realab_suite import __version__
from realab_suite import errors
from realab_suite.engine import events
from realab_suite.evaluation import endings
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import metrics
from realab_suite.feedback import specs

# Everything in one process: honest agents only (docs/architecture.md).
IN_PROCESS = 'T0 in-process'
# Over a socket (docs/served.md): what the agent's code may be, see there.
SERVED = 'T1 served to another process of the same user'
SERVED_TO_ANOTHER_USER = 'T2 served to another user'

_ENDS = {end.value: end for end in events.End}

UNITS = {
    'true_return': 'true reward',
    'observed_return': 'units of the feedback registers, summed over steps',
    'corruption': 'metres (radians where a register stores an angle)',
    'registers.*': "the register's units, or metres where the name says so",
}

# A row may hold nan, as the true return of an invalid episode does. JSON has no
# such number, so it is written as text.
_FROZEN = pydantic.ConfigDict(
    frozen=True, extra='forbid', ser_json_inf_nan='strings'
)


@final
class RunInfo(pydantic.BaseModel):
  """What the episodes of a run have in common.

  Attributes:
    domain: The world.
    task: The variation.
    dynamics_version: Of the world's dynamics.
    dynamics_digest: Of a golden trajectory of them, or `None` if there is none
      for this version of MuJoCo.
    design: The name of the design.
    design_digest: A hash of all its fields.
    channel: Of the design: embedded, welded or secure.
    policy: What acted.
    run: The name of the run, by which rows are grouped.
    baseline: The run to compare with, or `None`.
    isolation: How far the agent was kept from the evaluator.
    salt_digest: Digest of the secret salt of a served run, by which runs with
      the same episodes are recognised; `None` if the episodes follow from the
      seed alone.
    control_timestep: Length of a control step, seconds.
    max_steps: After how many control steps episodes end, or `None`.
    versions: Of everything that dynamics depend on.
    platform: Of the machine.
  """

  model_config = _FROZEN

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
  versions: dict[str, str] = pydantic.Field(default_factory=lambda: versions())
  platform: str = pydantic.Field(default_factory=platform.platform)

  @classmethod
  def of(
      cls,
      world: tuple[str, str],
      dynamics: tuple[int, str | None],
      design: specs.DesignSpec,
      **others: Any,
  ) -> 'RunInfo':
    """Returns what rows say of a world, its dynamics and a design.

    Args:
      world: The domain and the variation.
      dynamics: What `suite.dynamics` says of the two.
      design: The agent designer's.
      **others: The attributes that do not follow from these.
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
class EpisodeRow(pydantic.BaseModel):
  """One episode, with everything that is needed to read it by itself.

  Attributes are those of `RunInfo` and of `evaluate.EpisodeResult`;
  `corruption` is `None` in a file where it is nan in Python.
  """

  model_config = pydantic.ConfigDict(
      frozen=True,
      extra='forbid',
      ser_json_inf_nan='strings',
      populate_by_name=True,
  )

  schema_version: Literal[1] = pydantic.Field(1, alias='schema')
  info: RunInfo
  units: dict[str, str] = UNITS
  seed: int
  world: int
  episode: int
  end: str
  is_valid: bool
  failure: str | None = None
  true_return: float
  observed_return: float
  corruption: float
  registers: dict[str, metrics.RegisterMetrics]
  facts: dict[str, float]
  num_steps: int
  num_substeps: int
  num_episodes: Literal[1] = 1
  num_provider_calls: int
  num_queries: int
  # Rows of older files have none.
  max_true_return: float | None = None

  @property
  def counts(self) -> bool:
    """True if figures may be drawn from it; see `endings`."""
    end = _ENDS.get(self.end)
    return self.is_valid or endings.is_given_up(end, self.true_return)

  @pydantic.field_validator('corruption', mode='before')
  @classmethod
  def _from_null(cls, value: Any) -> Any:
    return math.nan if value is None else value

  @pydantic.field_serializer('corruption')
  def _to_null(self, value: float) -> float | None:
    return None if math.isnan(value) else value


def versions() -> dict[str, str]:
  """Returns the versions of what results depend on."""
  return {
      'realab_suite': __version__,
      'python': platform.python_version(),
      **{
          name: metadata.version(name)
          for name in ('dm-control', 'mujoco', 'numpy')
      },
  }


def row(info: RunInfo, result: evaluate.EpisodeResult) -> EpisodeRow:
  """Returns the row of an episode."""
  fields = {
      field.name: getattr(result, field.name)
      for field in dataclasses.fields(result)
  }
  return EpisodeRow(info=info, **{**fields, 'end': result.end.value})


_CHECKSUM = b',"checksum":"'
_NUM_DIGITS = 16


def line(one: EpisodeRow) -> bytes:
  """Returns a row as the line of a file, newline included."""
  return sealed(one.model_dump_json(by_alias=True).encode())


def sealed(text: bytes) -> bytes:
  """Returns a JSON object as a line whose last member is its checksum."""
  return text[:-1] + _CHECKSUM + _checksum(text) + b'"}\n'


@final
class RowWriter:
  """Appends rows to a new file; each is on disk before the next is written."""

  def __init__(self, path: str | os.PathLike[str]) -> None:
    """Makes the file.

    Raises:
      ResultsError: If there is one already, or it cannot be made.
    """
    try:
      # What could not be written is not tried again when the file is closed.
      self._file = open(path, 'xb', buffering=0)
    except OSError as error:
      raise errors.ResultsError(
          f'cannot make {os.fspath(path)}: {error.strerror}'
      ) from error

  def write(self, one: EpisodeRow) -> None:
    """Appends a row."""
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

  A process that was killed, or a disk that was full, may leave a part of a row
  behind the last newline. It is left out, with one warning that says so.

  Raises:
    ResultsError: If the file cannot be read, or any other line is no row, or
      not the row that was written; it names the line.
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
          f'{where}:{number}: not a row of schema 1: {problem}'
      ) from error
  if not tail:
    return
  try:
    last = _parse(tail)
  except ValueError:
    warnings.warn(
        f'{where}:{len(whole) + 1}: the last {len(tail)} bytes are a part of a'
        f' row and are left out; {len(whole)} rows before them are whole',
        stacklevel=2,
    )
  else:
    yield last  # All of it but the newline.


def _parse(text: bytes) -> EpisodeRow:
  """Returns the row of a line without its newline.

  Raises:
    ValueError: If it is none.
  """
  content, found, rest = text.rpartition(_CHECKSUM)
  content += b'}'
  if not found or rest != _checksum(content) + b'"}':
    raise ValueError('its checksum does not agree: it is not what was written')
  try:
    return EpisodeRow.model_validate(json.loads(content))
  except RecursionError as error:
    raise ValueError('it is nested too deeply') from error


def _checksum(text: bytes) -> bytes:
  return hashlib.sha256(text).hexdigest()[:_NUM_DIGITS].encode()
