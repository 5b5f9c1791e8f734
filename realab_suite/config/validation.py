"""Validation of data by pydantic models, with errors of one line.

The module contains the base class of specs, but no spec.
"""

import abc
import bisect
from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
import functools
import hashlib
import json
import re
import typing
from typing import Annotated, Any, Literal, TypeVar, final

import pydantic
import pydantic_core
from pydantic_core import core_schema

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import messages

# Number of problems in a message; the others are counted.
_MAX_TOLD = 10

# Type of the error of an unknown key, with the allowed ones.
_UNKNOWN_KEY = 'unknown_key'
# Types of the errors that pydantic can make again from their names.
_KINDS = frozenset(typing.get_args(core_schema.ErrorType))

_Model = TypeVar('_Model', bound=pydantic.BaseModel)


def _refuse_equal_values(value: Any) -> Any:
  """Refuses `true` and `1.0`, which are equal to 1 in Python."""
  if type(value) is not int:
    raise ValueError('must be 1')
  return value


Schema = Annotated[Literal[1], pydantic.BeforeValidator(_refuse_equal_values)]
"""Version of the format of a file."""


class Model(pydantic.BaseModel, abc.ABC):
  """Base class of specs and options: frozen, hashable and strict.

  Unknown keys and lossy conversions are errors.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', strict=True, populate_by_name=True
  )

  @pydantic.model_validator(mode='wrap')
  @classmethod
  def _tell_allowed_keys(cls, data: Any, handler: Any) -> Any:
    try:
      return handler(data)
    except pydantic.ValidationError as error:
      raise with_allowed_keys(
          error,
          (field.alias or name for name, field in cls.model_fields.items()),
      ) from None


class Spec(Model):
  """Base class of specs, which identify results."""

  def to_mapping(self) -> dict[str, Any]:
    """Returns the spec as plain data, including defaults."""
    return self.model_dump(mode='json', by_alias=True)

  def digest(self) -> str:
    """Returns a hash of all fields, which identifies results."""
    return digest_of(self.to_mapping())


def digest_of(data: Mapping[str, Any]) -> str:
  """Returns a hash of plain data that does not depend on the order of keys."""
  canonical = json.dumps(data, sort_keys=True, separators=(',', ':'))
  return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def validate(
    model_class: type[_Model],
    data: Mapping[str, Any],
    where: str,
    overrides: Sequence[str] = (),
    *,
    is_confined: bool = False,
    are_overrides_free: bool = False,
) -> _Model:
  """Returns the model that the data describes.

  Args:
    model_class: Class of the model. Its own configuration determines how strict
      the validation is.
    data: Result of `loading.read_mapping`.
    where: Name of the data in error messages.
    overrides: Overrides of the data; see `loading.apply_overrides`. A problem
      that the data do not have without overrides is reported as the problem of
      the override that adds it.
    is_confined: True if paths must be within the working directory.
    are_overrides_free: True if paths that overrides name are exempt from that.

  Raises:
    SpecError: If the data does not fit. The message lists the problems.
  """

  @functools.cache
  def judged(count: int) -> tuple[_Model | None, list[str]]:
    """Returns the model with the first `count` overrides, or its problems."""
    used = overrides[:count]
    changed = loading.apply_overrides(data, used) if used else data
    return _judged(
        model_class,
        changed,
        _Paths(is_confined, used if are_overrides_free else ()),
    )

  model, problems = judged(len(overrides))
  if model is not None:
    return model
  # Keys are origins: 0 for the data, 1 for the first override.
  by_origin: dict[int, list[str]] = {}
  for problem in problems[:_MAX_TOLD]:
    origin = _origin(problem, len(overrides), lambda count: judged(count)[1])
    by_origin.setdefault(origin, []).append(problem)
  if len(problems) > _MAX_TOLD:
    by_origin[max(by_origin)].append(f'and {len(problems) - _MAX_TOLD} more')
  names = [where, *(f'override {messages.quote(o)}' for o in overrides)]
  raise errors.SpecError(
      '; '.join(
          str(messages.Location(names[origin]).error('; '.join(found)))
          for origin, found in sorted(by_origin.items())
      )
  )


@final
@dataclasses.dataclass(frozen=True)
class _Paths:
  """Context of a validation: the paths that fields may contain.

  Attributes:
    are_confined: True if paths must be within the working directory.
    free: Overrides with texts that are paths for which that does not hold.
  """

  are_confined: bool
  free: Sequence[str]


def are_paths_confined(info: pydantic.ValidationInfo) -> bool:
  """Returns True if paths must be within the working directory."""
  context: _Paths | None = info.context
  return context is not None and context.are_confined


def check_path(path: str, info: pydantic.ValidationInfo) -> str:
  """Returns a path if a field may contain it.

  Raises:
    ValueError: If not.
  """
  context: _Paths | None = info.context
  if context and context.are_confined and not loading.is_inside(path):
    if path not in loading.texts_in(context.free):
      raise ValueError(
          f'{messages.quote(path)} is outside the working directory; allowed in'
          ' a file are names, and paths within it'
      )
  return path


def with_allowed_keys(
    error: pydantic.ValidationError, allowed: Iterable[str]
) -> pydantic.ValidationError:
  """Returns an error whose unknown keys stand beside the allowed ones.

  Args:
    error: Error of a mapping.
    allowed: Allowed keys of this mapping.
  """
  allowed = list(allowed)
  details: list[pydantic_core.InitErrorDetails] = []
  for found in error.errors(include_url=False):
    kind: Any = found['type']
    location = found['loc']
    if kind == 'extra_forbidden' and len(location) == 1:
      [key] = location
      hint = messages.did_you_mean(key, allowed)
      kind = pydantic_core.PydanticCustomError(
          _UNKNOWN_KEY,
          '{text}',
          {
              'text': f'unknown key {messages.quote(key)}{hint} (allowed:'
              f' {", ".join(allowed) or "none"})'
          },
      )
      location = ()
    elif kind not in _KINDS:
      kind = pydantic_core.PydanticCustomError(
          kind, '{text}', {'text': found['msg']}
      )
    details.append(
        pydantic_core.InitErrorDetails(
            type=kind,
            loc=location,
            input=found['input'],
            ctx=found.get('ctx', {}),
        )
    )
  return pydantic.ValidationError.from_exception_data(error.title, details)


def _judged(
    model_class: type[_Model], data: Mapping[str, Any], paths: _Paths
) -> tuple[_Model | None, list[str]]:
  """Returns the model that the data describes, or its problems."""
  try:
    return model_class.model_validate(data, context=paths), []
  except pydantic.ValidationError as error:
    problems = error.errors(include_url=False)
  # A union may report a problem once for each of its members.
  return None, list(dict.fromkeys(_problem(p, data) for p in problems))


def _origin(
    problem: str, count: int, problems_of: Callable[[int], Sequence[str]]
) -> int:
  """Returns how many of the overrides it takes for a problem to appear.

  It is 0 for a problem of the data without overrides.

  Args:
    problem: Problem of the data with all overrides.
    count: Number of overrides.
    problems_of: Function that returns the problems of the data with only the
      first k overrides, given k.
  """

  def is_there(used: int) -> bool:
    return _gist(problem) in map(_gist, problems_of(used))

  if is_there(0):
    return 0
  # The search ends where the problem is present, and absent one step before.
  return bisect.bisect_left(range(count), True, lo=1, key=is_there)


def _gist(problem: str) -> str:
  """Returns a problem without the allowed values, which may change."""
  return problem.partition(';')[0]


def _problem(details: Any, data: Any) -> str:
  """Returns the text of one entry of a `pydantic.ValidationError`."""
  path = _path(details['loc'], details['type'] == 'missing', data)
  # The message of a validator may have several lines.
  text = ' '.join(_describe(details).split())
  return ': '.join(part for part in (messages.format_path(path), text) if part)


def _path(
    location: Sequence[str | int], is_missing: bool, data: Any
) -> tuple[str | int, ...]:
  """Returns the keys and indices that lead to a location in the data.

  Pydantic's locations also name the member that it chose from a union, and mark
  a wrong key with '[key]'. Neither is in the data.

  Args:
    location: Location that pydantic reports.
    is_missing: True if the last key is missing in the data.
    data: The data.
  """
  path: list[str | int] = []
  for i, component in enumerate(location):
    is_there = (
        component in data
        if isinstance(data, Mapping)
        else isinstance(data, list | tuple) and component in range(len(data))
    )
    if is_there:
      data = data[component]
    if is_there or (is_missing and i == len(location) - 1):
      path.append(component)
  return tuple(path)


def _describe(details: Any) -> str:
  """Returns the error message, followed by the value."""
  kind = details['type']
  context = details.get('ctx', {})
  given = messages.quote(details['input'])
  if kind == 'missing':
    return 'required key is missing'
  if kind == 'extra_forbidden':
    return f'unknown key {messages.quote(details["loc"][-1])}'
  if kind == _UNKNOWN_KEY:
    return str(details['msg'])
  if kind in ('model_type', 'model_attributes_type', 'dict_type'):
    return f'must be a mapping, got {given}'
  if 'error' in context:
    text = str(context['error'])
    # The problem of a mapping names the wrong part of it already.
    if isinstance(details['input'], Mapping) or given in text:
      return text
    return f'{text}, got {given}'
  rule = re.sub(r'^\w+ should ', 'must ', details['msg'])
  return f'{rule}, got {given}'
