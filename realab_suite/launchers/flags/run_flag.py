"""Flag `--run`, shared by several programs."""

from collections.abc import Mapping
import pathlib
from typing import TypeVar

from absl import flags

from realab_suite import errors
from realab_suite.config import messages

_Run = TypeVar('_Run')

RUN = flags.DEFINE_string(
    'run',
    None,
    'Run of the experiment, such as "reward", "reward.secure" (its twin) or'
    ' "reward.random" (a baseline).',
)


def find(name: str, runs: Mapping[str, _Run], folder: pathlib.Path) -> _Run:
  """Returns the run of a sweep that the flag names.

  Args:
    name: Value of the flag.
    runs: Runs of the sweep by name.
    folder: Folder of the sweep.

  Raises:
    UnknownNameError: If there is no such run.
  """
  if name not in runs:
    raise errors.UnknownNameError(
        f'--run={name:.80}: not a run of {folder}; allowed are {list(runs)}'
        f'{messages.did_you_mean(name, runs)}'
    )
  return runs[name]
