"""Reading of untrusted YAML files and mappings, and overrides of their values.

A description is a YAML file, or a mapping of the same shape. The YAML library
constructs no objects: it only splits the text into events, and this module
builds mappings, lists, strings, numbers, booleans and nulls from them. Anchors,
aliases, tags and directives are refused.

Unquoted `true`, `false`, `null`, `~`, plain decimal integers and decimal floats
(including `1e3`) have their usual meaning. Other words that YAML 1.1 converts,
such as `yes`, `012`, `1:30`, `0x1f` or `2024-01-01`, are refused, because YAML
1.2 keeps them as text. `validation` checks descriptions against a schema.
"""

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
import math
import os
import re
import sys
import typing
from typing import Any
import unicodedata

import yaml

from realab_suite import errors
from realab_suite.config import messages

_MAX_BYTES = 2**20
_MAX_DEPTH = 32
_MAX_ENTRIES = 1000
# In all collections together; bounds mappings that contain one list many times.
_MAX_VALUES = 100_000
# Larger integers are not exact as floats, and a field may convert them.
_MAX_INT = 2**53

# Categories of Unicode: control, format (which includes bidirectional marks and
# the byte order mark), surrogate, line separator and paragraph separator.
_FORBIDDEN_CATEGORIES = frozenset({'Cc', 'Cf', 'Cs', 'Zl', 'Zp'})

_NULL = re.compile(r'~|null|Null|NULL|')
_TRUE = re.compile(r'true|True|TRUE')
_FALSE = re.compile(r'false|False|FALSE')
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


def read_mapping(
    source: str | os.PathLike[str] | Mapping[str, Any],
    *,
    where: str | None = None,
) -> dict[str, Any]:
  """Returns a checked description that shares nothing with its source.

  Args:
    source: Path of a YAML file, or a mapping of the same shape. Tuples in it
      become lists, -0.0 becomes 0.0, and subclasses of the plain types (such as
      NumPy's float64) become the plain types.
    where: Name of the source in error messages. Default: the path.

  Raises:
    SpecError: If the file cannot be read, if it contains something that this
      module's docstring does not allow, or if a mapping contains something that
      such a file cannot contain.
  """
  if isinstance(source, Mapping):
    return _copy_mapping(source, messages.Location(where or '<mapping>'))
  if not isinstance(source, (str, os.PathLike)):
    raise messages.Location(where or '<mapping>').error(
        f'expected a path or a mapping, got {messages.quote(source)}'
    )
  path = os.fsdecode(source)
  where = where or path
  return parse_yaml(_read_file(path, messages.Location(where)), where)


def parse_yaml(text: str | bytes, where: str) -> dict[str, Any]:
  """Returns the mapping that a YAML text contains.

  Args:
    text: One YAML document, as text or in UTF-8.
    where: Name of the text in error messages, usually that of a file.

  Raises:
    SpecError: If the text is not YAML, not a mapping, or not allowed by this
      module's docstring. No text causes another error.
  """
  documents = _documents(text, where)
  if len(documents) != 1:
    raise messages.Location(where).error(
        f'expected a mapping at top level, got {len(documents)} documents'
    )
  if not isinstance(documents[0], dict):
    raise messages.Location(where).error(
        f'expected a mapping at top level, got {messages.quote(documents[0])}'
    )
  return documents[0]


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
  result = _copy_mapping(data, messages.Location('<mapping>'))
  for override in overrides:
    location = messages.Location(f'override {messages.quote(override)}')
    if not isinstance(override, str):
      raise location.error('expected key=value, as a text')
    _, equals, text = override.partition('=')
    if not equals:
      raise location.error('expected key=value')
    keys = keys_of(override)
    if not all(k.strip() for k in keys):
      raise location.error('empty key')
    documents = _documents(text, location.where)
    if len(documents) != 1:
      raise location.error(
          f"expected one value (null, or '' for empty text), got"
          f' {len(documents)}'
      )
    _assign(result, keys, documents[0], location)
    # With the new value, the data may be too deep or have too many entries.
    result = _copy_mapping(result, location)
  return result


def keys_of(override: str) -> list[str]:
  """Returns the keys that lead to the value that an override sets."""
  return override.partition('=')[0].split('.')


@typing.final
@dataclasses.dataclass
class _Frame:
  """Mapping or list that is being built."""

  container: dict[str, Any] | list[Any]
  location: messages.Location
  # The key without a value so far, and the lines of all keys so far.
  key: str | None = None
  key_lines: dict[str, int] = dataclasses.field(default_factory=dict)

  @property
  def expects_key(self) -> bool:
    return isinstance(self.container, dict) and self.key is None

  def next_location(self, line: int) -> messages.Location:
    location = messages.Location(self.location.where, self.location.path, line)
    if isinstance(self.container, list):
      return location.child(len(self.container))
    return location if self.key is None else location.child(self.key)

  def add_key(self, key: Any, location: messages.Location) -> None:
    key = _checked_key(key, location)
    line = location.line or 0
    if key in self.key_lines:
      raise location.error(
          f'duplicate key {messages.quote(key)} (lines'
          f' {self.key_lines[key]} and {line})'
      )
    self.key = key
    self.key_lines[key] = line

  def add_value(self, value: Any) -> None:
    _check_entries(len(self.container) + 1, self.location)
    if isinstance(self.container, list):
      self.container.append(value)
    elif self.key is not None:
      self.container[self.key] = value
      self.key = None


def _documents(text: str | bytes, where: str) -> list[Any]:
  """Returns the value of each document; an empty text has no document."""
  documents: list[Any] = []
  # An explicit stack: Python's recursion limit must not limit the depth.
  stack: list[_Frame] = []
  budget = iter(range(_MAX_VALUES))
  for event, line in _events(_decode(text, messages.Location(where)), where):
    location = messages.Location(where, line=line)
    if stack:
      location = stack[-1].next_location(line)
    if isinstance(event, yaml.DocumentStartEvent):
      if event.version or event.tags:
        raise location.error('directives are not allowed')
    elif isinstance(event, yaml.CollectionEndEvent):
      stack.pop()
    elif isinstance(event, yaml.NodeEvent):
      value = _node_value(event, location)
      if not stack:
        documents.append(value)
      elif stack[-1].expects_key:
        stack[-1].add_key(value, location)
      else:
        _spend(budget, location)
        stack[-1].add_value(value)
      if isinstance(value, (dict, list)):
        _check_depth(len(stack) + 1, location)
        stack.append(_Frame(value, location))
  return documents


def _node_value(event: Any, location: messages.Location) -> Any:
  """Returns the scalar, or the new empty collection, of an event."""
  if event.anchor is not None:
    raise location.error('anchors and aliases are not allowed')
  if event.tag is not None:
    raise location.error(f'tag {messages.quote(event.tag)} not allowed')
  if isinstance(event, yaml.SequenceStartEvent):
    return []
  if isinstance(event, yaml.MappingStartEvent):
    return {}
  is_plain = event.implicit[0]
  value = _resolve(event.value, location) if is_plain else event.value
  return _checked_scalar(value, location)


def _events(text: str, where: str) -> Iterator[tuple[Any, int]]:
  """Yields the events of the YAML parser, each with its line."""
  loader = yaml.CSafeLoader(text)
  try:
    while True:
      try:
        event = loader.get_event()
      except yaml.MarkedYAMLError as error:
        line = _line(error.problem_mark)
        raise messages.Location(where, line=line).error(
            f'{error.problem}'
        ) from None
      # A tag with escaped bytes that are not UTF-8 is a UnicodeDecodeError.
      except (yaml.YAMLError, UnicodeError) as error:
        problem = ' '.join(str(error).split())
        raise messages.Location(where).error(f'not YAML: {problem}') from None
      if event is None:
        return
      yield event, _line(event.start_mark) or 1
  finally:
    loader.dispose()


def _line(mark: Any) -> int | None:
  return None if mark is None else mark.line + 1


def _decode(text: str | bytes, location: messages.Location) -> str:
  """Returns the text with plain newlines, after checking its characters."""
  # Lone surrogates pass here, so that they are reported with their line.
  content = (
      text.encode('utf-8', 'surrogatepass') if isinstance(text, str) else text
  )
  _check_size(len(content), location)
  try:
    text = content.decode('utf-8', 'surrogatepass')
  except UnicodeDecodeError as error:
    line = content.count(b'\n', 0, error.start) + 1
    raise dataclasses.replace(location, line=line).error(
        f'not UTF-8 text: {error.reason}'
    ) from None
  text = text.replace('\r\n', '\n')
  character = _forbidden_character(text)
  if character is not None:
    line = text.count('\n', 0, text.index(character)) + 1
    raise _character_error(character, dataclasses.replace(location, line=line))
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
  # The content counts if the file grows or reports no size.
  _check_size(max(size, len(content)), location)
  return content


def _resolve(
    text: str, location: messages.Location
) -> bool | int | float | str | None:
  """Returns the value of an unquoted scalar."""
  if _NULL.fullmatch(text):
    return None
  if _TRUE.fullmatch(text):
    return True
  if _FALSE.fullmatch(text):
    return False
  if _INT.fullmatch(text):
    # Python cannot convert thousands of digits.
    if len(text.lstrip('+-')) > len(str(_MAX_INT)):
      raise location.error(f'integer {messages.quote(text)} is out of range')
    return int(text)
  if match := _FLOAT.fullmatch(text):
    value = float(text)
    vanished = value == 0 and re.search('[1-9]', match['mantissa'])
    if math.isinf(value) or vanished:
      raise location.error(f'number {messages.quote(text)} is out of range')
    return value
  if _NOT_FINITE.fullmatch(text):
    raise location.error(f'must be finite, got {text}')
  tag = _YAML_1_1.resolve(yaml.ScalarNode, text, (True, False))
  if tag != _TEXT_TAG or _AMBIGUOUS.fullmatch(text):
    raise location.error(
        f'{messages.quote(text)} is ambiguous: quote it if it is text, or write'
        ' true, false or a plain decimal number'
    )
  return text


def _copy_mapping(
    data: Mapping[str, Any], location: messages.Location
) -> dict[str, Any]:
  budget = iter(range(_MAX_VALUES))
  return {
      key: _copy(value, location.child(key), 2, budget)
      for key, value in _checked_items(data, location)
  }


def _copy(
    value: Any, location: messages.Location, depth: int, budget: Iterator[int]
) -> Any:
  """Returns a copy of a value that `depth - 1` collections contain."""
  _spend(budget, location)
  if isinstance(value, Mapping):
    _check_depth(depth, location)
    return {
        key: _copy(item, location.child(key), depth + 1, budget)
        for key, item in _checked_items(value, location)
    }
  if isinstance(value, (list, tuple)):
    _check_depth(depth, location)
    _check_entries(len(value), location)
    return [
        _copy(item, location.child(index), depth + 1, budget)
        for index, item in enumerate(value)
    ]
  return _checked_scalar(value, location)


def _checked_items(
    data: Mapping[Any, Any], location: messages.Location
) -> Iterator[tuple[str, Any]]:
  _check_entries(len(data), location)
  for key, value in data.items():
    yield _checked_key(key, location), value


def _checked_key(key: Any, location: messages.Location) -> str:
  if not isinstance(key, str):
    raise location.error(
        f'keys must be strings, got {messages.quote(key)} (quote it)'
    )
  if '\n' in key:
    raise location.error(f'keys must be one line, got {messages.quote(key)}')
  return typing.cast(str, _checked_scalar(key, location))


def _checked_scalar(
    value: Any, location: messages.Location
) -> bool | int | float | str | None:
  """Returns a value as exactly one of the plain types."""
  if value is None or isinstance(value, bool):
    return value
  if isinstance(value, int):
    if abs(value) > _MAX_INT:
      raise location.error(f'integer {messages.quote(value)} is out of range')
    return int(value)
  if isinstance(value, float):
    if not math.isfinite(value):
      raise location.error(f'must be finite, got {value}')
    # MuJoCo's parser reports a subnormal number as out of range.
    if 0 < abs(value) < sys.float_info.min:
      raise location.error(f'number {value} is out of range')
    # Adding 0.0 turns -0.0 into 0.0: equal descriptions have equal texts.
    return float(value) + 0.0
  if isinstance(value, str):
    character = _forbidden_character(value)
    if character is not None:
      raise _character_error(character, location)
    # Not str(value): a subclass, such as a text enum, may override it.
    return str.__str__(value)
  raise location.error(
      'expected a mapping, list, string, number, boolean or null, got'
      f' {messages.quote(value)}'
  )


def _forbidden_character(text: str) -> str | None:
  """Returns the first forbidden character of a text; newlines are allowed."""
  found = {
      c
      for c in set(text) - {'\n'}
      if unicodedata.category(c) in _FORBIDDEN_CATEGORIES
  }
  return min(found, key=text.index, default=None)


def _character_error(
    character: str, location: messages.Location
) -> errors.SpecError:
  if character == '\t':
    return location.error('tab is not allowed (use spaces)')
  return location.error(f'character U+{ord(character):04X} is not allowed')


def _check_size(size: int, location: messages.Location) -> None:
  if size > _MAX_BYTES:
    tenths = math.ceil(10 * size / _MAX_BYTES)
    raise location.error(f'file is {tenths / 10} MiB, limit 1 MiB')


def _check_depth(depth: int, location: messages.Location) -> None:
  if depth > _MAX_DEPTH:
    raise location.error(f'nested deeper than {_MAX_DEPTH}')


def _spend(budget: Iterator[int], location: messages.Location) -> None:
  if next(budget, None) is None:
    raise location.error(f'more than {_MAX_VALUES} values in all')


def _check_entries(count: int, location: messages.Location) -> None:
  if count > _MAX_ENTRIES:
    raise location.error(f'more than {_MAX_ENTRIES} entries')


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
