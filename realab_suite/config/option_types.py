"""Types of fields and options that depend on registries or name files.

A design names a policy, a value function or a kind of register, and gives it
`options`. The parameters of its constructor are its options, and their
annotations are types for pydantic, with constraints such as
`Annotated[float, pydantic.Field(gt=0)]`. Providers, measurements and learners
declare fields of pydantic models instead, which are the parameters of their
constructors as well. An option that is the path of a file has the type
`FilePath`.
"""

from collections.abc import Callable, Mapping
import dataclasses
import functools
import inspect
import json
from typing import Annotated, Any, final

import pydantic
from pydantic_core import core_schema

from realab_suite.config import registry
from realab_suite.config import validation

FilePath = str
"""Path of a file. A design names it as text, and the class opens it."""

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
    self._names.get(name)
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
    kind = Annotated[str, pydantic.Strict(), NameIn(models)]
    self._kind: Any = pydantic.create_model('Kind', kind=(kind, ...))

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    del source, handler
    return core_schema.no_info_plain_validator_function(self._validated)

  def _validated(self, value: Any) -> Any:
    if isinstance(value, pydantic.BaseModel):
      return value
    if self._name is not None:
      if isinstance(value, str):
        return self._name.validate_python(value)
      if not isinstance(value, Mapping):
        raise ValueError('must be a name, or a mapping with a kind')
    kind = self._kind.model_validate(value).kind
    return self._models.get(kind).model_validate(value)


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
      allowed, options = _options_of(
          self._names.get(name), self._method, self._reserved
      )
    except (NameError, TypeError, pydantic.PydanticUserError) as error:
      raise ValueError(
          f'the options of {name!r} cannot be read from its signature: {error}'
      ) from error
    validation.check_keys(value, allowed)
    # JSON has the types of a file: a list may become a tuple, but a string
    # never becomes a number.
    text = json.dumps(value)
    try:
      options.validate_json(text, strict=True)
    except pydantic.ValidationError as error:
      # Classes check options that no file can contain, such as arrays.
      if {one['type'] for one in error.errors()} != {'needs_python_object'}:
        raise
    return value


@functools.cache
def _options_of(
    factory: Callable[..., Any],
    method: str,
    reserved: Callable[..., Any] | None,
) -> tuple[list[str], pydantic.TypeAdapter[Any]]:
  """Returns the names and the type of the options that a class declares.

  A method with `**kwargs` is assumed to pass them on to the method that it
  overrides, so the options of base classes are included.

  Args:
    factory: Class or function.
    method: Method of a class whose parameters are the options.
    reserved: Function whose parameters are not options.

  Raises:
    NameError: If an annotation is a string that names no type.
    TypeError: If `factory` has no signature.
  """
  taken = {
      'self',
      *(inspect.signature(reserved).parameters if reserved else ()),
  }
  # A dataclass, because options of a model could hide its methods.
  fields: dict[str, Any] = {}
  for function in _functions(factory, method):
    if function is reserved:
      break
    parameters = inspect.signature(function, eval_str=True).parameters.values()
    for option in parameters:
      if option.kind in _BY_NAME and option.name not in (*taken, *fields):
        fields[option.name] = (
            option.name,
            Any if option.annotation is option.empty else option.annotation,
            pydantic.Field(
                ... if option.default is option.empty else option.default
            ),
        )
    if all(one.kind is not one.VAR_KEYWORD for one in parameters):
      break
  config = pydantic.ConfigDict(arbitrary_types_allowed=True)
  options: pydantic.TypeAdapter[Any] = pydantic.TypeAdapter(
      dataclasses.make_dataclass(
          'Options',
          fields.values(),
          kw_only=True,
          namespace={'__pydantic_config__': config},
      )
  )
  return list(fields), options


def _functions(
    factory: Callable[..., Any], method: str
) -> list[Callable[..., Any]]:
  """Returns the functions that declare options, the most derived first."""
  if not isinstance(factory, type):
    return [factory]
  return [
      vars(owner)[method] for owner in factory.__mro__ if method in vars(owner)
  ]
