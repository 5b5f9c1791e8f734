"""Validation of data by pydantic models, with errors of one line.

The module contains the base class of specs, but no spec.
"""

import abc
import bisect
from collections.abc import Callable, Mapping, Sequence
import functools
import hashlib
import json
import re
from typing import Any, TypeVar

import pydantic

from realab_suite import errors
from realab_suite.config import annotations
from realab_suite.config import loading
from realab_suite.config import messages

# Number of problems in a message; the others are counted.
_MAX_TOLD = 10

_Model = TypeVar('_Model', bound=pydantic.BaseModel)


class Spec(pydantic.BaseModel, abc.ABC):
  """Base class of specs: frozen, hashable and strict.

  Unknown keys and lossy conversions are errors.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', strict=True, populate_by_name=True
  )

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
    are_overrides_free: True if paths that overrides set are exempt from that.

  Raises:
    SpecError: If the data does not fit. The message lists the problems.
  """

  @functools.cache
  def judged(count: int) -> tuple[_Model | None, list[str]]:
    """Returns the model with the first `count` overrides, or its problems."""
    used = overrides[:count]
    changed = loading.apply_overrides(data, used) if used else data
    if is_confined:
      free = used if are_overrides_free else ()
      # Before the validation, because a model may open the files.
      if outside := _paths_elsewhere(model_class, changed, free):
        return None, outside
    return _judged(model_class, changed)

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


def _judged(
    model_class: type[_Model], data: Mapping[str, Any]
) -> tuple[_Model | None, list[str]]:
  """Returns the model that the data describes, or its problems."""
  try:
    return model_class.model_validate(data), []
  except pydantic.ValidationError as error:
    problems = error.errors(include_url=False)
  # A union may report a problem once for each of its members.
  return None, list(
      dict.fromkeys(_problem(p, model_class, data) for p in problems)
  )


def _paths_elsewhere(
    model_class: type[pydantic.BaseModel],
    data: Mapping[str, Any],
    free: Sequence[str],
) -> list[str]:
  """Returns a problem for each path that leads out of the working directory.

  Args:
    model_class: Class of the model, which declares the paths.
    data: Data with overrides applied.
    free: Overrides in the data that may set any path.
  """
  free_keys = [loading.keys_of(override) for override in free]
  problems = []
  for path, text in annotations.paths_in(model_class, data):
    keys = [str(part) for part in path]
    if not loading.is_inside(text) and not any(
        keys[: len(key)] == key for key in free_keys
    ):
      problems.append(
          f'{messages.format_path(path)}: {messages.quote(text)} is outside the'
          ' working directory; allowed in a file are names, and paths within it'
      )
  return problems


def _origin(
    problem: str, count: int, problems_of: Callable[[int], Sequence[str]]
) -> int:
  """Returns the number of overrides that a problem takes to appear.

  Args:
    problem: Problem of the data with all overrides.
    count: Number of overrides.
    problems_of: Function from a number of overrides, the first ones, to the
      problems of the data with these.
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


def _problem(
    details: Any, model_class: type[pydantic.BaseModel], data: Any
) -> str:
  """Returns the text of one entry of a `pydantic.ValidationError`."""
  kind = details['type']
  location = list(details['loc'])
  if kind == 'extra_forbidden':
    key = str(location.pop())
    path, found = annotations.locate(location, model_class, data)
    text = _describe_unknown_key(key, found)
  else:
    path, _ = annotations.locate(location, model_class, data)
    if kind in ('union_tag_invalid', 'union_tag_not_found'):
      path = (*path, details['ctx']['discriminator'].strip("'"))
    text = _describe(details)
  # The message of a validator may have several lines.
  text = ' '.join(text.split())
  return ': '.join(part for part in (messages.format_path(path), text) if part)


def _describe_unknown_key(key: str, found: Sequence[Any]) -> str:
  declared = [
      keys for f in found if (keys := annotations.keys_of(f)) is not None
  ]
  allowed = [key for keys in declared for key in keys]
  text = f'unknown key {messages.quote(key)}'
  text += messages.did_you_mean(key, allowed)
  if not declared:
    return text
  return f'{text} (allowed: {", ".join(allowed) or "none"})'


def _describe(details: Any) -> str:
  """Returns the problem of a value, followed by the value."""
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
    # The problem of a mapping names the wrong part of it already.
    if isinstance(details['input'], Mapping) or given in text:
      return text
    return f'{text}, got {given}'
  rule = re.sub(r'^\w+ should ', 'must ', details['msg'])
  return f'{rule}, got {given}'
