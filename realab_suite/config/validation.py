"""Validation of data by pydantic models, with errors of one line.

The module contains the base class of specs, but no spec.
"""

import abc
from collections.abc import Collection, Mapping, Sequence
import contextlib
import hashlib
import json
import re
import types
from typing import Annotated, Any, Final, Literal, TypeVar

import pydantic

from realab_suite.config import loading
from realab_suite.config import messages

# Number of problems in a message; the others are counted.
_MAX_TOLD = 10
# What is allowed, by the type of the error, where Pydantic has Python's words.
_IN_WORDS_OF_YAML = {
    'bool_type': 'true or false',
    'dict_type': 'a mapping',
    'list_type': 'a list',
    'model_attributes_type': 'a mapping',
    'model_type': 'a mapping',
    'tuple_type': 'a list',
}
NAME: Final = r'^[a-z][a-z0-9_]{0,63}$'
"""Pattern of names of designs, registers, kinds and runs."""

_PATTERNS = {
    NAME: 'at most 64 of a-z, 0-9 and _, of which a letter is the first'
}
# Types of errors of the classes whose objects no file contains.
_NOT_IN_FILES = ('needs_python_object', 'dataclass_type')

_Model = TypeVar('_Model', bound=pydantic.BaseModel)


def _integers(allowed: str) -> pydantic.BeforeValidator:
  """Returns a validator that refuses `true` and `1.0`, which are equal to 1.

  Args:
    allowed: What is allowed, for the message.
  """

  def check(value: Any) -> Any:
    if type(value) is not int:
      raise ValueError(f'must be {allowed}')
    return value

  return pydantic.BeforeValidator(check)


Schema = Annotated[Literal[1], _integers('1')]
"""Version of the format of a file."""

ZeroOrOne = Annotated[Literal[0, 1], _integers('0 or 1')]
"""A number of steps, such as a delay."""


class Model(pydantic.BaseModel, abc.ABC):
  """Base class of specs and options: frozen, hashable and strict.

  Unknown keys and lossy conversions are errors.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', strict=True, populate_by_name=True
  )

  @pydantic.model_validator(mode='before')
  @classmethod
  def _check_keys(cls, data: Any) -> Any:
    if isinstance(data, Mapping) and cls.model_config['extra'] == 'forbid':
      fields = cls.model_fields
      unknown = [key for key in data if key not in fields]
      if unknown:
        allowed = [field.alias or name for name, field in fields.items()]
        check_keys(unknown, allowed, inner=_inner_paths(data, unknown))
    return data


def _inner_paths(
    data: Mapping[str, Any], keys: Collection[str]
) -> dict[str, str]:
  """Returns the paths of keys that a mapping in the data has, for hints.

  What they lead to is a mapping in both places, or in none.
  """
  return {
      key: f'{name}.{key}'
      for name, value in data.items()
      if isinstance(value, Mapping)
      for key in keys
      if key in value
      if isinstance(value[key], Mapping) == isinstance(data[key], Mapping)
  }


class Record(pydantic.BaseModel, abc.ABC):
  """Base class of results: frozen and without unknown keys.

  Infinite figures and nan are strings in JSON.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', ser_json_inf_nan='strings'
  )


class Spec(Model):
  """Base class of specs, which identify results."""

  def to_mapping(self) -> dict[str, Any]:
    """Returns the spec as plain data, including defaults."""
    return self.model_dump(mode='json', by_alias=True)

  def to_source(self) -> dict[str, Any]:
    """Returns plain data to change, which loads as this spec.

    Specs whose checks depend on what is stated leave out defaults here.
    """
    return self.to_mapping()

  def digest(self) -> str:
    """Returns a hash of all fields, which identifies results."""
    return digest_of(self.to_mapping())


def digest_of(data: Mapping[str, Any]) -> str:
  """Returns a hash of plain data that does not depend on the order of keys."""
  canonical = json.dumps(data, sort_keys=True, separators=(',', ':'))
  return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def check_keys(
    given: Collection[str],
    allowed: Collection[str],
    problem: str = 'unknown key',
    inner: Mapping[str, str] = types.MappingProxyType({}),
) -> None:
  """Checks the keys of a mapping.

  Args:
    given: Keys of the mapping.
    allowed: Allowed keys.
    problem: Name of the problem in the message.
    inner: Paths of the keys of mappings in the mapping, by key, for hints.

  Raises:
    ValueError: If a key is not allowed.
  """
  unknown = [key for key in given if key not in allowed]
  if unknown:
    hint = messages.did_you_mean(unknown[0], allowed)
    if unknown[0] in inner:
      hint = f'; did you mean {inner[unknown[0]]!r}?'
    raise ValueError(
        f'{problem} {messages.quote(unknown[0])}{hint} (allowed:'
        f' {", ".join(allowed) or "none"})'
    )


def validate(
    model_class: type[_Model],
    data: Mapping[str, Any],
    where: str,
    overrides: Sequence[str] = (),
) -> _Model:
  """Returns the model that the data describes.

  Args:
    model_class: Class of the model. Its own configuration determines how strict
      the validation is.
    data: Result of `loading.read_mapping`, or a mapping from a program.
    where: Name of the data in error messages.
    overrides: Overrides of the data; see `loading.apply_overrides`. If one of
      them makes valid data invalid, the message names it in place of the data.

  Raises:
    SpecError: If the data does not fit. The message lists the problems.
  """
  data = loading.with_lists(data)
  changed = loading.apply_overrides(data, overrides) if overrides else data
  with contextlib.suppress(pydantic.ValidationError):
    return model_class.model_validate(changed)
  problems, override = _blamed(model_class, data, overrides)
  where = loading.override_name(override) if override else where
  hint = loading.hint_at_keys(override, data) if override else ''
  texts = problems[:_MAX_TOLD]
  if len(problems) > _MAX_TOLD:
    texts.append(f'and {len(problems) - _MAX_TOLD} more')
  raise messages.Location(where).error('; '.join(texts) + hint)


def _blamed(
    model_class: type[_Model], data: Any, overrides: Sequence[str]
) -> tuple[list[str], str | None]:
  """Returns problems, and the override that makes valid data have them."""
  before = of_data = _problems(model_class, data)
  changed = data
  for override in overrides:
    changed = loading.apply_overrides(changed, [override])
    after = _problems(model_class, changed)
    if not set(after) <= set(of_data):
      # Otherwise, the data is wrong without the override, too.
      return (of_data, None) if before else (after, override)
    before = after
  return of_data, None


def _problems(model_class: type[_Model], data: Any) -> list[str]:
  """Returns the problems of data, each with its place and the given value."""
  try:
    model_class.model_validate(data)
    return []
  except pydantic.ValidationError as error:
    details = error.errors(include_url=False)
  # Classes in unions of what a file can contain and what only Python can make.
  problems = [
      one for one in details if one['type'] not in _NOT_IN_FILES
  ] or details
  # A list with wrong items is too short without them, which is no news.
  problems = [
      one
      for one in problems
      if one['type'] != 'too_short'
      or len(one['input']) < one['ctx']['min_length']
  ]
  problems = [
      one for one in problems if not _is_of_another_member(one, problems, data)
  ]
  # A union may report a problem once for each of its members.
  return list(
      dict.fromkeys(
          ': '.join(filter(None, (_path(one, data), _describe(one))))
          for one in problems
      )
  )


def _is_of_another_member(details: Any, problems: Any, data: Any) -> bool:
  """Returns whether a problem is of a member of a union that was not meant.

  A text was meant as one of the names that a union allows, and a mapping as the
  model beside them.
  """
  is_text = isinstance(details['input'], str)
  is_name = details['type'] == 'literal_error'
  if is_name == is_text:
    return False
  return any(
      (other['type'] == 'literal_error') != is_name
      and _path(other, data) == _path(details, data)
      for other in problems
  )


def _path(details: Any, data: Any) -> str:
  """Returns the keys and indices that lead to a problem.

  Pydantic's locations also name the member that it chose from a union, and mark
  a wrong key with '[key]'. Neither is in the data.
  """
  path: list[str | int] = []
  for component in details['loc']:
    try:
      data = data[component]
    except (LookupError, TypeError):
      continue
    path.append(component)
  if details['type'] == 'missing' and not _is_item(details):
    path.append(details['loc'][-1])
  return messages.format_path(path)


def _quote(value: Any) -> str:
  """Returns a value as YAML has it, cut to a length that fits a message."""
  if value is None or isinstance(value, bool):
    return json.dumps(value)
  return messages.quote(value)


def _is_item(details: Any) -> bool:
  """Returns whether what is missing is an item of a list, and not a key."""
  return details['type'] == 'missing' and isinstance(details['loc'][-1], int)


def _describe(details: Any) -> str:
  """Returns the error message, followed by the value."""
  value = _quote(details['input'])
  if _is_item(details):
    return f'must have at least {details["loc"][-1] + 1} items, got {value}'
  if details['type'] == 'missing':
    name = details['loc'][-1]
    close = messages.nearest(name, map(str, details['input']))
    hint = f'; is {close!r} meant to be {name!r}?' if close else ''
    return f'required key is missing{hint}'
  if details['type'] in _IN_WORDS_OF_YAML:
    return f'must be {_IN_WORDS_OF_YAML[details["type"]]}, got {value}'
  if details['type'] == 'string_pattern_mismatch':
    pattern = details['ctx']['pattern']
    rule = _PATTERNS.get(pattern, f'a text that matches {pattern!r}')
    return f'must be {rule}, got {value}'
  if 'error' not in details.get('ctx', {}):
    rule = re.sub(r'^\w+ should ', 'must ', details['msg'])
    rule = re.sub(r' after validation, not \w+$', '', rule)
    hint = ''
    if details['type'] == 'literal_error':
      choices = re.findall(r"'([^']*)'", details['ctx']['expected'])
      hint = messages.did_you_mean(details['input'], choices)
    return f'{rule}, got {value}{hint}'
  # The message of a validator may have several lines.
  text = ' '.join(str(details['ctx']['error']).split())
  # The problem of a mapping names the wrong part of it already.
  if isinstance(details['input'], Mapping) or value in text:
    return text
  return f'{text}, got {value}'
