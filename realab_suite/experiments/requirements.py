"""Says which packages of an extra are missing, and how to install them."""

from importlib import util


def missing(*modules: str, extra: str = 'report') -> str | None:
  """Returns which modules are not installed, with the remedy, or `None`.

  Args:
    *modules: Names of modules.
    extra: The extra of this package that installs them.
  """
  absent = [name for name in modules if util.find_spec(name) is None]
  if not absent:
    return None
  return (
      f'{", ".join(absent)} not installed; run: python -m pip install'
      f' "realab-suite[{extra}]"'
  )
