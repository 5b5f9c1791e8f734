r"""Says what works in this installation, and how to repair what does not.

  python -m realab_suite.doctor

The exit status is 0 if worlds can be loaded and stepped, and 1 if not. Extras
and rendering are optional.
"""

from collections.abc import Iterator, Mapping
from importlib import metadata
import os
import platform
import subprocess
import sys
from typing import NamedTuple, final

from realab_suite.experiments import requirements
from realab_suite.launchers import renderers

# Packages whose versions decide what happens.
_PACKAGES = (
    'realab-suite',
    'dm-control',
    'mujoco',
    'dm-env',
    'numpy',
    'pydantic',
)
# Enough time to import everything on a slow machine under load.
_PATIENCE_SECONDS = 300
_STEPS_A_WORLD = """
from realab_suite import suite
env = suite.load('unlock_door', 'near', {'random': 0},
                 design='instantaneous_reward')
env.reset()
env.step(0.0 * env.action_spec().minimum)
"""
_RENDERING_REMEDY = (
    'without a display, install EGL (Debian, Ubuntu: sudo apt install libegl1'
    ' libgl1-mesa-dri) and set MUJOCO_GL=egl; or install OSMesa (libosmesa6)'
    ' and set MUJOCO_GL=osmesa; with a display, set MUJOCO_GL=glfw'
)


@final
class Extra(NamedTuple):
  """An extra of this package.

  Attributes:
    modules: Modules that it installs.
    purpose: What it is for.
  """

  modules: tuple[str, ...]
  purpose: str


EXTRAS: Mapping[str, Extra] = {
    'agents': Extra(('jax', 'equinox', 'optax'), 'learners'),
    'report': Extra(
        ('matplotlib', 'jinja2', 'imageio', 'av', 'PIL'),
        'reports, plots and films',
    ),
    'tb': Extra(('tensorboardX',), 'learning curves for TensorBoard'),
    'rpc': Extra(('dm_env_rpc', 'grpc'), 'worlds for other processes'),
    'gym': Extra(('gymnasium',), 'the interface of Gymnasium'),
    'sb3': Extra(('stable_baselines3',), 'training with Stable-Baselines3'),
    'data': Extra(
        ('pyarrow', 'minari', 'gymnasium', 'h5py', 'PIL'),
        'exports to Parquet and Minari',
    ),
    'browser': Extra(
        ('viser', 'mjviser', 'websockets', 'PIL'),
        'replays in 3D and pages for people',
    ),
    'cluster': Extra(('ray', 'submitit'), 'sweeps on a cluster'),
    'docs': Extra(
        ('sphinx', 'furo', 'myst_nb'), 'the site of the documentation'
    ),
    'dev': Extra(
        ('pytest', 'xdist', 'hypothesis', 'ruff', 'pyink', 'mypy'),
        'tests of this package',
    ),
}


@final
class Finding(NamedTuple):
  """Result of a check.

  Attributes:
    name: What was checked.
    works: False if it does not work.
    text: Description of the result.
    remedy: How to repair it, if it does not work.
    is_core: True if nothing works without it.
  """

  name: str
  works: bool
  text: str
  remedy: str = ''
  is_core: bool = False


def versions() -> str:
  """Returns the versions of this package, Python and the main packages."""
  found = [f'Python {platform.python_version()}']
  for name in _PACKAGES:
    try:
      found.append(f'{name} {metadata.version(name)}')
    except metadata.PackageNotFoundError:
      found.append(f'{name} missing')
  return ', '.join(found)


def findings() -> Iterator[Finding]:
  """Runs the checks, the slow ones in processes of their own."""
  yield _core()
  problem = renderers.choose_renderer()
  if problem is None:
    renderer = os.environ['MUJOCO_GL']
    yield Finding('rendering', True, f'works with MUJOCO_GL={renderer}')
  else:
    yield Finding(
        'rendering',
        False,
        f'no camera works: {problem}',
        _RENDERING_REMEDY,
    )
  for name, extra in EXTRAS.items():
    problem = requirements.missing(*extra.modules, extra=name)
    if problem is None:
      yield Finding(name, True, f'installed, for {extra.purpose}')
    else:
      absent, _, command = problem.partition('; run: ')
      yield Finding(name, False, f'{absent}, for {extra.purpose}', command)


def _core() -> Finding:
  """Loads and steps a world, in a process that may crash."""
  try:
    ran = subprocess.run(
        [sys.executable, '-c', _STEPS_A_WORLD],
        capture_output=True,
        text=True,
        timeout=_PATIENCE_SECONDS,
        check=False,
    )
  except subprocess.TimeoutExpired:
    problem = f'no step within {_PATIENCE_SECONDS} s'
  else:
    if not ran.returncode:
      return Finding(
          'core', True, 'works: a world was loaded and stepped', is_core=True
      )
    complaint = ran.stderr.strip().splitlines()
    problem = complaint[-1] if complaint else f'exit status {ran.returncode}'
  return Finding(
      'core',
      False,
      f'cannot step a world: {problem}',
      'python -m pip install --force-reinstall -e . -c constraints.txt, in the'
      ' clone',
      is_core=True,
  )


def main() -> int:
  """Prints the findings.

  Returns:
    0 if the core works, otherwise 1.
  """
  sys.stdout.write(f'{versions()}\n')
  status = 0
  for finding in findings():
    mark = 'ok  ' if finding.works else '--  '
    sys.stdout.write(f'{mark}{finding.name:10} {finding.text}\n')
    if finding.remedy:
      sys.stdout.write(f'{"":14} to repair: {finding.remedy}\n')
    if finding.is_core and not finding.works:
      status = 1
    sys.stdout.flush()
  return status


if __name__ == '__main__':
  sys.exit(main())
