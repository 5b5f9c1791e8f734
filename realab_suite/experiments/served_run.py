"""The record of a served run, which repeats it and contains its secret salt."""

from collections.abc import Mapping
import os
import pathlib
import re
import stat
from typing import Any, final

import pydantic

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.engine import seeding
from realab_suite.experiments import storage

NAME = 'run.json'
"""The file, in the folder of the results."""

_NUM_DIGITS = 2 * seeding.NUM_SALT_BYTES
_STRICT = pydantic.ConfigDict(frozen=True, strict=True)


@final
class EpisodeSettings(pydantic.BaseModel):
  """The settings of a run that decide which episodes it has.

  Attributes:
    domain: The world.
    task: Its variation.
    design: The agent design, by name or path; the record has its contents.
    overrides: Dotted overrides, which the contents include.
    seed: The seed.
    max_steps: The length of an episode in control steps.
  """

  model_config = _STRICT

  domain: str
  task: str
  design: str
  overrides: list[str]
  seed: int = pydantic.Field(ge=0)
  max_steps: int = pydantic.Field(ge=1)


@final
class Record(pydantic.BaseModel):
  """A record; other keys of the file are for people.

  Attributes:
    settings: What was served.
    design: The contents of the design.
    salt: The secret, hexadecimal.
    versions: Of everything that dynamics depend on.
  """

  model_config = _STRICT

  settings: EpisodeSettings
  design: dict[str, Any]
  salt: str = pydantic.Field(repr=False)
  versions: dict[str, str]

  @property
  def seed(self) -> seeding.SaltedSeed:
    """The seed with its salt."""
    return seeding.SaltedSeed(self.settings.seed, bytes.fromhex(self.salt))


def write(
    folder: pathlib.Path,
    settings: Mapping[str, Any],
    design: Mapping[str, Any],
    salt: bytes,
    versions: Mapping[str, str],
) -> None:
  """Writes the record of a run, which only this user can read.

  Args:
    folder: The folder of the results, for this user alone.
    settings: The settings, those of `EpisodeSettings` included.
    design: The contents of the design.
    salt: The secret.
    versions: Of everything that dynamics depend on.
  """
  content = {
      'settings': dict(settings),
      'design': dict(design),
      'versions': dict(versions),
      'salt': salt.hex(),
  }
  storage.write_sealed(folder / NAME, content)


def read(path: str) -> Record:
  """Returns a record that `write` has written.

  Raises:
    ResultsError: If the file cannot be read, or is damaged.
    SpecError: If the file is no record, or other users could have read or
      replaced it.
  """
  with storage.explained(path):
    status = os.stat(path)
  mode = stat.S_IMODE(status.st_mode)
  if status.st_uid != os.geteuid() or mode & 0o077:
    raise errors.SpecError(
        f'{path}: belongs to user {status.st_uid} and has mode {mode:04o};'
        f' allowed is a file of user {os.geteuid()} with mode 0600, because'
        ' others can predict a run whose salt they have'
    )
  content = storage.read_sealed(
      pathlib.Path(path), f'allowed is the {NAME} of a served run'
  )
  record = validation.validate(Record, content, path)
  if not re.fullmatch(f'[0-9a-f]{{{_NUM_DIGITS}}}', record.salt):
    # The message does not repeat what may be a secret.
    raise errors.SpecError(
        f'{path}: salt: a text of {len(record.salt)} characters; allowed are'
        f' {_NUM_DIGITS} digits from 0 to f'
    )
  return record
