"""Flag `--import`, which loads modules with extensions of the package."""

import importlib

from absl import flags

from realab_suite import errors

_IMPORT = flags.DEFINE_multi_string(
    'import',
    [],
    'Module to import first, such as --import=my_registers. It can add'
    ' registers, providers, tasks, policies or learners',
)


def load() -> None:
  """Imports the modules; a renderer has to be chosen first.

  Raises:
    SpecError: If a module cannot be found.
  """
  for name in _IMPORT.value:
    if not all(part.isidentifier() for part in name.split('.')):
      raise errors.SpecError(
          f'--import={name:.80}: not the name of a module; allowed are names'
          ' such as my_registers or my_package.registers'
      )
    try:
      importlib.import_module(name)
    except ModuleNotFoundError as error:
      raise errors.SpecError(
          f'--import={name}: {error}; allowed are modules in the working'
          ' directory and installed ones'
      ) from error


def arguments() -> list[str]:
  """Returns command-line arguments with which a program does the same."""
  return [f'--import={name}' for name in _IMPORT.value]
