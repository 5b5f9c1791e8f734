"""Policies, providers and registers that open all files of their options.

They represent third-party code: each declares its paths in another way, and
opens them in its constructor.
"""

from collections.abc import Iterator, Sequence
import contextlib
from typing import Annotated, Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from tests.engine import helpers
from tests.feedback import stubs


def _open(*paths: Any) -> None:
  """Opens the paths that are not empty."""
  for path in paths:
    if path and isinstance(path, str):
      try:
        open(path, 'rb').close()
      except OSError as error:
        raise errors.SpecError(f'{path!r}: {error.strerror}') from error


class Model(pydantic.BaseModel):
  """A model with a path."""

  label: str = ''
  file: option_types.FilePath = ''


class _Opaque:
  """Class whose instances a file cannot contain."""


class Reader(stubs.Idle):
  """Declares paths in many ways."""

  def __init__(
      self,
      file: option_types.FilePath = '',
      opaque: option_types.FilePath | _Opaque = '',
      files: 'Sequence[option_types.FilePath]' = (),
      models: Sequence[Model] = (),
      label: str = '',
  ) -> None:
    del label
    _open(file, opaque, *files, *(model.get('file') for model in models))


@final
class Inheriting(Reader):
  """Passes its other options on."""

  def __init__(self, mine: int = 0, **kwargs: Any) -> None:
    del mine
    super().__init__(**kwargs)


@final
class Wrapping(stubs.Idle):
  """Runs another policy."""

  def __init__(
      self,
      inner: Annotated[str, option_types.NameIn(policies.POLICIES)] = 'no_op',
      inner_options: Annotated[
          dict[str, Any] | None,
          option_types.OptionsOf(policies.POLICIES, 'inner'),
      ] = None,
  ) -> None:
    self._inner = policies.make(inner, **(inner_options or {}))


def read(file: option_types.FilePath = '', label: str = '') -> policies.Policy:
  """Makes a policy: a function instead of a class."""
  return Reader(file=file, label=label)


@final
class ReadingProvider(stubs.Zero):
  """A provider with paths as fields, and two policies."""

  kind: Literal['test_reading'] = 'test_reading'
  label: str = ''
  file: option_types.FilePath = ''
  more: Model | None = None
  teacher: Annotated[str, option_types.NameIn(policies.POLICIES)] = 'no_op'
  teacher_options: Annotated[
      dict[str, Any], option_types.OptionsOf(policies.POLICIES, 'teacher')
  ] = pydantic.Field(default_factory=dict)

  def check(self, design: Any) -> None:
    del design
    _open(self.file, self.more and self.more.file)
    policies.make(self.teacher, **self.teacher_options)


@final
class ReadingRegister(stubs.Still):
  """A register that reads a file."""

  def _build(
      self,
      name: str,
      *,
      file: option_types.FilePath = '',
      label: str = '',
      **kwargs: Any,
  ) -> None:
    del label
    _open(file)
    super()._build(name, **kwargs)


@contextlib.contextmanager
def registered() -> Iterator[None]:
  """Registers all classes while the context is active."""
  with contextlib.ExitStack() as stack:
    for names, name, entry in (
        (policies.POLICIES, 'test_reader', Reader),
        (policies.POLICIES, 'test_inheriting', Inheriting),
        (policies.POLICIES, 'test_wrapping', Wrapping),
        (policies.POLICIES, 'test_function', read),
        (providers.PROVIDERS, 'test_reading', ReadingProvider),
        (register_kinds.REGISTER_KINDS, 'test_reading', ReadingRegister),
    ):
      stack.enter_context(helpers.registered(names, name, entry))
    yield
