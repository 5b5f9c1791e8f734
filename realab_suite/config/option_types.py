"""Types of fields and options that depend on registries or name files.

A design names a policy, a value function or a kind of register, and gives it
`options`. The parameters of its constructor are its options, and their
annotations are types for pydantic, with constraints such as
`Annotated[float, pydantic.Field(gt=0)]`. Providers, measurements and learners
declare fields of pydantic models instead, which are the parameters of their
constructors as well. An option that is the path of a file has the type
`FilePath`.
"""

from collections.abc import Callable, Iterator, Mapping
import functools
import inspect
import json
import operator
import os
import pathlib
import re
import types
import typing
from typing import Annotated, Any, final

import pydantic
from pydantic_core import core_schema

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.config import validation

FilePath = Annotated[str, pydantic.AfterValidator(validation.check_path)]
"""Path of a file.

`validation` refuses paths in a file that lead out of the working directory, at
any depth of models and options, before any of them is opened.
"""

# Types of the values that a file can contain.
_PLAIN = (str, int, float, bool, types.NoneType, list, dict)
# Classes of paths in the text of a schema.
_PATH = re.compile(r"<class '(pathlib|os)\.")
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
class ModelIn:
  """Annotation of a field that is validated as the class of its `kind`.

  It is a union that is discriminated by the kind, of the pydantic models that a
  registry contains when the field is validated.
  """

  def __init__(
      self, models: registry.Registry[Any], *, or_name: Any = None
  ) -> None:
    """Makes the annotation.

    Args:
      models: Registry of pydantic models with a literal field `kind`.
      or_name: Type of a string that the field may contain instead; `None` for
        no string.
    """
    self._models = models
    self._name = None if or_name is None else pydantic.TypeAdapter(or_name)
    self._kind: Any = pydantic.create_model(
        'Kind', kind=Annotated[str, pydantic.Strict(), NameIn(models)]
    )

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    del source, handler
    return core_schema.with_info_plain_validator_function(self._validated)

  def _validated(self, value: Any, info: pydantic.ValidationInfo) -> Any:
    if isinstance(value, pydantic.BaseModel):
      return value
    if self._name is not None:
      if isinstance(value, str):
        return self._name.validate_python(value)
      if not isinstance(value, Mapping):
        raise ValueError('must be a name, or a mapping with a kind')
    kind = self._kind.model_validate(value).kind
    return self._models.get(kind).model_validate(value, context=info.context)

  def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
    del schema
    models = (self._models.get(kind) for kind in self._models)
    union: Any = functools.reduce(operator.or_, models)
    found = handler(
        pydantic.TypeAdapter(
            Annotated[union, pydantic.Field(discriminator='kind')]
        ).core_schema
    )
    if self._name is None:
      return found
    return {'anyOf': [self._name.json_schema(), found]}


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

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    return core_schema.with_info_after_validator_function(
        self._validated, handler(source)
    )

  def _validated(self, value: Any, info: pydantic.ValidationInfo) -> Any:
    name = info.data.get(self._field)
    if not value or name is None:  # Another problem is reported then.
      return value
    try:
      # JSON has the types of a file: a list may become a tuple, but a string
      # never becomes a number.
      text = json.dumps(value)
    except TypeError as error:
      raise ValueError(f'expected plain data: {error}') from error
    factory = self._names.get(name)
    try:
      options = _options(factory, self._method, self._reserved)
    except (NameError, TypeError) as error:
      raise ValueError(
          f'the options of {name!r} cannot be read from its signature: {error}'
      ) from error
    options.check(text, info.context)
    return value


@final
class _Options:
  """Options that a class or function declares."""

  def __init__(
      self,
      annotations: Mapping[str, Any],
      defaults: Mapping[str, Any],
      others: Any,
  ) -> None:
    """Makes the type of the options.

    Args:
      annotations: Types of the options, by name.
      defaults: Values of optional options, by name.
      others: Type of options with any other name, or `None` if no other name is
        allowed.
    """
    self._annotations = annotations
    self._defaults = defaults
    self._others = others
    self._adapter = pydantic.TypeAdapter(Annotated[Any, self])

  def check(self, text: str, context: Any) -> None:
    """Checks options that are given as JSON.

    Raises:
      ValidationError: If an option is unknown, missing or of another type.
    """
    try:
      self._adapter.validate_json(text, strict=True, context=context)
    except pydantic.ValidationError as error:
      raise validation.with_allowed_keys(error, self._annotations) from None

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    del source
    fields = {}
    for name, annotation in self._annotations.items():
      schema = _schema(annotation, handler)
      if name in self._defaults:
        schema = core_schema.with_default_schema(
            schema, default=self._defaults[name]
        )
      fields[name] = core_schema.typed_dict_field(
          schema, required=name not in self._defaults
      )
    if self._others is None:
      return core_schema.typed_dict_schema(fields, extra_behavior='forbid')
    return core_schema.typed_dict_schema(
        fields,
        extras_schema=_schema(self._others, handler),
        extra_behavior='allow',
    )


@functools.cache
def _options(
    factory: Callable[..., Any],
    method: str,
    reserved: Callable[..., Any] | None,
) -> _Options:
  """Returns the options that a class or function declares.

  A method with `**kwargs` is assumed to pass them on to the method that it
  overrides, so the options of base classes are included.

  Args:
    factory: Class or function.
    method: Method of a class whose parameters are the options.
    reserved: Function whose parameters are not options.

  Raises:
    NameError: If an annotation is a string that names no type.
    TypeError: If `factory` has no signature, or a path has the wrong type.
  """
  bound: dict[str, Any] = {}
  if isinstance(factory, functools.partial):
    bound, factory = factory.keywords, factory.func
  annotations: dict[str, Any] = {}
  defaults: dict[str, Any] = {}
  others: Any = None
  taken = inspect.signature(reserved).parameters if reserved else ()
  for signature in _signatures(factory, method, reserved):
    others = None
    for name, parameter in signature.parameters.items():
      annotation = parameter.annotation
      if annotation is parameter.empty:
        annotation = Any
      _refuse_paths(name, annotation)
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
  return _Options(annotations, {**defaults, **bound}, others)


def _signatures(
    factory: Callable[..., Any],
    method: str,
    reserved: Callable[..., Any] | None,
) -> Iterator[inspect.Signature]:
  """Yields the signatures that declare options, the most derived first."""
  # `__signature__` of a class describes the call that makes an instance.
  if not isinstance(factory, type) or hasattr(factory, '__signature__'):
    yield inspect.signature(factory, eval_str=True)
    return
  for owner in factory.__mro__[:-1]:
    if (function := vars(owner).get(method)) is reserved is not None:
      yield inspect.Signature()
      return
    if function is not None:
      signature = inspect.signature(function, eval_str=True)
      parameters = list(signature.parameters.values())
      yield signature.replace(parameters=parameters[1:])  # Without `self`.


def _schema(annotation: Any, handler: Any) -> Any:
  """Returns the schema of a type; types without one accept any value."""
  try:
    return handler.generate_schema(annotation)
  except pydantic.errors.PydanticUserError:
    return core_schema.any_schema()


def _refuse_paths(name: str, annotation: Any) -> None:
  """Refuses paths of another type than `FilePath`, which are not checked.

  Raises:
    TypeError: If a type contains such a path.
  """
  for member in typing.get_args(annotation):
    _refuse_paths(name, member)
  plain = typing.get_origin(annotation) or annotation
  is_path = isinstance(plain, type) and (
      plain is os.PathLike or issubclass(plain, pathlib.PurePath)
  )
  # The fields of a model are only in its schema, whose text names their types.
  if is_path or (
      isinstance(plain, type)
      and _PATH.search(repr(getattr(plain, '__pydantic_core_schema__', '')))
  ):
    raise TypeError(
        f'{name}: {messages.quote(annotation)}; allowed for a path is FilePath'
    )


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
  try:
    pydantic.TypeAdapter(annotation)
    return False
  except pydantic.errors.PydanticUserError:
    pass
  try:
    return not any(issubclass(plain, annotation) for plain in _PLAIN)
  except TypeError:  # The annotation is not a class, or is a protocol.
    return False
