"""Names and types of options: keyword arguments of registered classes.

A design names a policy, a value function or a kind of register, and gives it
`options`. The parameters of the class declare the options, and their
annotations declare the types, including constraints such as
`Annotated[float, pydantic.Field(gt=0)]`. An option that is the path of a file
has the type `FilePath`; `validation` checks whether it may be opened.
"""

from collections.abc import Callable, Iterator, Mapping
import functools
import inspect
import json
import operator
import os
import pathlib
import types
import typing
from typing import Annotated, Any, final

import pydantic
from pydantic_core import core_schema

from realab_suite import errors
from realab_suite.config import registry

_IS_PATH = object()

FilePath = Annotated[str, _IS_PATH]
"""Path of a file.

`specs.load` finds options and fields of this type at any depth of a design. It
refuses paths in a file that lead out of the working directory, before any of
them is opened. `os.PathLike` and `pathlib.Path` declare paths as well.
"""

# Types of the values that a file can contain.
_PLAIN = (str, int, float, bool, types.NoneType, list, dict)
_BY_NAME = (
    inspect.Parameter.POSITIONAL_OR_KEYWORD,
    inspect.Parameter.KEYWORD_ONLY,
)


@final
class NameIn:
  """Annotation of a field or option whose value is a name in a registry."""

  def __init__(self, names: registry.Registry[Any]) -> None:
    self._names = names

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    return core_schema.no_info_after_validator_function(
        self._validated, handler(source)
    )

  def _validated(self, name: str) -> str:
    try:
      self._names.get(name)
    except errors.UnknownNameError as error:
      raise ValueError(str(error)) from error
    return name


@final
class OptionsOf:
  """Annotation of a field or option that contains the options of a class.

  The value is checked and stays unchanged. Defaults are not filled in, so that
  a design and its digest do not depend on the defaults of a class.
  """

  def __init__(
      self,
      names: registry.Registry[Any],
      field: str,
      *,
      method: str = '__init__',
      reserved: Callable[..., Any] | None = None,
  ) -> None:
    """Makes the annotation.

    Args:
      names: Registry of the class.
      field: Field or option beside this one that contains the name. It must be
        declared before this one.
      method: Method of a class whose parameters are the options.
      reserved: Function whose parameters are not options, because their values
        come from elsewhere.
    """
    self._names = names
    self._field = field
    self._method = method
    self._reserved = reserved

  def members(self, siblings: Mapping[str, Any]) -> 'list[Options]':
    """Returns the options as a type, for `annotations`."""
    try:
      declared = self._declared(siblings)
    except ValueError:  # Validation reports it.
      return []
    return [] if declared is None else [declared]

  def _declared(self, siblings: Mapping[str, Any]) -> 'Options | None':
    """Returns the declared options, or `None` if the name is unknown.

    Args:
      siblings: Values of the fields or options beside this one, by name.

    Raises:
      ValueError: If the declaration of the options cannot be read.
    """
    name = siblings.get(self._field)
    if not isinstance(name, str) or name not in self._names:
      return None
    try:
      return declared_by(self._names.get(name), self._method, self._reserved)
    except (NameError, TypeError, ValueError) as error:
      raise _unreadable(name, error) from error

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    return core_schema.with_info_after_validator_function(
        self._validated, handler(source)
    )

  def _validated(self, value: Any, info: pydantic.ValidationInfo) -> Any:
    siblings = info.data or {}
    declared = self._declared(siblings) if value else None
    if declared is not None:
      try:
        declared.check(value)
      except NameError as error:
        raise _unreadable(siblings[self._field], error) from error
    return value


@final
class Options:
  """Options that a class or function declares.

  Attributes:
    annotations: Types, by name; `Any` for an option without annotation.
    defaults: Values of optional options, by name.
    others: Type of options with any other name, or `None` if no other name is
      allowed.
  """

  def __init__(
      self,
      annotations: Mapping[str, Any],
      defaults: Mapping[str, Any],
      others: Any,
  ) -> None:
    self.annotations = annotations
    self.defaults = defaults
    self.others = others

  def check(self, given: Mapping[str, Any]) -> None:
    """Checks the names of options, and the types that plain data can have.

    Args:
      given: Plain data, as in a file.

    Raises:
      NameError: If a type is a string that names no type.
      ValueError: If an option is unknown, missing or of another type, or is not
        plain data.
    """
    try:
      text = json.dumps(given)
    except TypeError as error:
      raise ValueError(f'expected plain data: {error}') from error
    # JSON has the types of a file: a list may become a tuple, but a string
    # never becomes a number.
    adapter = pydantic.TypeAdapter(Annotated[Any, self])
    adapter.validate_json(text, strict=True)

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    del source
    fields = {}
    for name, annotation in self.annotations.items():
      schema = _schema(annotation, handler)
      if name in self.defaults:
        schema = core_schema.with_default_schema(
            schema, default=self.defaults[name]
        )
      fields[name] = core_schema.typed_dict_field(
          schema, required=name not in self.defaults
      )
    if self.others is None:
      return core_schema.typed_dict_schema(fields, extra_behavior='forbid')
    return core_schema.typed_dict_schema(
        fields,
        extras_schema=_schema(self.others, handler),
        extra_behavior='allow',
    )


def declared_by(
    factory: Callable[..., Any],
    method: str = '__init__',
    reserved: Callable[..., Any] | None = None,
) -> Options:
  """Returns the options that a class or function declares.

  A method with `**kwargs` is assumed to pass them on to the method that it
  overrides, so the options of base classes are included.

  Args:
    factory: Class or function.
    method: Method of a class whose parameters are the options.
    reserved: Function whose parameters are not options.

  Raises:
    NameError: If an annotation is a string that names no type.
    TypeError: If `factory` has no signature.
    ValueError: If `factory` has no signature.
  """
  if isinstance(factory, functools.partial):
    whole = declared_by(factory.func, method, reserved)
    free = list(whole.annotations)[len(factory.args) :]
    return Options(
        {name: whole.annotations[name] for name in free},
        {**whole.defaults, **factory.keywords},
        whole.others,
    )
  annotations: dict[str, Any] = {}
  defaults: dict[str, Any] = {}
  others: Any = None
  taken = inspect.signature(reserved).parameters if reserved else ()
  for signature in _signatures(factory, method):
    others = None
    for name, parameter in signature.parameters.items():
      annotation = parameter.annotation
      if annotation is parameter.empty:
        annotation = Any
      if parameter.kind is parameter.VAR_KEYWORD:
        others = annotation
      elif (
          parameter.kind in _BY_NAME
          and name not in taken
          and name not in annotations
      ):
        annotations[name] = _without_opaque_members(annotation)
        if parameter.default is not parameter.empty:
          defaults[name] = parameter.default
    if others is None:
      break
  return Options(annotations, defaults, others)


def _unreadable(name: str, error: Exception) -> ValueError:
  return ValueError(
      f'the options of {name!r} cannot be read from its signature: {error}'
  )


def is_path(annotation: Any) -> bool:
  """Returns True if an annotation other than a union declares a path."""
  if typing.get_origin(annotation) is Annotated:
    return _IS_PATH in typing.get_args(annotation)[1:]
  plain = typing.get_origin(annotation) or annotation
  return isinstance(plain, type) and (
      plain is os.PathLike or issubclass(plain, pathlib.PurePath)
  )


def _signatures(
    factory: Callable[..., Any], method: str
) -> Iterator[inspect.Signature]:
  """Yields the signatures that declare options, the most derived first."""
  # `__signature__` of a class describes the call that makes an instance.
  if not isinstance(factory, type) or hasattr(factory, '__signature__'):
    yield _resolved(factory)
    return
  for owner in factory.__mro__[:-1]:
    if method in vars(owner):
      signature = _resolved(vars(owner)[method])
      parameters = list(signature.parameters.values())
      yield signature.replace(parameters=parameters[1:])  # Without `self`.


def _resolved(function: Callable[..., Any]) -> inspect.Signature:
  """Returns a signature whose annotations are types, not strings."""
  signature = inspect.signature(function)
  is_instance = not (inspect.isroutine(function) or isinstance(function, type))
  hints = typing.get_type_hints(
      type(function).__call__ if is_instance else inspect.unwrap(function),
      include_extras=True,
  )
  return signature.replace(
      parameters=[
          parameter.replace(annotation=hints.get(name, parameter.annotation))
          for name, parameter in signature.parameters.items()
      ]
  )


def _schema(annotation: Any, handler: Any) -> Any:
  """Returns the schema of a type; types without one accept any value."""
  try:
    return handler.generate_schema(annotation)
  except pydantic.errors.PydanticUserError:
    return core_schema.any_schema()


def _without_opaque_members(annotation: Any) -> Any:
  """Returns a union without the classes that plain data cannot represent."""
  if typing.get_origin(annotation) not in (typing.Union, types.UnionType):
    return annotation
  members = [m for m in typing.get_args(annotation) if not _is_opaque(m)]
  # An option that no file can set is checked by the class.
  if all(member is types.NoneType for member in members):
    return annotation
  return functools.reduce(operator.or_, members)


def _is_opaque(annotation: Any) -> bool:
  if is_path(annotation):
    return False
  try:
    pydantic.TypeAdapter(annotation)
    return False
  except pydantic.errors.PydanticUserError:
    pass
  try:
    return not any(issubclass(plain, annotation) for plain in _PLAIN)
  except TypeError:  # The annotation is not a class, or is a protocol.
    return False
