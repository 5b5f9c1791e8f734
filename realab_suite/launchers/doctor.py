r"""Says what works in this installation, and how to repair what does not.

  python -m realab_suite.launchers.doctor

The exit status is 0 if worlds can be loaded and stepped, and 1 if not. Extras
and rendering are optional.
"""

from collections.abc import Mapping
from importlib import metadata
import os
import platform
from typing import NamedTuple, final

from realab_suite.lab.experiments import requirements
from realab_suite.launchers import program
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
_STEPS_A_WORLD = """
from realab_suite import suite
env = suite.load('unlock_door', 'near', {'random': 0},
                 design='instantaneous_reward')
env.reset()
env.step(0.0 * env.action_spec().minimum)
"""
_CORE_REMEDY = (
    'python -m pip install --force-reinstall -e . -c constraints.txt, in the'
    ' clone'
)
_RENDERING_REMEDY = (
    'without a display, install EGL (Debian, Ubuntu: sudo apt install libegl1'
    ' libgl1 libgl1-mesa-dri) and set MUJOCO_GL=egl; or install OSMesa'
    ' (libosmesa6) and set MUJOCO_GL=osmesa; with a display, set MUJOCO_GL=glfw'
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
        ('matplotlib', 'jinja2', 'imageio', 'av', 'PIL', 'pyarrow'),
        'reports, plots and films',
    ),
    'rpc': Extra(('dm_env_rpc', 'grpc'), 'worlds for other processes'),
    'gym': Extra(('gymnasium', 'moviepy'), 'the interface of Gymnasium'),
    'sb3': Extra(('stable_baselines3',), 'training with Stable-Baselines3'),
    'data': Extra(
        ('pyarrow', 'minari', 'gymnasium', 'h5py', 'PIL'),
        'exports to Parquet and Minari',
    ),
    'browser': Extra(('websockets', 'PIL'), 'pages for people who supervise'),
    'cluster': Extra(('ray', 'submitit'), 'sweeps on a cluster'),
    'docs': Extra(
        ('sphinx', 'furo', 'myst_nb'), 'the site of the documentation'
    ),
    'dev': Extra(
        ('pytest', 'xdist', 'hypothesis', 'ruff', 'pyink', 'mypy'),
        'tests of this package',
    ),
}


def versions() -> str:
  """Returns the versions of this package, Python and the main packages."""
  entries = [f'Python {platform.python_version()}']
  for name in _PACKAGES:
    try:
      entries.append(f'{name} {metadata.version(name)}')
    except metadata.PackageNotFoundError:
      entries.append(f'{name} missing')
  if 'realab' in (version := _labmaze()):
    entries.append(f'labmaze {version}, a stand-in with other mazes')
  return ', '.join(entries)


def _labmaze() -> str:
  """Returns the version of labmaze, or of its stand-in, or an empty string."""
  try:
    return metadata.version('labmaze')
  except metadata.PackageNotFoundError:
    return ''


def _tell(name: str, text: str, remedy: str = '') -> None:
  """Prints the result of a check, with a remedy if something does not work."""
  program.say(f'{"--" if remedy else "ok"}  {name:10} {text}')
  if remedy:
    program.say(f'{"":14} to repair: {remedy}')


def main() -> int:
  """Runs the checks and prints their results.

  Returns:
    0 if the core works, otherwise 1.
  """
  program.say(versions())
  core = renderers.problem_of(_STEPS_A_WORLD, 'step', os.environ)
  if core:
    _tell('core', f'cannot step a world: {core}', _CORE_REMEDY)
  else:
    _tell('core', 'works: a world was loaded and stepped')
  problem = renderers.choose_renderer()
  if problem is None:
    _tell('rendering', f'works with MUJOCO_GL={os.environ["MUJOCO_GL"]}')
  else:
    _tell('rendering', f'no camera works: {problem}', _RENDERING_REMEDY)
  for name, extra in EXTRAS.items():
    problem = requirements.missing(*extra.modules, extra=name)
    absent, _, remedy = (problem or 'installed').partition('; run: ')
    _tell(name, f'{absent}, for {extra.purpose}', remedy)
  return 1 if core else 0


if __name__ == '__main__':
  program.start(main)
