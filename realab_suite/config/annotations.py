"""Traversal of type annotations together with the data that they describe.

If the metadata of an `Annotated` has a method `members(siblings)`, the method
returns the types that are allowed at its location, given the values beside it.
This module reports locations and types; it validates nothing.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
import types
import typing
from typing import Any

import pydantic
from pydantic import fields as pydantic_fields

from realab_suite.config import option_types

Path = tuple[str | int, ...]


def locate(
    location: Sequence[str | int], annotation: Any, data: Any
) -> tuple[Path, list[Any]]:
  """Converts a location reported by pydantic to a path in the data.

  Pydantic's locations also name the member that it chose from a union. That
  name is not part of the path.

  Returns:
    The keys and indices that lead to the location in the data, and the types
    that are allowed there, as far as they can be found.
  """
  path: list[str | int] = []
  found: list[Any] = [annotation]
  components = list(location)
  while components:
    component = components.pop(0)
    if len(found) > 1:
      found = [m for m in found if _answers_to(m, component)]
      continue
    is_present = (
        component in data
        if isinstance(data, Mapping)
        else isinstance(data, (list, tuple)) and component in range(len(data))
    )
    # Without a type, a component is a key if the data has it; the last key may
    # be missing. Pydantic marks a wrong key with '[key]'.
    if component == '[key]' or not (found or is_present or not components):
      continue
    path.append(component)
    found = _children(found, component, data)
    data = data[component] if is_present else None
  return tuple(path), found


def paths_in(annotation: Any, data: Any) -> Iterator[tuple[Path, str]]:
  """Yields the strings that a type declares as paths of files.

  Args:
    annotation: The type.
    data: Plain data, valid or not.

  Yields:
    The keys and indices that lead to a string, and the string.
  """
  yield from _paths_in([annotation], data, ())


def keys_of(annotation: Any) -> list[str] | None:
  """Returns the keys that a type declares, or `None` if it declares none."""
  if isinstance(annotation, option_types.Options):
    return list(annotation.annotations)
  return list(_fields(annotation)) if _is_model(annotation) else None


def _paths_in(
    found: Sequence[Any], data: Any, path: Path
) -> Iterator[tuple[Path, str]]:
  if isinstance(data, str):
    if any(option_types.is_path(annotation) for annotation in found):
      yield path, data
    return
  items: Iterable[tuple[Any, Any]] = ()
  if isinstance(data, Mapping):
    found = [annotation for annotation in found if _fits(annotation, data)]
    items = data.items()
    for key in data:
      yield from _paths_in(_key_types(found), key, (*path, key))
  elif isinstance(data, list | tuple):
    items = enumerate(data)
  for key, item in items:
    yield from _paths_in(_children(found, key, data), item, (*path, key))


def _children(
    found: Sequence[Any], component: str | int, data: Any
) -> list[Any]:
  """Returns the types that `found` allows at a key or index of the data."""
  siblings = data if isinstance(data, Mapping) else {}
  return [
      child
      for annotation in found
      for child in _child(annotation, component, siblings)
  ]


def _child(
    annotation: Any, component: str | int, siblings: Mapping[str, Any]
) -> list[Any]:
  if isinstance(annotation, option_types.Options):
    child = annotation.annotations.get(str(component), annotation.others)
    return _members(child, {**annotation.defaults, **siblings})
  if _is_model(annotation):
    # By name, which some models accept, and by alias, which users write.
    fields = {**annotation.model_fields, **_fields(annotation)}
    if component not in fields:
      return []
    defaults = {name: field.default for name, field in fields.items()}
    child = fields[component].rebuild_annotation()
    return _members(child, {**defaults, **siblings})
  arguments = typing.get_args(annotation)
  if not arguments:
    return _members(_hints(annotation).get(component, Any), siblings)
  if len(arguments) > 1 and isinstance(component, str):
    return _members(arguments[1], siblings)
  if isinstance(component, int) and Ellipsis not in arguments:
    return _members(arguments[min(component, len(arguments) - 1)], siblings)
  return _members(arguments[0], siblings)


def _key_types(found: Sequence[Any]) -> list[Any]:
  """Returns the types of keys, for each type of a mapping."""
  return [
      member
      for annotation in found
      if len(arguments := typing.get_args(annotation)) > 1
      for member in _members(arguments[0], {})
  ]


def _members(annotation: Any, siblings: Mapping[str, Any]) -> list[Any]:
  """Returns the members of a union, without None."""
  # Attributes of a `NewType` and of a `type` statement that hold the type.
  for attribute in ('__supertype__', '__value__'):
    annotation = getattr(annotation, attribute, annotation)
  origin = typing.get_origin(annotation)
  if origin is typing.Annotated:
    if option_types.is_path(annotation):
      return [annotation]
    argument, *notes = typing.get_args(annotation)
    for note in notes:
      if callable(members := getattr(note, 'members', None)):
        return list(members(siblings))
    return _members(argument, siblings)
  if origin in (typing.Required, typing.NotRequired):
    return _members(typing.get_args(annotation)[0], siblings)
  if _is_model(annotation) and issubclass(annotation, pydantic.RootModel):
    root = annotation.model_fields['root'].rebuild_annotation()
    return _members(root, siblings)
  if origin in (typing.Union, types.UnionType):
    return [
        member
        for argument in typing.get_args(annotation)
        for member in _members(argument, siblings)
        if member is not types.NoneType
    ]
  return [annotation]


def _answers_to(annotation: Any, label: str | int) -> bool:
  """Returns True if pydantic uses the label for this member of a union."""
  return _is_model(annotation) and (
      annotation.__name__ == label
      or any(label in values for values in _literals(annotation).values())
  )


def _fits(annotation: Any, data: Mapping[str, Any]) -> bool:
  """Returns True unless a literal field of the type excludes the data."""
  return not _is_model(annotation) or all(
      data.get(key, values[0]) in values
      for key, values in _literals(annotation).items()
  )


def _literals(model_class: Any) -> dict[str, tuple[Any, ...]]:
  """Returns the allowed values of a model's literal fields, by key."""
  return {
      key: typing.get_args(field.annotation)
      for key, field in _fields(model_class).items()
      if typing.get_origin(field.annotation) is typing.Literal
  }


def _is_model(annotation: Any) -> bool:
  return isinstance(annotation, type) and issubclass(
      annotation, pydantic.BaseModel
  )


def _fields(
    model_class: type[pydantic.BaseModel],
) -> dict[str, pydantic_fields.FieldInfo]:
  """Returns the fields of a model, by the keys that users write."""
  return {
      alias if isinstance(alias := field.validation_alias, str) else name: field
      for name, field in model_class.model_fields.items()
  }


def _hints(annotation: Any) -> dict[Any, Any]:
  """Returns the types of the fields of a typed dict, dataclass or tuple."""
  try:
    hints = typing.get_type_hints(annotation, include_extras=True)
  except (NameError, TypeError):
    return {}
  # A named tuple is a list in plain data.
  return {**hints, **dict(enumerate(hints.values()))}
