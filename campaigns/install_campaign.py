"""Campaign C46: installations, with the versions that work and with others.

Run from the root of the repository, about ten minutes; it needs a package
index:

    python -m campaigns.install_campaign [scale] [seed]

Three virtual environments are made. With the versions in `constraints.txt` the
package has to be installed and run. With `mujoco>=4` it has to be refused in
one line that names what to install. With the newest versions that pip chooses,
what comes of it is printed, and decides nothing.
"""

import os
import pathlib
import shutil
import subprocess
import tempfile
from typing import NamedTuple, final
import venv

from campaigns import figure_lines

_ROOT = pathlib.Path(__file__).parents[1]
_PATIENCE_SECONDS = 1800
_RUN = """
import numpy as np
from realab_suite import suite
env = suite.load('unlock_door', 'near', design='instantaneous_reward')
time_step = env.reset()
while not time_step.last():
  time_step = env.step(np.zeros(env.action_spec().shape))
print('ran')
"""
_VERSIONS = """
from importlib import metadata
print({n: metadata.version(n) for n in ('dm-control', 'mujoco', 'numpy')})
"""


@final
class Lane(NamedTuple):
  """What came of an installation.

  Attributes:
    problem: What pip said if it could not install; '' if it could.
    versions: What it installed.
    status: The exit status of a program that uses the package.
    said: What that said.
  """

  problem: str
  versions: str
  status: int
  said: str

  @property
  def works(self) -> bool:
    return not self.problem and not self.status and self.said == 'ran'

  @property
  def is_refused_in_one_line(self) -> bool:
    """Whether the program ended with an error that says what to install."""
    *_, last = self.said.splitlines() or ['']
    return (
        not self.problem
        and self.status == 1
        and last.startswith('realab_suite._versions.DependencyError: ')
        and 'run: python -m pip install "dm-control' in last
    )


def install(folder: pathlib.Path, *steps: list[str]) -> Lane:
  """Makes an environment, installs into it step by step, and runs a world."""
  venv.create(folder, with_pip=True, clear=True)
  python = str(folder / 'bin' / 'python')
  for step in steps:
    ran = _run([python, '-m', 'pip', 'install', '-q', *step])
    if ran.returncode:
      return Lane(ran.stderr.strip(), '', ran.returncode, '')
  versions = _run([python, '-c', _VERSIONS]).stdout.strip()
  ran = _run([python, '-c', _RUN], MUJOCO_GL='disable')
  said = (ran.stdout + ran.stderr).strip()
  return Lane('', versions, ran.returncode, said)


def _run(
    command: list[str], **environment: str
) -> subprocess.CompletedProcess[str]:
  return subprocess.run(
      command,
      cwd=tempfile.gettempdir(),
      env={**os.environ, **environment},
      capture_output=True,
      text=True,
      timeout=_PATIENCE_SECONDS,
      check=False,
  )


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  del scale
  lines = figure_lines.Lines('C46', seed)
  with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    # A copy, as building leaves files behind.
    for part in ('realab_suite', 'configs'):
      shutil.copytree(_ROOT / part, folder / 'package' / part)
    for part in ('setup.cfg', 'pyproject.toml', 'README.md', 'LICENSE'):
      shutil.copy(_ROOT / part, folder / 'package')
    package = str(folder / 'package')
    pinned = install(
        folder / 'pinned', ['-c', str(_ROOT / 'constraints.txt'), package]
    )
    too_new = install(
        folder / 'too_new', [package], ['--no-deps', '-U', 'mujoco>=4']
    )
    latest = install(folder / 'latest', ['-U', package])
  lines.at_least('pinned lane works', pinned.works, 1)
  lines.at_least(
      'mujoco>=4 is refused in one line', too_new.is_refused_in_one_line, 1
  )
  for label, lane in (
      ('pinned', pinned), ('mujoco>=4', too_new), ('latest', latest)
  ):  # fmt: skip
    said = (lane.problem or lane.said).splitlines()[-1:]
    print(f'  {label}: {lane.versions} status {lane.status}: {said}')
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
