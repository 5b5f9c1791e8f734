"""Folders of results: those of sweeps, and published ones."""

import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_results


def is_sweep(folder: pathlib.Path) -> bool:
  """Returns True for the folder of a sweep, or of published results."""
  names = sweep_results.CONTENTS, scheduler.SWEEP
  return any((folder / name).is_file() for name in names)


def load(
    folder: pathlib.Path, accept_other_code: bool = False
) -> sweep_results.Sweep:
  """Reads the folder of a sweep, or published results.

  Args:
    folder: The folder.
    accept_other_code: True to accept results of different code.

  Raises:
    ResultsError: If it is neither, a file in it is damaged, or its results are
      of different code. The message names the file and, if possible, the line.
  """
  storage.check_access(folder, is_written=False)
  sweep = _load(folder)
  storage.check_codes(folder, sweep.codes, accept_other_code)
  return sweep


def _load(folder: pathlib.Path) -> sweep_results.Sweep:
  """Reads the folder of a sweep, or published results; see `load`."""
  if not (folder / sweep_results.CONTENTS).is_file():
    return sweep_results.load(folder)
  if problem := requirements.missing('pyarrow'):
    raise errors.ResultsError(f'{folder}: published results: {problem}')
  from realab_suite.lab.experiments import publishing

  return publishing.load(folder)
