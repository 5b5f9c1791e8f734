"""The version of this package, and a check of dm-control and mujoco.

dm-control 1.0.50 has no upper bound for mujoco, so `pip install` may install a
version of mujoco with which every world fails at its first step, with an error
that does not name the cause. The check imports neither package.
"""

from importlib import metadata
import re

from realab_suite import errors

VERSION = '0.3.0'
"""Version of this package, which setup.cfg reads."""

# Package, lowest version that works, first version that does not. setup.cfg
# contains the same ranges.
_RANGES = (
    ('dm-control', '1.0.50', '2'),
    ('mujoco', '3.17', '4'),
)
# pip cannot install these over mujoco 3: with it, it removes what is theirs.
_MUJOCO_4 = 'mujoco', 'mujoco-core', 'mujoco-studio'


class DependencyError(errors.RealabError, ImportError):
  """The installed versions of dm-control and mujoco do not work together."""


def check() -> None:
  """Checks the installed versions of dm-control and mujoco.

  Raises:
    DependencyError: If either is missing or outside its range; the message
      gives the installed and the needed versions, and the command that installs
      them.
  """
  installed = {name: _installed(name) for name, _, _ in _RANGES}
  if all(_fits(installed[name], low, high) for name, low, high in _RANGES):
    return
  present = ' and '.join(f'{n} {v or "missing"}' for n, v in installed.items())
  needed = ' and '.join(f'{n}>={low},<{high}' for n, low, high in _RANGES)
  remove = ''
  if _release(installed['mujoco'] or '') >= (4,):
    remove = f'python -m pip uninstall -y {" ".join(_MUJOCO_4)}; '
  quoted = ' '.join(f'"{n}>={low},<{high}"' for n, low, high in _RANGES)
  raise DependencyError(
      f'realab_suite: found {present}; needs {needed};'
      f' run: {remove}python -m pip install {quoted}'
  )


def _installed(name: str) -> str | None:
  """Returns the version of a package, or `None` if it is not installed."""
  try:
    return metadata.version(name)
  except metadata.PackageNotFoundError:
    return None


def _fits(version: str | None, low: str, high: str) -> bool:
  """Returns True if a version is at least `low` and below `high`."""
  if version is None:
    return False
  return _release(low) <= _release(version) < _release(high)


def _release(version: str) -> tuple[int, ...]:
  """Returns the leading numbers of a version: (3, 17, 0) for '3.17.0.dev1'."""
  leading = re.match(r'\d+(\.\d+)*', version)
  return tuple(int(n) for n in leading[0].split('.')) if leading else ()
