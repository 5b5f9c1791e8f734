"""Folders of results, and the study in each of them.

A folder has a sweep, which may still be running, published results, a
comparison of scripted policies, or a report on agents of Gymnasium.
"""

import os
import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_folders
from realab_suite.lab.verdicts import study


def is_sweep(folder: pathlib.Path) -> bool:
  """Returns True for the folder of a sweep, or of published results."""
  names = sweep_folders.CONTENTS, scheduler.SWEEP
  return any((folder / name).is_file() for name in names)


def read(
    folder: str | os.PathLike[str], accept_other_code: bool = False
) -> study.Study:
  """Reads the study in a folder of results.

  Args:
    folder: The folder.
    accept_other_code: True to accept results of different code.

  Raises:
    ResultsError: If it has no results, a file in it is damaged, or its results
      are of different code. The message names the file and, if possible, the
      line.
  """
  path = pathlib.Path(folder).expanduser()
  storage.check_access(path, is_written=False)
  read_study = _read(path)
  codes = read_study.codes(storage.CODE)
  storage.check_codes(path, codes, accept_other_code)
  return read_study


def read_sweep(
    folder: str | os.PathLike[str], accept_other_code: bool = False
) -> study.Study:
  """Reads the study of a sweep, in its folder or published; see `read`."""
  path = pathlib.Path(folder).expanduser()
  if not is_sweep(path):
    storage.check_access(path, is_written=False)
    return sweep_folders.load(path)  # Says what it should have been.
  return read(path, accept_other_code)


def _read(path: pathlib.Path) -> study.Study:
  if (path / sweep_folders.CONTENTS).is_file():
    if problem := requirements.missing('pyarrow'):
      raise errors.ResultsError(f'{path}: published results: {problem}')
    from realab_suite.lab.experiments import publishing

    return publishing.load(path)
  if (path / scheduler.SWEEP).is_file():
    return sweep_folders.load(path)
  return evaluations.read(path)
