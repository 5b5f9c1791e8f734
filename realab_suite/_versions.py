"""Refuses a dm-control and mujoco that do not work together, and says why.

dm-control 1.0.50 names no upper bound for mujoco, so a plain `pip install` may
bring a mujoco with which every world fails at its first step, far from the
cause. The versions are looked up without importing either package.
"""

from importlib import metadata
import re

from realab_suite import errors

# Package, lowest version that works, first version that does not; the same
# ranges stand in setup.cfg.
_RANGES = (
    ('dm-control', '1.0.50', '2'),
    ('mujoco', '3.17', '4'),
)


class DependencyError(errors.RealabError, ImportError):
  """The installed dm-control and mujoco are not a pair that works."""


def check() -> None:
  """Checks the installed versions of dm-control and mujoco.

  Raises:
    DependencyError: If either is missing or outside its range; the message
      gives what was found, what is needed and the command that mends it.
  """
  installed = {name: _installed(name) for name, _, _ in _RANGES}
  if all(_fits(installed[name], low, high) for name, low, high in _RANGES):
    return
  found = ' and '.join(f'{n} {v or "missing"}' for n, v in installed.items())
  needed = ' and '.join(f'{n}>={low},<{high}' for n, low, high in _RANGES)
  quoted = ' '.join(f'"{n}>={low},<{high}"' for n, low, high in _RANGES)
  raise DependencyError(
      f'realab_suite: found {found}; needs {needed};'
      f' run: python -m pip install {quoted}'
  )


def _installed(name: str) -> str | None:
  try:
    return metadata.version(name)
  except metadata.PackageNotFoundError:
    return None


def _fits(version: str | None, low: str, high: str) -> bool:
  if version is None:
    return False
  return _release(low) <= _release(version) < _release(high)


def _release(version: str) -> tuple[int, ...]:
  """Returns the leading numbers: (3, 17, 0) for '3.17.0.dev1'."""
  leading = re.match(r'\d+(\.\d+)*', version)
  return tuple(int(n) for n in leading[0].split('.')) if leading else ()
