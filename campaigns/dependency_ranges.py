"""Installs the newest and the oldest allowed packages, and tries the package.

  python -m campaigns.dependency_ranges build/ranges

Needs uv and Python 3.11 or 3.12. Unlike `make test`, it has no constraints: one
environment has the newest versions that setup.cfg allows, the other its lower
bounds. In each, the doctor and small tests run, the trained agents among them;
in the tests, a warning of any package is a failure.
"""

import pathlib
import subprocess
import sys

_RESOLUTIONS = {'newest': 'highest', 'oldest': 'lowest-direct'}
# setup.cfg has no lower bounds of tools.
_TOOLS = ('pytest>=9', 'hypothesis>=6.100')
_EXTRAS = 'agents,report,rpc,gym'

TRIES = (
    'pytest -q -p no:cacheprovider tests/policies tests/suite_test.py'
    ' tests/golden_test.py tests/engine/identity_test.py'
    ' tests/lab/agents/learners_test.py tests/reports/report_test.py'
    ' tests/doors/gymnasium',
)
"""Arguments of Python that try an installation, in a clone."""


def main() -> int:
  """Tries both in a folder, and returns the number of failures."""
  folder = pathlib.Path(sys.argv[1])
  failures = 0
  for name, resolution in _RESOLUTIONS.items():
    env = folder / name
    python = env / 'bin' / 'python'
    commands = [
        ['uv', 'venv', '-q', '--clear', '--python', sys.executable, env],
        [
            *('uv', 'pip', 'install', '-q', '--python', python),
            *('--resolution', resolution, '-e', f'.[{_EXTRAS}]', *_TOOLS),
        ],
        ['uv', 'pip', 'freeze', '--python', python],
        [python, '-m', 'realab_suite.launchers.doctor'],
        *([python, '-m', *words.split()] for words in TRIES),
    ]
    for command in commands:
      print(f'{name}:', *command, flush=True)
      failures += subprocess.run(command, check=False).returncode != 0
  return failures


if __name__ == '__main__':
  sys.exit(main())
