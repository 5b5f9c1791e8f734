"""Plants bugs in a copy of the package, and runs tests on the copy."""

from collections.abc import Sequence
import os
import pathlib
import shutil
import subprocess
import sys
from typing import Literal, NamedTuple, final

ROOT = pathlib.Path(__file__).parents[1]
_PATIENCE_SECONDS = 600
_TESTS_FAILED = 1  # The exit status of pytest; 2 and more is something else.
_COPIED = (
    'realab_suite', 'configs', 'campaigns', 'tests', 'examples', 'setup.cfg',
)  # fmt: skip


@final
class Mutant(NamedTuple):
  """A bug, as one change to the text of a module.

  Attributes:
    kind: Kind of behaviour that it breaks.
    what: Description of the bug.
    file: Module, within the package.
    old: Text to replace; the module contains it once.
    new: Text that replaces it.
    tests: Arguments of pytest: tests that have to fail.
  """

  kind: Literal['contract', 'leak', 'metric', 'storage', 'statistics']
  what: str
  file: str
  old: str
  new: str
  tests: Sequence[str]


def copy_package(folder: pathlib.Path) -> None:
  """Copies the files that tests need into a folder."""
  for name in _COPIED:
    source = ROOT / name
    if source.is_dir():
      shutil.copytree(
          source, folder / name, ignore=shutil.ignore_patterns('__pycache__')
      )
    else:
      shutil.copy(source, folder / name)


def is_caught(mutant: Mutant, folder: pathlib.Path) -> bool:
  """Returns True if tests of a copy of the package fail with a bug."""
  path = folder / 'realab_suite' / mutant.file
  text = path.read_text(encoding='utf-8')
  path.write_text(mutated(mutant, text), encoding='utf-8')
  try:
    return outcome(mutant.tests, folder) == 'failed'
  finally:
    path.write_text(text, encoding='utf-8')


def outcome(
    tests: Sequence[str], folder: pathlib.Path
) -> Literal['passed', 'failed', 'not run']:
  """Returns the outcome of tests of a copy of the package."""
  try:
    ran = subprocess.run(
        [
            sys.executable, '-m', 'pytest', '-q', '-x', '--no-header',
            '-p', 'no:cacheprovider', *tests,
        ],
        cwd=folder,
        env={
            **os.environ,
            'PYTHONPATH': str(folder),
            'PYTHONDONTWRITEBYTECODE': '1',
        },
        capture_output=True,
        timeout=_PATIENCE_SECONDS,
        check=False,
    )  # fmt: skip
  except subprocess.TimeoutExpired:
    return 'failed'  # The bug makes tests hang.
  if not ran.returncode:
    return 'passed'
  if ran.returncode == _TESTS_FAILED or ran.returncode < 0:
    return 'failed'  # The bug ends Python itself.
  print(f'# {tests} cannot be run: {ran.stdout.decode()[-500:]}')
  return 'not run'


def mutated(mutant: Mutant, text: str) -> str:
  """Returns the text of a module with a bug in it.

  Raises:
    ValueError: If the module does not contain the old text exactly once.
  """
  if text.count(mutant.old) != 1:
    raise ValueError(
        f'{mutant.what}: {mutant.file} contains the text to replace'
        f' {text.count(mutant.old)} times; must be once'
    )
  return text.replace(mutant.old, mutant.new)
