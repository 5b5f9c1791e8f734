"""Record of a served run, with which the run can be repeated.

It contains the secret salt.
"""

import os
import pathlib
import re
import stat
from typing import Any, final

import pydantic

from realab_suite import errors
from realab_suite import worlds
from realab_suite.config import validation
from realab_suite.engine import seeding
from realab_suite.experiments import storage

NAME = 'run.json'
"""Name of the file in the folder of the results."""

_NUM_DIGITS = 2 * seeding.NUM_SALT_BYTES
_STRICT = pydantic.ConfigDict(frozen=True, strict=True)


@final
class EpisodeSettings(pydantic.BaseModel):
  """Settings that determine the episodes of a run.

  Attributes:
    domain: Domain of the task.
    task: Name of the task in its domain.
    design: Agent design, by name or path; its contents are in the record.
    overrides: Dotted overrides, already applied to the contents.
    seed: Public seed of the episodes.
    max_steps: Maximum length of an episode, in control steps.
    task_kwargs: Arguments of the task, without the seed.
    senses: Names of the agent's senses, or `None` for those of the task.
  """

  model_config = _STRICT

  domain: str
  task: str
  design: str
  overrides: list[str]
  seed: int = pydantic.Field(ge=0)
  max_steps: int = pydantic.Field(ge=1)
  task_kwargs: dict[str, Any] = pydantic.Field(default_factory=dict)
  senses: list[str] | None = None

  @property
  def world(self) -> worlds.World:
    """World of the episodes."""
    senses = None if self.senses is None else tuple(self.senses)
    return worlds.World(
        self.domain, self.task, self.max_steps, self.task_kwargs, senses
    )


@final
class Record(pydantic.BaseModel):
  """A record. The file may have further keys, which are not read.

  Attributes:
    settings: Settings of the run.
    design: Contents of the design.
    salt: Secret salt, in hexadecimal.
    versions: Versions of the packages that the dynamics depend on.
  """

  model_config = _STRICT

  settings: EpisodeSettings
  design: dict[str, Any]
  salt: str = pydantic.Field(repr=False)
  versions: dict[str, str]

  @property
  def seed(self) -> seeding.SaltedSeed:
    """Seed with its salt."""
    return seeding.SaltedSeed(self.settings.seed, bytes.fromhex(self.salt))


def read(path: str) -> Record:
  """Reads a record.

  Raises:
    ResultsError: If the file cannot be read or is damaged.
    SpecError: If the file is not a record, or other users could have read or
      replaced it.
  """
  with storage.explained(path):
    status = os.stat(path)
  mode = stat.S_IMODE(status.st_mode)
  if status.st_uid != os.geteuid() or mode & 0o077:
    raise errors.SpecError(
        f'{path}: belongs to user {status.st_uid} and has mode {mode:04o};'
        f' allowed is a file of user {os.geteuid()} with mode 0600, because'
        ' the salt in it must stay secret'
    )
  content = storage.read_sealed(
      pathlib.Path(path), f'allowed is the {NAME} of a served run'
  )
  record = validation.validate(Record, content, path)
  if not re.fullmatch(f'[0-9a-f]{{{_NUM_DIGITS}}}', record.salt):
    # The message does not contain the text, which may be a secret.
    raise errors.SpecError(
        f'{path}: salt: a text of {len(record.salt)} characters; allowed are'
        f' {_NUM_DIGITS} digits from 0 to f'
    )
  return record
