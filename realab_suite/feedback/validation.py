"""Base class for specs: strict, frozen, hashable, with one-line errors."""

import abc
import bisect
from collections.abc import Callable, Mapping, Sequence
import difflib
import functools
import hashlib
import itertools
import json
import re
import types
import typing
from typing import Any, TypeVar

import pydantic
from pydantic import fields

from realab_suite import errors
from realab_suite.feedback import loading
from realab_suite.feedback import messages

# A line that goes on for ever tells less, not more.
_MAX_TOLD = 10

_Model = TypeVar('_Model', bound=pydantic.BaseModel)


class Spec(pydantic.BaseModel, abc.ABC):
  """Frozen; unknown keys and lossy conversions are errors."""

  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', strict=True, populate_by_name=True
  )

  def to_mapping(self) -> dict[str, Any]:
    """Returns this as plain data, defaults filled in."""
    return self.model_dump(mode='json', by_alias=True)

  def digest(self) -> str:
    """Returns a hash of all this, by which results are told apart."""
    return digest_of(self.to_mapping())


def digest_of(data: Mapping[str, Any]) -> str:
  """Returns a hash of plain data, whatever the order of its keys."""
  canonical = json.dumps(data, sort_keys=True, separators=(',', ':'))
  return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def validate(
    model_class: type[_Model],
    data: Mapping[str, Any],
    where: str,
    overrides: Sequence[str] = (),
) -> _Model:
  """Returns the model that the data describes.

  Args:
    model_class: What the data has to be. Its own configuration decides how
      strict that is.
    data: What `read_mapping` returned.
    where: What error messages call the data.
    overrides: Overrides of the data; see `loading.apply_overrides`. Messages
      call a problem theirs if the data do not have it without them.

  Raises:
    SpecError: If the data does not fit. The message lists the problems.
  """

  @functools.cache
  def judged(count: int) -> tuple[_Model | None, list[str]]:
    """Returns the model with the first `count` overrides, or its problems."""
    used = overrides[:count]
    changed = loading.apply_overrides(data, used) if used else data
    return _judged(model_class, changed)

  model, problems = judged(len(overrides))
  if model is not None:
    return model
  # By where they come from: 0 for the data, 1 for the first override.
  told: dict[int, list[str]] = {}
  for problem in problems[:_MAX_TOLD]:
    origin = _origin(problem, len(overrides), lambda count: judged(count)[1])
    told.setdefault(origin, []).append(problem)
  if len(problems) > _MAX_TOLD:
    told[max(told)].append(f'and {len(problems) - _MAX_TOLD} more')
  names = [where, *(f'override {messages.quote(o)}' for o in overrides)]
  raise errors.SpecError(
      '; '.join(
          str(messages.Place(names[origin]).error('; '.join(found)))
          for origin, found in sorted(told.items())
      )
  )


def _judged(
    model_class: type[_Model], data: Mapping[str, Any]
) -> tuple[_Model | None, list[str]]:
  """Returns the model that the data describes, or its problems."""
  try:
    return model_class.model_validate(data), []
  except pydantic.ValidationError as error:
    problems = error.errors(include_url=False)
  # A union can report the same problem once for each of its members.
  return None, list(
      dict.fromkeys(_problem(p, model_class, data) for p in problems)
  )


def _origin(
    problem: str, count: int, problems_of: Callable[[int], Sequence[str]]
) -> int:
  """Returns with how many overrides a problem appears: 0 without any.

  Args:
    problem: A problem that there is with all overrides.
    count: The number of overrides.
    problems_of: Returns the problems that there are with the first overrides.
  """

  def is_there(used: int) -> bool:
    return _gist(problem) in map(_gist, problems_of(used))

  if is_there(0):
    return 0
  # Wherever the search ends, the problem is there, and one before it is not.
  return bisect.bisect_left(range(count), True, lo=1, key=is_there)


def _gist(problem: str) -> str:
  """Returns a problem without the list of what is allowed, which may change."""
  return problem.partition(';')[0]


def _problem(
    details: Any, model_class: type[pydantic.BaseModel], data: Any
) -> str:
  """Returns what one entry of a `pydantic.ValidationError` means."""
  kind = details['type']
  location = list(details['loc'])
  if kind == 'extra_forbidden':
    key = str(location.pop())
    path, members = _locate(location, model_class, data)
    text = _describe_unknown_key(key, members)
  else:
    path, _ = _locate(location, model_class, data)
    if kind in ('union_tag_invalid', 'union_tag_not_found'):
      path = (*path, details['ctx']['discriminator'].strip("'"))
    text = _describe(details)
  # The message of a validator may have several lines.
  text = ' '.join(text.split())
  return ': '.join(part for part in (messages.format_path(path), text) if part)


def _describe_unknown_key(key: str, members: Sequence[Any]) -> str:
  allowed = [k for m in members if _is_model(m) for k in _fields(m)]
  text = f'unknown key {messages.quote(key)}'
  for match in difflib.get_close_matches(key, allowed, n=1):
    text += f"; did you mean '{match}'?"
  return f'{text} (allowed: {", ".join(allowed)})' if allowed else text


def _describe(details: Any) -> str:
  """Returns what is wrong with a value, and the value."""
  kind = details['type']
  context = details.get('ctx', {})
  given = messages.quote(details['input'])
  if kind in ('missing', 'union_tag_not_found'):
    return 'required key is missing'
  if kind == 'union_tag_invalid':
    tag = messages.quote(context['tag'])
    return f'must be one of {context["expected_tags"]}, got {tag}'
  if kind in ('model_type', 'model_attributes_type', 'dict_type'):
    return f'must be a mapping, got {given}'
  if 'error' in context:
    text = str(context['error'])
    # A text about a mapping names the part of it that is wrong.
    if isinstance(details['input'], Mapping) or given in text:
      return text
    return f'{text}, got {given}'
  rule = re.sub(r'^\w+ should ', 'must ', details['msg'])
  return f'{rule}, got {given}'


def _locate(
    location: Sequence[str | int],
    model_class: type[pydantic.BaseModel],
    data: Any,
) -> tuple[tuple[str | int, ...], list[Any]]:
  """Follows a location of pydantic through the types and through the data.

  Pydantic's locations also name the member that it chose from a union, which
  is nothing that a user wrote.

  Returns:
    The keys and indices that lead to the place in the data, and the types that
    are allowed there, as far as they can be found.
  """
  path: list[str | int] = []
  members: list[Any] = [model_class]
  components = list(location)
  while components:
    component = components.pop(0)
    if len(members) > 1:
      members = [m for m in members if _answers_to(m, component)]
      continue
    is_present = (
        component in data
        if isinstance(data, Mapping)
        else isinstance(data, (list, tuple)) and component in range(len(data))
    )
    # Without a type to follow, the data tells keys from names of members; only
    # the last key may be missing there. '[key]' says that a key is wrong.
    if component == '[key]' or not (members or is_present or not components):
      continue
    path.append(component)
    data = data[component] if is_present else None
    members = list(
        itertools.chain.from_iterable(_children(m, component) for m in members)
    )
  return tuple(path), members


def _children(annotation: Any, component: str | int) -> list[Any]:
  """Returns the types that a key or index of a type allows."""
  if _is_model(annotation):
    field = _fields(annotation).get(str(component))
    return [] if field is None else _members(field.annotation)
  arguments = typing.get_args(annotation)
  if not arguments:
    return []
  if len(arguments) > 1 and isinstance(component, str):
    return _members(arguments[1])
  if isinstance(component, int) and Ellipsis not in arguments:
    return _members(arguments[min(component, len(arguments) - 1)])
  return _members(arguments[0])


def _members(annotation: Any) -> list[Any]:
  """Returns the types that a union joins, leaving out None."""
  origin = typing.get_origin(annotation)
  if origin is typing.Annotated:
    argument, *notes = typing.get_args(annotation)
    for note in notes:
      # A note that knows the members of a union that grows at run time.
      if callable(members := getattr(note, 'members', None)):
        return list(members())
    return _members(argument)
  if origin in (typing.Union, types.UnionType):
    return [
        member
        for argument in typing.get_args(annotation)
        for member in _members(argument)
        if member is not types.NoneType
    ]
  return [annotation]


def _answers_to(annotation: Any, label: str | int) -> bool:
  """Whether pydantic's name for a member of a union means this type."""
  return _is_model(annotation) and (
      annotation.__name__ == label
      or any(
          typing.get_origin(field.annotation) is typing.Literal
          and label in typing.get_args(field.annotation)
          for field in annotation.model_fields.values()
      )
  )


def _is_model(annotation: Any) -> bool:
  return isinstance(annotation, type) and issubclass(
      annotation, pydantic.BaseModel
  )


def _fields(
    model_class: type[pydantic.BaseModel],
) -> dict[str, fields.FieldInfo]:
  """Returns the fields of a model by the keys that a user writes."""
  return {
      alias if isinstance(alias := field.validation_alias, str) else name: field
      for name, field in model_class.model_fields.items()
  }
