"""Reading of untrusted YAML files and mappings, and overrides of their values.

A description is a YAML file, or a mapping of the same shape. The YAML library
constructs no objects: it only splits the text into events, and this module
builds mappings, lists, strings, numbers, booleans and nulls from them. (The
library's own composer overflows the stack of the process on a text of many
brackets.) Anchors, aliases, tags and directives are refused.

Unquoted `true`, `false`, `null`, `~`, plain decimal integers and decimal floats
(including `1e3`) have their usual meaning. Other words that YAML 1.1 converts,
such as `yes`, `012`, `1:30`, `0x1f` or `2024-01-01`, are refused, because YAML
1.2 keeps them as text. `validation` checks descriptions against a schema.
"""

from collections.abc import Iterator, Mapping, Sequence
import math
import os
import re
import sys
from typing import Any, final
import unicodedata

import yaml

from realab_suite.config import messages

_MAX_BYTES = 2**20
_MAX_DEPTH = 32
_MAX_ENTRIES = 1000
# In all collections together; bounds mappings that contain one list many times.
_MAX_VALUES = 100_000
_TOO_DEEP = f'nested deeper than {_MAX_DEPTH}'
_TOO_LONG = f'more than {_MAX_ENTRIES} entries'
_TOO_MANY = f'more than {_MAX_VALUES} values in all'
# Larger integers are not exact as floats, and a field may convert them.
_MAX_INT = 2**53

# Categories of Unicode: control, format (which includes bidirectional marks and
# the byte order mark), surrogate, line separator and paragraph separator.
_FORBIDDEN_CATEGORIES = frozenset({'Cc', 'Cf', 'Cs', 'Zl', 'Zp'})

_WORDS = {
    **dict.fromkeys(('', '~', 'null', 'Null', 'NULL')),
    **dict.fromkeys(('true', 'True', 'TRUE'), True),
    **dict.fromkeys(('false', 'False', 'FALSE'), False),
}
_INT = re.compile(r'[-+]?(0|[1-9][0-9]*)')
_FLOAT = re.compile(
    r'(?P<mantissa>[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE])))'
    r'([eE][-+]?[0-9]+)?'
)
_NOT_FINITE = re.compile(r'[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)')
# Words that are often meant as booleans, and octal numbers of YAML 1.2.
_AMBIGUOUS = re.compile(r'(?i:yes|no|on|off)|[-+]?0[oO][0-7]+')
# Paths that other programs or systems resolve outside of a directory.
_LEADS_ELSEWHERE = re.compile(
    r'~|[A-Za-z]:|[A-Za-z][\w+.-]*://|.*\\', re.DOTALL
)
_YAML_1_1 = yaml.resolver.Resolver()
_TEXT_TAG = 'tag:yaml.org,2002:str'

_Path = tuple[str | int, ...]
_Scalar = bool | int | float | str | None


def read_mapping(
    source: str | os.PathLike[str] | Mapping[str, Any],
) -> dict[str, Any]:
  """Returns a checked description that shares nothing with its source.

  Args:
    source: Path of a YAML file, or a mapping of the same shape. Tuples in it
      become lists, -0.0 becomes 0.0, and subclasses of the plain types (such as
      NumPy's float64) become the plain types.

  Raises:
    SpecError: If the file cannot be read, if it contains something that this
      module's docstring does not allow, or if a mapping contains something that
      such a file cannot contain.
  """
  if isinstance(source, Mapping):
    return _copied(source, '<mapping>')
  if not isinstance(source, (str, os.PathLike)):
    raise messages.Location('<mapping>').error(
        f'expected a path or a mapping, got {messages.quote(source)}'
    )
  path = os.fsdecode(source)
  return parse_yaml(_read_file(path, messages.Location(path)), path)


def parse_yaml(text: str | bytes, where: str) -> dict[str, Any]:
  """Returns the mapping that a YAML text contains.

  Args:
    text: One YAML document, as text or in UTF-8.
    where: Name of the text in error messages, usually that of a file.

  Raises:
    SpecError: If the text is not YAML, not a mapping, or not allowed by this
      module's docstring. No text causes another error.
  """
  documents = _Reader(text, where).documents()
  if len(documents) == 1 and isinstance(documents[0], dict):
    return documents[0]
  got = f'{len(documents)} documents'
  if len(documents) == 1:
    got = messages.quote(documents[0])
  raise messages.Location(where).error(
      f'expected a mapping at top level, got {got}'
  )


def is_inside(path: str) -> bool:
  """Returns True if a path is within the working directory, links followed.

  Files may name only such paths, because their author may be untrusted. URLs
  and paths with a leading `~`, a drive or a backslash are always outside.
  """
  if _LEADS_ELSEWHERE.match(path):
    return False
  root = os.path.realpath(os.curdir)
  try:
    return os.path.commonpath([root, os.path.realpath(path)]) == root
  except ValueError:  # The text is not a valid path.
    return False


def apply_overrides(
    data: Mapping[str, Any], overrides: Sequence[str]
) -> dict[str, Any]:
  """Returns a copy of the data with some of its values replaced.

  Args:
    data: Result of `read_mapping`. It is not changed.
    overrides: Texts such as `registers.reward.scale=0.2` or
      `providers.0.kind=constant`. The value is YAML. Missing mappings along the
      keys are created; entries of lists can be replaced but not added.

  Raises:
    SpecError: If an override is malformed, or if one of its keys leads into a
      value that is neither a mapping nor a list.
  """
  result = _copied(data, '<mapping>')
  for override in overrides:
    location = messages.Location(f'override {messages.quote(override)}')
    keys, value = _split(override, location)
    _assign(result, keys, value, location)
    # With the new value, the data may be too deep or have too many entries.
    result = _copied(result, location.where)
  return result


def texts_in(overrides: Sequence[str]) -> set[str]:
  """Returns the texts in the values of overrides, at any depth.

  Args:
    overrides: Overrides that `apply_overrides` accepts.
  """
  found: set[str] = set()
  nodes = [
      _split(override, messages.Location('override'))[1]
      for override in overrides
  ]
  while nodes:
    node = nodes.pop()
    if isinstance(node, str):
      found.add(node)
    elif isinstance(node, dict):
      nodes += [*node, *node.values()]
    elif isinstance(node, list):
      nodes += node
  return found


class _WrongValueError(ValueError):
  """A value is not allowed; the reader of the value adds its location."""


@final
class _Reader:
  """Builds the values of the documents in a YAML text."""

  def __init__(self, text: str | bytes, where: str) -> None:
    self._where = where
    self._loader = yaml.CSafeLoader(_decoded(text, messages.Location(where)))
    self._num_values = 0

  def documents(self) -> list[Any]:
    """Returns the value of each document; an empty text has no document."""
    values = []
    try:
      while (event := self._next_event()) is not None:
        if isinstance(event, yaml.DocumentStartEvent):
          if event.version or event.tags:
            raise self._at(event, ()).error('directives are not allowed')
          values.append(self._value(self._next_event(), ()))
    finally:
      self._loader.dispose()
    return values

  def _next_event(self) -> Any:
    try:
      return self._loader.get_event()
    except yaml.MarkedYAMLError as error:
      mark = error.problem_mark
      line = None if mark is None else mark.line + 1
      raise messages.Location(self._where, line=line).error(
          f'{error.problem}'
      ) from None
    # A tag with escaped bytes that are not UTF-8 is a UnicodeDecodeError.
    except (yaml.YAMLError, UnicodeError) as error:
      problem = ' '.join(str(error).split())
      raise messages.Location(self._where).error(
          f'not YAML: {problem}'
      ) from None

  def _at(self, event: Any, path: _Path) -> messages.Location:
    return messages.Location(self._where, path, event.start_mark.line + 1)

  def _value(self, event: Any, path: _Path) -> Any:
    """Returns the value that begins with an event.

    Args:
      event: First event of the value.
      path: Keys and indices that lead to the value.
    """
    try:
      if event.anchor is not None:
        raise _WrongValueError('anchors and aliases are not allowed')
      if event.tag is not None:
        raise _WrongValueError(f'tag {messages.quote(event.tag)} not allowed')
      self._num_values += 1
      if self._num_values > _MAX_VALUES:
        raise _WrongValueError(_TOO_MANY)
      if isinstance(event, yaml.ScalarEvent):
        is_plain = event.implicit[0]
        return _checked_scalar(
            _resolved(event.value) if is_plain else event.value
        )
      if len(path) >= _MAX_DEPTH:
        raise _WrongValueError(_TOO_DEEP)
      if isinstance(event, yaml.SequenceStartEvent):
        return self._list(path)
      return self._mapping(path)
    except _WrongValueError as error:
      raise self._at(event, path).error(str(error)) from None

  def _list(self, path: _Path) -> list[Any]:
    values: list[Any] = []
    while not isinstance(event := self._next_event(), yaml.SequenceEndEvent):
      values.append(self._value(event, (*path, len(values))))
      if len(values) > _MAX_ENTRIES:
        raise _WrongValueError(_TOO_LONG)
    return values

  def _mapping(self, path: _Path) -> dict[str, Any]:
    values: dict[str, Any] = {}
    lines: dict[str, int] = {}
    while not isinstance(event := self._next_event(), yaml.MappingEndEvent):
      line = event.start_mark.line + 1
      try:
        # A collection is not read here: it could be nested without end.
        if isinstance(event, yaml.CollectionStartEvent):
          raise _WrongValueError(
              'keys must be strings, got a mapping or a list'
          )
        key = _checked_key(self._value(event, path))
        if key in values:
          raise _WrongValueError(
              f'duplicate key {messages.quote(key)} (lines {lines[key]} and'
              f' {line})'
          )
      except _WrongValueError as error:
        raise self._at(event, path).error(str(error)) from None
      lines[key] = line
      values[key] = self._value(self._next_event(), (*path, key))
      if len(values) > _MAX_ENTRIES:
        raise _WrongValueError(_TOO_LONG)
    return values


def _copied(data: Mapping[Any, Any], where: str) -> dict[str, Any]:
  """Returns a copy of a mapping as plain data, after checking its values."""
  result: dict[str, Any] = _copy(data, where, (), iter(range(_MAX_VALUES)))
  return result


def _copy(value: Any, where: str, path: _Path, budget: Iterator[int]) -> Any:
  """Returns a copy of a value.

  Args:
    value: The value.
    where: Name of the data in error messages.
    path: Keys and indices that lead to the value.
    budget: Iterator with an item for each value that the data may still have.
  """
  try:
    if next(budget, None) is None:
      raise _WrongValueError(_TOO_MANY)
    is_mapping = isinstance(value, Mapping)
    if not is_mapping and not isinstance(value, list | tuple):
      return _checked_scalar(value)
    if len(path) >= _MAX_DEPTH:
      raise _WrongValueError(_TOO_DEEP)
    if len(value) > _MAX_ENTRIES:
      raise _WrongValueError(_TOO_LONG)
    if is_mapping:
      return {
          _checked_key(key): _copy(item, where, (*path, key), budget)
          for key, item in value.items()
      }
    return [
        _copy(item, where, (*path, index), budget)
        for index, item in enumerate(value)
    ]
  except _WrongValueError as error:
    raise messages.Location(where, path).error(str(error)) from None


def _split(override: str, location: messages.Location) -> tuple[list[str], Any]:
  """Returns the keys of an override and its value."""
  if not isinstance(override, str):
    raise location.error('expected key=value, as a text')
  name, equals, text = override.partition('=')
  if not equals:
    raise location.error('expected key=value')
  keys = name.split('.')
  if not all(key.strip() for key in keys):
    raise location.error('empty key')
  documents = _Reader(text, location.where).documents()
  if len(documents) != 1:
    raise location.error(
        "expected one value (null, or '' for empty text), got"
        f' {len(documents)}'
    )
  return keys, documents[0]


def _decoded(text: str | bytes, location: messages.Location) -> str:
  """Returns the text with plain newlines, after checking its characters."""
  # Lone surrogates pass here, so that they are reported with their line.
  content = (
      text.encode('utf-8', 'surrogatepass') if isinstance(text, str) else text
  )
  _check_size(len(content), location)
  try:
    text = content.decode('utf-8', 'surrogatepass')
  except UnicodeDecodeError as error:
    number = content.count(b'\n', 0, error.start) + 1
    raise messages.Location(location.where, (), number).error(
        f'not UTF-8 text: {error.reason}'
    ) from None
  text = text.replace('\r\n', '\n')
  for number, line in enumerate(text.split('\n'), 1):
    # Printable characters are in none of the forbidden categories.
    if not line.isprintable():
      try:
        _check_characters(line)
      except _WrongValueError as error:
        raise messages.Location(location.where, (), number).error(
            str(error)
        ) from None
  return text


def _read_file(path: str, location: messages.Location) -> bytes:
  # Opening a named pipe would block, so the type is checked first.
  if not os.path.isfile(path):
    exists = os.path.exists(path)
    raise location.error('not a file' if exists else 'no such file')
  try:
    size = os.path.getsize(path)
    with open(path, 'rb') as stream:
      content = stream.read(_MAX_BYTES + 1)
  except OSError as error:
    raise location.error(f'cannot be read: {error.strerror}') from None
  # Checks the bytes read as well: a file may grow, or report no size.
  _check_size(max(size, len(content)), location)
  return content


def _resolved(text: str) -> _Scalar:
  """Returns the value of an unquoted scalar."""
  if text in _WORDS:
    return _WORDS[text]
  if _INT.fullmatch(text):
    # Python cannot convert thousands of digits.
    if len(text.lstrip('+-')) > len(str(_MAX_INT)):
      raise _WrongValueError(f'integer {messages.quote(text)} is out of range')
    return int(text)
  if match := _FLOAT.fullmatch(text):
    value = float(text)
    vanished = value == 0 and re.search('[1-9]', match['mantissa'])
    if math.isinf(value) or vanished:
      raise _WrongValueError(f'number {messages.quote(text)} is out of range')
    return value
  if _NOT_FINITE.fullmatch(text):
    raise _WrongValueError(f'must be finite, got {text}')
  tag = _YAML_1_1.resolve(yaml.ScalarNode, text, (True, False))
  if tag != _TEXT_TAG or _AMBIGUOUS.fullmatch(text):
    raise _WrongValueError(
        f'{messages.quote(text)} is ambiguous: quote it if it is text, or write'
        ' true, false or a plain decimal number'
    )
  return text


def _checked_key(key: Any) -> str:
  if not isinstance(key, str):
    raise _WrongValueError(
        f'keys must be strings, got {messages.quote(key)} (quote it)'
    )
  if '\n' in key:
    raise _WrongValueError(f'keys must be one line, got {messages.quote(key)}')
  return str(_checked_scalar(key))


def _checked_scalar(value: Any) -> _Scalar:
  """Returns a value as exactly one of the plain types."""
  if isinstance(value, str):
    if not value.isprintable():
      _check_characters(value)
    # Not str(value): a subclass, such as a text enum, may override it.
    return str.__str__(value)
  if value is None or isinstance(value, bool):
    return value
  if isinstance(value, int):
    if abs(value) > _MAX_INT:
      raise _WrongValueError(f'integer {messages.quote(value)} is out of range')
    return int(value)
  if isinstance(value, float):
    if not math.isfinite(value):
      raise _WrongValueError(f'must be finite, got {value}')
    # MuJoCo's parser reports a subnormal number as out of range.
    if 0 < abs(value) < sys.float_info.min:
      raise _WrongValueError(f'number {value} is out of range')
    # Adding 0.0 turns -0.0 into 0.0: equal descriptions have equal texts.
    return float(value) + 0.0
  raise _WrongValueError(
      'expected a mapping, list, string, number, boolean or null, got'
      f' {messages.quote(value)}'
  )


def _check_characters(text: str) -> None:
  """Checks that a text contains only printable characters and newlines."""
  for character in dict.fromkeys(text):
    if character == '\t':
      raise _WrongValueError('tab is not allowed (use spaces)')
    category = unicodedata.category(character)
    if character != '\n' and category in _FORBIDDEN_CATEGORIES:
      raise _WrongValueError(f'character U+{ord(character):04X} is not allowed')


def _check_size(size: int, location: messages.Location) -> None:
  if size > _MAX_BYTES:
    tenths = math.ceil(10 * size / _MAX_BYTES)
    raise location.error(f'file is {tenths / 10} MiB, limit 1 MiB')


def _assign(
    data: dict[str, Any],
    keys: Sequence[str],
    value: Any,
    location: messages.Location,
) -> None:
  """Sets the value at the end of the keys, in place."""
  node: Any = data
  for depth, key in enumerate(keys):
    is_last = depth == len(keys) - 1
    position: str | int = key
    if isinstance(node, list):
      # Compared as text, because Python cannot convert very long integers.
      if key not in map(str, range(len(node))):
        raise location.error(
            f'index {messages.quote(key)} is not one of the {len(node)}'
            f' entries of {messages.quote(".".join(keys[:depth]))}'
        )
      position = int(key)
    elif not isinstance(node, dict):
      raise location.error(
          f'{messages.quote(".".join(keys[:depth]))} is'
          f' {messages.quote(node)}, not a mapping or list'
      )
    if is_last:
      node[position] = value
    elif isinstance(node, dict):
      node = node.setdefault(key, {})
    else:
      node = node[position]
