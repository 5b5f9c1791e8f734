"""Check for the packages of an extra, with instructions to install them."""

from importlib import util

from realab_suite import sources


def missing(*modules: str, extra: str = 'report') -> str | None:
  """Returns a message about modules that are not installed, or `None`.

  Args:
    *modules: Names of modules.
    extra: Extra of this package that installs them.
  """
  absent = [name for name in modules if util.find_spec(name) is None]
  if not absent:
    return None
  if (sources.FOLDER.parent / 'setup.cfg').is_file():
    what = f"-e '.[{extra}]' -c constraints.txt, in the clone"
  else:
    what = f"'realab-suite[{extra}]'"
  return f'{", ".join(absent)} not installed; run: python -m pip install {what}'
