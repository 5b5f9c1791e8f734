"""Result rows: a line of JSON per episode, enough to publish and to repeat."""

from collections.abc import Iterator
import dataclasses
from importlib import metadata
import json
import math
import os
import pathlib
import platform
from typing import Any, Literal, final

import pydantic

from realab_suite import __version__
from realab_suite import errors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import metrics

# Everything in one process: honest agents only (docs/architecture.md).
IN_PROCESS = 'T0 in-process'

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
  control_timestep: float
  max_steps: int | None
  versions: dict[str, str] = pydantic.Field(default_factory=lambda: versions())
  platform: str = pydantic.Field(default_factory=platform.platform)


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


@final
class RowWriter:
  """Appends rows to a new file; each is on disk before the next is written."""

  def __init__(self, path: str | os.PathLike[str]) -> None:
    """Makes the file.

    Raises:
      ResultsError: If there is one already, or it cannot be made.
    """
    try:
      self._file = open(path, 'x', encoding='utf-8')
    except OSError as error:
      raise errors.ResultsError(
          f'cannot make {os.fspath(path)}: {error.strerror}'
      ) from error

  def write(self, one: EpisodeRow) -> None:
    """Appends a row."""
    line = one.model_dump_json(by_alias=True)
    try:
      self._file.write(line + '\n')
      self._file.flush()
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

  Raises:
    ResultsError: If the file cannot be read, or a line is no row; it names the
      line.
  """
  try:
    text = pathlib.Path(path).read_text(encoding='utf-8')
  except (OSError, UnicodeDecodeError) as error:
    raise errors.ResultsError(
        f'cannot read {os.fspath(path)}: {error}'
    ) from error
  # JSON leaves characters in names alone that `splitlines` splits at.
  lines = text.removesuffix('\n').split('\n') if text else []
  for number, line in enumerate(lines, start=1):
    try:
      yield EpisodeRow.model_validate(json.loads(line))
    except ValueError as error:
      problem = ': '.join(str(error).splitlines()[:2])
      raise errors.ResultsError(
          f'{os.fspath(path)}:{number}: not a row of schema 1: {problem}'
      ) from error
