"""The flag by which programs learn of registers, tasks and more of a user's."""

import importlib

from absl import flags

from realab_suite import errors

_IMPORT = flags.DEFINE_multi_string(
    'import',
    [],
    'A module to import first, as in --import=my_registers: one of yours that'
    ' adds registers, providers, tasks, policies or learners. May be repeated.',
)


def load() -> None:
  """Imports the modules; not before a renderer has been chosen.

  Raises:
    SpecError: If one cannot be found.
  """
  for name in _IMPORT.value:
    if not all(part.isidentifier() for part in name.split('.')):
      raise errors.SpecError(
          f'--import={name:.80}: not the name of a module; allowed are names as'
          ' in my_registers or my_package.registers'
      )
    try:
      importlib.import_module(name)
    except ModuleNotFoundError as error:
      raise errors.SpecError(
          f'--import={name}: {error}; allowed are modules in the working'
          ' directory and installed ones'
      ) from error


def arguments() -> list[str]:
  """Returns the flags that tell another program to do the same."""
  return [f'--import={name}' for name in _IMPORT.value]
