"""Campaign C45: branch coverage of the parts that must not be wrong.

Run from the root of the repository, about twenty minutes:

    python -m campaigns.coverage_campaign [scale] [seed]

Runs the tests of the rooms of these parts once, and counts branches as
coverage.py does. The arguments have no effect: a part of the tests has no
meaningful coverage.
"""

from collections.abc import Mapping, Sequence
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

from campaigns import figure_lines

_ROOT = pathlib.Path(__file__).parents[1]
TESTS = (
    'tests/authors',
    'tests/config',
    'tests/engine',
    'tests/entities',
    'tests/evaluation',
    'tests/feedback',
    'tests/lab/experiments',
    'tests/policies',
    'tests/tasks',
    'tests/archive_test.py',
)
# Modules or folders of the package, and the least share of their branches and
# statements that tests have to cover.
TARGETS: Mapping[str, tuple[Sequence[str], float]] = {
    'registers': (['entities/registers/', 'entities/block_kinds.py'], 0.95),
    'meters': (['entities/meters.py'], 0.95),
    'feedback': (['feedback/', 'policies/'], 0.95),
    'spec loader': (['config/loading.py', 'feedback/specs.py'], 0.95),
    'ledger': (['evaluation/ledgers.py'], 1.0),
    'figures': (
        ['evaluation/episode_figures.py', 'evaluation/gains.py'],
        1.0,
    ),
    'rows': (['evaluation/results.py'], 1.0),
    'storage': (['lab/experiments/storage.py'], 1.0),
}


def measure(tests: Sequence[str]) -> dict[str, dict[str, object]]:
  """Runs tests; returns the report of coverage.py on each module, by path.

  Raises:
    RuntimeError: If a test fails.
  """
  with tempfile.TemporaryDirectory() as folder:
    report = pathlib.Path(folder, 'coverage.json')
    ran = subprocess.run(
        [
            sys.executable, '-m', 'pytest', '-q', '--no-header',
            '-p', 'no:cacheprovider', '--cov=realab_suite', '--cov-branch',
            f'--cov-report=json:{report}', *tests,
        ],
        cwd=_ROOT,
        env={**os.environ, 'COVERAGE_FILE': str(pathlib.Path(folder, 'data'))},
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    if ran.returncode:
      raise RuntimeError(f'tests fail: {ran.stdout[-2000:]}{ran.stderr}')
    files = json.loads(report.read_text())['files']
  return {
      name.removeprefix('realab_suite/'): one for name, one in files.items()
  }


def share(
    files: Mapping[str, Mapping[str, object]], places: Sequence[str]
) -> tuple[float, list[str]]:
  """Returns the covered share of statements or branches, whichever is less.

  Also returns the places that are not covered.
  """
  reached, count = np.zeros(2), np.zeros(2)
  missed = []
  for name, one in sorted(files.items()):
    if not name.startswith(tuple(places)):
      continue
    summary = one['summary']
    count += [summary['num_statements'], summary['num_branches']]
    reached += [summary['covered_lines'], summary['covered_branches']]
    where = [str(line) for line in one['missing_lines']]
    where += [f'{a}->{b}' for a, b in one['missing_branches']]
    if where:
      missed.append(f'{name}: {", ".join(where)}')
  if not count[0]:
    raise RuntimeError(f'{places} have not been measured')
  return float((reached[count > 0] / count[count > 0]).min()), missed


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  del scale
  lines = figure_lines.Lines('C45', seed)
  files = measure(TESTS)
  for name, (places, least) in TARGETS.items():
    reached, missed = share(files, places)
    lines.at_least(f'share reached, {name}', reached, least)
    if reached < least:
      for one in missed:
        print(f'  not reached: {one}')
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
