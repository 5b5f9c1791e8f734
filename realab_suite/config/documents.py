"""Loading of specs by name, from files and from mappings."""

from collections.abc import Mapping, Sequence
import copy
import functools
import os
import pathlib
from typing import Any, Generic, TypeVar, final

from realab_suite import errors
from realab_suite import sources
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import validation

_Spec = TypeVar('_Spec', bound=validation.Spec)

Source = str | os.PathLike[str] | Mapping[str, Any]


@functools.cache
def folder_of_configs() -> pathlib.Path:
  """Returns the folder of the files that belong to the code: beside it.

  Another checkout may be installed, so `realab_suite.configs` may be its files.

  Raises:
    SpecError: If the code has no such folder.
  """
  package = sources.FOLDER
  folders = package / 'configs', package.parent / 'configs'
  for folder in folders:
    if (folder / 'golden.yaml').is_file():
      return folder
  raise errors.SpecError(
      f'{package}: this code has no designs; they must be in'
      f' {" or ".join(map(str, folders))}'
  )


def shipped(folder: str, ending: str) -> dict[str, pathlib.Path]:
  """Returns the files that are part of the package, by their names.

  Args:
    folder: Name of a folder of `folder_of_configs`.
    ending: Ending of the files, which is no part of their names.
  """
  files = (folder_of_configs() / folder).iterdir()
  return {
      file.name.removesuffix(ending): file
      for file in sorted(files, key=lambda file: file.name)
      if file.name.endswith(ending)
  }


@final
class Documents(Generic[_Spec]):
  """YAML files of one kind, some of which are part of the package.

  Attributes:
    names: Names of the files that are part of the package.
  """

  def __init__(self, what: str, model: type[_Spec], folder: str) -> None:
    """Finds the files of the package.

    Args:
      what: Kind of the files, for messages: 'design'.
      model: Class of their specs, with a field `name`.
      folder: Name of a folder of `folder_of_configs`.
    """
    self._what = what
    self._model = model
    self._files = shipped(folder, '.yaml')
    self._parsed: dict[str, dict[str, Any]] = {}
    self.names: tuple[str, ...] = tuple(self._files)

  def load(
      self,
      source: Source | _Spec,
      overrides: Sequence[str] = (),
  ) -> _Spec:
    """Loads and validates a spec.

    Args:
      source: Name of a file of the package, path of a YAML file, mapping, or
        spec.
      overrides: Dotted overrides; see `loading.apply_overrides`.

    Raises:
      SpecError: If the source or an override is wrong; the message is one line
        with the file, the key path and the allowed values.
      UnknownNameError: If there is no file of this name.
    """
    if isinstance(overrides, str) or not isinstance(overrides, Sequence):
      raise errors.SpecError(
          f'overrides: {messages.quote(overrides)}; must be a list of'
          " strings, such as ['channel=secure']"
      )
    if isinstance(source, self._model) and not overrides:
      return source
    where, data = self._read(source)
    return validation.validate(self._model, data, where, overrides)

  def _read(self, source: Source | _Spec) -> tuple[str, dict[str, Any]]:
    """Returns the name of a source for messages, and its data."""
    what = self._what
    if isinstance(source, self._model):
      data = source.to_source()
      return f'{what} {data["name"]!r}', data
    if isinstance(source, Mapping):
      return what, loading.read_mapping(source)
    if not isinstance(source, str | os.PathLike):
      raise errors.SpecError(
          f'{what}: {messages.quote(source)}; must be a name, a path, a'
          f' mapping or a {self._model.__name__}'
      )
    if isinstance(source, str) and source in self._files:
      if source not in self._parsed:  # Files of the package stay what they are.
        text = self._files[source].read_bytes()
        self._parsed[source] = loading.parse_yaml(text, f'{source}.yaml')
      return f'{source}.yaml', copy.deepcopy(self._parsed[source])
    where = os.path.expanduser(source)
    if isinstance(source, str) and not os.path.exists(where):
      raise errors.UnknownNameError(
          f'{what} {messages.quote(source)} is neither a file nor one of'
          f' {list(self.names)}{messages.did_you_mean(source, self.names)}'
      )
    return where, loading.read_mapping(where)
