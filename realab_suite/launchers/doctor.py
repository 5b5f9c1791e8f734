r"""Says what works in this installation, and how to repair what does not.

  python -m realab_suite.launchers.doctor

The exit status is 0 if worlds can be loaded and stepped, and 1 if not.
Learners and rendering are optional. Programs name an extra that they miss.
"""

from importlib import metadata
import os
import platform

from realab_suite import sources
from realab_suite.config import documents
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
_MAKES_A_LEARNER = """
from realab_suite import suite
from realab_suite.lab import agents
env = suite.load('unlock_door', 'near', design='instantaneous_reward')
learner = agents.make(env.mechanism.design.learner, env.observation_spec(),
                      env.action_spec(), num_envs=1, seed=0)
"""
_CORE_REMEDY = (
    'python -m pip install --force-reinstall -e . -c constraints.txt, in the'
    ' clone'
)
_LEARNERS_REMEDY = (
    'change the variable that the problem names, or python -m pip install -e'
    " '.[agents]' -c constraints.txt, in the clone"
)
_RENDERING_REMEDY = (
    'without a display, install EGL (Debian, Ubuntu: sudo apt install libegl1'
    ' libgl1 libgl1-mesa-dri) and set MUJOCO_GL=egl; or install OSMesa'
    ' (libosmesa6) and set MUJOCO_GL=osmesa; with a display, set MUJOCO_GL=glfw'
)


def versions() -> str:
  """Returns the versions of this package, Python and the main packages."""
  entries = [f'{name} {_version(name) or "missing"}' for name in _PACKAGES]
  if 'realab' in (version := _version('labmaze')):
    entries.append(f'labmaze {version}, a stand-in with other mazes')
  return ', '.join([f'Python {platform.python_version()}', *entries])


def _version(package: str) -> str:
  """Returns the version of a package, or an empty string without it."""
  try:
    return metadata.version(package)
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
  designs = documents.folder_of_configs()
  _tell(
      'code', f'{sources.digest()}, of {sources.FOLDER}; designs of {designs}'
  )
  core = renderers.problem_of(_STEPS_A_WORLD, 'step', os.environ)
  if core:
    _tell('core', f'cannot step a world: {core}', _CORE_REMEDY)
  else:
    _tell('core', 'works: a world was loaded and stepped')
  problem = requirements.missing('jax', 'equinox', 'optax', extra='agents')
  problem = problem or renderers.problem_of(
      _MAKES_A_LEARNER, 'learner', os.environ
  )
  if problem:
    _tell('learners', f'cannot make one: {problem}', _LEARNERS_REMEDY)
  else:
    _tell('learners', 'work: a small one was made')
  problem = renderers.choose_renderer()
  if problem is None:
    _tell('rendering', f'works with MUJOCO_GL={os.environ["MUJOCO_GL"]}')
  else:
    _tell('rendering', f'no camera works: {problem}', _RENDERING_REMEDY)
  return 1 if core else 0


if __name__ == '__main__':
  program.start(main)
