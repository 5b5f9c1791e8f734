"""Annotation of fields that contain a model of a registered class."""

from collections.abc import Mapping
import functools
import operator
from typing import Annotated, Any, final

import pydantic
from pydantic_core import core_schema

from realab_suite.config import registry


@final
class ModelIn:
  """Annotation of a field that is validated as the class of its `kind`."""

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
    self._or_name = or_name

  def members(self, siblings: Mapping[str, Any] | None = None) -> list[Any]:
    """Returns the classes that are registered now."""
    del siblings
    return [self._models.get(kind) for kind in self._models]

  def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
    del source
    union = functools.reduce(operator.or_, self.members())
    schema = handler.generate_schema(
        Annotated[union, pydantic.Field(discriminator='kind')]
    )
    if self._or_name is None:
      return schema
    name = pydantic.TypeAdapter(self._or_name)

    # Unlike a union, it reports the problems of one of the two types alone.
    def validate(value: Any, validate_model: Any) -> Any:
      if isinstance(value, str):
        return name.validate_python(value)
      if not isinstance(value, Mapping | pydantic.BaseModel):
        raise ValueError('must be a name, or a mapping with a kind')
      return validate_model(value)

    return core_schema.no_info_wrap_validator_function(validate, schema)

  def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
    found = handler(schema)
    if self._or_name is None:
      return found
    name = pydantic.TypeAdapter(self._or_name).json_schema()
    return {'anyOf': [name, found]}
