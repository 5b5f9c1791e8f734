"""Reading of untrusted YAML files and mappings, and overrides of their values.

A description is a YAML file, or a mapping of the same shape. The YAML library
builds mappings, lists, strings, numbers, booleans and nulls, and no objects.
Before, its events are checked, because it builds what is nested by recursion
and would overflow the stack on a text of many brackets. Anchors, aliases and
tags are refused.

Unquoted `true`, `false`, `null`, `~`, plain decimal integers and decimal floats
(including `1e3`) have their usual meaning. Other words that YAML 1.1 converts,
such as `yes`, `012`, `1:30`, `0x1f` or `2024-01-01`, are refused, because YAML
1.2 keeps them as text. `validation` checks descriptions against a schema.
"""

from collections.abc import Iterator, Mapping, Sequence
import copy
import math
import os
import re
import sys
from typing import Any, ClassVar, final
import unicodedata

import yaml

from realab_suite.config import messages

_MAX_BYTES = 2**20
_MAX_DEPTH = 32
_MAX_ENTRIES = 1000
_TOO_DEEP = f'nested deeper than {_MAX_DEPTH}'
# Larger integers are not exact as floats, and a field may convert them.
_MAX_INT = 2**53

# Categories of Unicode: control, format (which includes bidirectional marks and
# other byte order marks), surrogate, line separator and paragraph separator.
_FORBIDDEN_CATEGORIES = frozenset({'Cc', 'Cf', 'Cs', 'Zl', 'Zp'})
# Not characters of YAML.
_NONCHARACTERS = '\ufffe\uffff'

_TAG = 'tag:yaml.org,2002:'
_AMBIGUOUS = 'ambiguous'
# Patterns of unquoted words. Others are ambiguous if YAML 1.1 converts them.
_WORDS = tuple(
    (tag, re.compile(rf'(?:{pattern})\Z'))
    for tag, pattern in (
        (f'{_TAG}null', '~|null|Null|NULL|'),
        (f'{_TAG}bool', 'true|True|TRUE|false|False|FALSE'),
        (f'{_TAG}int', r'[-+]?(0|[1-9][0-9]*)'),
        (
            f'{_TAG}float',
            r'[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?'
            r'|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)',
        ),
        # Often meant as booleans, and octal numbers of YAML 1.2.
        (_AMBIGUOUS, r'(?i:yes|no|on|off)|[-+]?0[oO][0-7]+'),
    )
)


def read_mapping(
    source: str | os.PathLike[str] | Mapping[str, Any],
) -> dict[str, Any]:
  """Returns a checked description that shares nothing with its source.

  Args:
    source: Path of a YAML file, or a mapping of the same shape. Sequences in it
      become lists, -0.0 becomes 0.0, and subclasses of the plain types (such as
      NumPy's float64) become the plain types.

  Raises:
    SpecError: If the file cannot be read, if it contains something that this
      module's docstring does not allow, or if a mapping contains something that
      such a file cannot contain.
  """
  if isinstance(source, Mapping):
    return dict(_plain(source, '<mapping>'))
  path = os.fsdecode(source)
  return parse_yaml(read_file(path, _MAX_BYTES), path)


def is_list(value: Any) -> bool:
  """Returns True for a list, perhaps of a library such as OmegaConf."""
  is_text = isinstance(value, str | bytes | bytearray)
  return isinstance(value, Sequence) and not is_text


def with_lists(value: Any) -> Any:
  """Returns a value with the lists and mappings of Python, at any depth."""
  if isinstance(value, Mapping):
    return {key: with_lists(item) for key, item in value.items()}
  if is_list(value) and not isinstance(value, tuple):
    return [with_lists(item) for item in value]
  return value


def read_file(path: str, max_bytes: int) -> bytes:
  """Returns the contents of a file of limited size.

  Raises:
    SpecError: If the file is larger or cannot be read.
  """
  location = messages.Location(path)
  # Opening a named pipe would block, so the type is checked first.
  if not os.path.isfile(path):
    exists = os.path.exists(path)
    raise location.error('not a file' if exists else 'no such file')
  try:
    with open(path, 'rb') as stream:
      content = stream.read(max_bytes + 1)
  except OSError as error:
    raise location.error(f'cannot be read: {error.strerror}') from None
  _check_size(len(content), max_bytes, location)
  return content


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
  if len(documents) == 1 and isinstance(documents[0], dict):
    return documents[0]
  got = f'{len(documents)} documents'
  if len(documents) == 1:
    got = messages.quote(documents[0])
  raise messages.Location(where).error(
      f'expected a mapping at top level, got {got}'
  )


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
  result: dict[str, Any] = copy.deepcopy(dict(data))
  for override in overrides:
    keys, value = _split(override)
    where = override_name(override)
    node: Any = result
    for depth, key in enumerate(keys):
      position: str | int = key
      # Compared as text, because Python cannot convert very long integers.
      if isinstance(node, list) and key in map(str, range(len(node))):
        position = int(key)
      elif not isinstance(node, dict):
        parent = messages.quote('.'.join(keys[:depth]))
        raise messages.Location(where).error(
            f'{messages.quote(key)} is not in {parent}, which is'
            f' {messages.quote(node)}; must be a key of a mapping or an index'
            ' of a list'
        )
      if depth == len(keys) - 1:
        node[position] = value
      elif isinstance(node, dict):
        node = node.setdefault(position, {})
      else:
        node = node[position]
    # With the new value, the data may be too deep or have too many entries.
    result = _plain(result, where)
  return result


def hint_at_keys(override: str, data: Mapping[str, Any]) -> str:
  """Returns a hint at the keys that a misspelt override may mean, or ''.

  Args:
    override: Override that can be applied.
    data: Data that it is applied to.
  """
  keys, _ = _split(override)
  node: Any = data
  for depth, key in enumerate(keys):
    if not isinstance(node, Mapping):
      break
    if key not in node:
      close = messages.nearest(key, node)
      meant = '.'.join([*keys[:depth], close or ''])
      return f'; did you mean {meant!r}?' if close else ''
    node = node[key]
  return ''


def override_name(override: object) -> str:
  """Returns the name of an override in error messages."""
  return f'override {messages.quote(override)}'


def texts_in(value: Any) -> Iterator[str]:
  """Yields every text in nested lists and mappings, keys included."""
  if isinstance(value, str):
    yield value
  elif isinstance(value, Mapping):
    for key, item in value.items():
      yield from texts_in(key)
      yield from texts_in(item)
  elif is_list(value):
    for item in value:
      yield from texts_in(item)


def _split(override: str) -> tuple[list[str], Any]:
  """Returns the keys of an override and its value."""
  where = override_name(override)
  location = messages.Location(where)
  if not isinstance(override, str) or '=' not in override:
    raise location.error('expected key=value, as a text')
  name, _, text = override.partition('=')
  keys = name.split('.')
  if not all(key.strip() for key in keys):
    raise location.error('empty key')
  documents = _documents(text, where)
  if len(documents) != 1:
    raise location.error(
        "expected one value (null, or '' for empty text), got"
        f' {len(documents)}'
    )
  return keys, documents[0]


def _check_size(size: int, max_bytes: int, location: messages.Location) -> None:
  if size > max_bytes:
    raise location.error(f'larger than {max_bytes} bytes, the largest size')


def _documents(text: str | bytes, where: str) -> list[Any]:
  """Returns the value of each document in a YAML text; there may be none."""
  location = messages.Location(where)
  try:
    content = text
    if isinstance(content, str):
      # Surrogates are refused below, with their line.
      content = content.encode(errors='surrogatepass')
    _check_size(len(content), _MAX_BYTES, location)
    text = _decoded(content, where).replace('\r\n', '\n')
    for number, line in enumerate(text.split('\n'), 1):
      if not line.isprintable() and (problem := _forbidden_character(line)):
        raise messages.Location(where, line=number).error(problem)
    _check_events(text)
    documents = yaml.load_all(text, _Loader)  # noqa: TID251
    return [_plain(document, where) for document in documents]
  except yaml.MarkedYAMLError as error:
    mark = error.problem_mark
    at = messages.Location(where, line=None if mark is None else mark.line + 1)
    raise at.error(str(error.problem)) from None
  # A tag may contain bytes that are not UTF-8.
  except (yaml.YAMLError, UnicodeError) as error:
    raise location.error(f'not YAML: {error}') from None


def _decoded(content: bytes, where: str) -> str:
  """Returns a text without the byte order mark that some editors write."""
  try:
    return content.decode('utf-8-sig', errors='surrogatepass')
  except UnicodeDecodeError as error:
    line = content.count(b'\n', 0, error.start) + 1
    raise messages.Location(where, line=line).error(
        f'not UTF-8 text: {error.reason}'
    ) from None


def _check_events(text: str) -> None:
  """Checks what the library must not build.

  Raises:
    YAMLError: If the text is not YAML, is nested too deeply, or has anchors,
      aliases or tags.
  """
  depth = 0
  for event in yaml.parse(text, _Loader):
    depth += isinstance(event, yaml.CollectionStartEvent)
    depth -= isinstance(event, yaml.CollectionEndEvent)
    if depth > _MAX_DEPTH:
      raise _refusal(event, _TOO_DEEP)
    if getattr(event, 'anchor', None):
      raise _refusal(event, 'anchors and aliases are not allowed')
    if tag := getattr(event, 'tag', None):
      raise _refusal(event, f'tag {messages.quote(tag)} not allowed')


def _mapping(loader: Any, node: yaml.MappingNode) -> dict[str, Any]:
  """Returns the value of a mapping, whose keys are texts and differ."""
  mapping: dict[str, Any] = {}
  lines: dict[str, int] = {}
  for key_node, value_node in node.value:
    key = _built(loader, key_node)
    if not isinstance(key, str):
      raise _refusal(key_node, _wrong_key(key))
    line = key_node.start_mark.line + 1
    if key in mapping:
      both = f'lines {lines[key]} and {line}'
      raise _refusal(key_node, f'duplicate key {messages.quote(key)} ({both})')
    lines[key] = line
    mapping[key] = _built(loader, value_node)
  return mapping


def _list(loader: Any, node: yaml.SequenceNode) -> list[Any]:
  return [_built(loader, item) for item in node.value]


def _built(loader: Any, node: yaml.Node) -> Any:
  # Without aliases, no object is built twice, so none need be remembered.
  return loader.yaml_constructors[node.tag](loader, node)


def _integer(loader: Any, node: yaml.ScalarNode) -> int:
  del loader
  # Python cannot convert thousands of digits. Fewer are out of range as well.
  return int(node.value[:100])


def _refuse_word(loader: Any, node: yaml.ScalarNode) -> None:
  del loader
  raise _refusal(
      node,
      f'{messages.quote(node.value)} is ambiguous: quote it if it is text, or'
      ' write true, false or a plain decimal number',
  )


# Some builds of the library lack the faster loader.
_LibraryLoader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


@final
class _Loader(_LibraryLoader):
  """Builds plain values; unquoted words have the meaning of YAML 1.2."""

  yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
      first: [*_WORDS, *((_AMBIGUOUS, pattern) for _, pattern in patterns)]
      for first, patterns in (
          yaml.resolver.Resolver.yaml_implicit_resolvers.items()
      )
  }
  yaml_constructors: ClassVar[dict[Any, Any]] = {
      **yaml.SafeLoader.yaml_constructors,
      f'{_TAG}map': _mapping,
      f'{_TAG}seq': _list,
      f'{_TAG}int': _integer,
      _AMBIGUOUS: _refuse_word,
  }


def _refusal(place: Any, problem: str) -> yaml.MarkedYAMLError:
  """Returns the error of an event or a node."""
  return yaml.MarkedYAMLError(problem=problem, problem_mark=place.start_mark)


def _wrong_key(key: object) -> str:
  return f'keys must be strings, got {messages.quote(key)} (quote it)'


def _plain(value: Any, where: str, path: tuple[str | int, ...] = ()) -> Any:
  """Returns a copy of a value that consists of exactly the plain types.

  Args:
    value: The value.
    where: Name of the data in error messages.
    path: Keys and indices that lead to the value.

  Raises:
    SpecError: If the value is not allowed in a description.
  """
  problem = ''
  if isinstance(value, str):  # First, because most values are texts.
    # Printable characters are in none of the forbidden categories.
    problem = '' if value.isprintable() else _forbidden_character(value)
    # Not str(value): a subclass, such as a text enum, may override it.
    value = str.__str__(value)
  elif isinstance(value, float):
    if not math.isfinite(value):
      problem = f'must be finite, got {value}'
    # MuJoCo's parser reports a subnormal number as out of range.
    elif 0 < abs(value) < sys.float_info.min:
      problem = f'number {value} is out of range'
    # Adding 0.0 turns -0.0 into 0.0: equal descriptions have equal texts.
    value = float(value) + 0.0
  elif isinstance(value, int) and not isinstance(value, bool):
    if abs(value) > _MAX_INT:
      problem = f'integer {messages.quote(value)} is out of range'
    value = int(value)
  elif isinstance(value, Mapping) or is_list(value):
    if len(path) >= _MAX_DEPTH:
      problem = _TOO_DEEP
    elif len(value) > _MAX_ENTRIES:
      problem = f'more than {_MAX_ENTRIES} entries'
    elif not isinstance(value, Mapping):
      return [_plain(one, where, (*path, i)) for i, one in enumerate(value)]
    elif wrong := [key for key in value if not isinstance(key, str)]:
      problem = _wrong_key(wrong[0])
    else:
      return {
          _plain(key, where, path): _plain(item, where, (*path, key))
          for key, item in value.items()
      }
  elif value is not None and not isinstance(value, bool):
    problem = (
        'expected a mapping, list, string, number, boolean or null, got'
        f' {messages.quote(value)}'
    )
  if problem:
    raise messages.Location(where, path).error(problem)
  return value


def _forbidden_character(text: str) -> str:
  """Returns the problem with the characters of a text, or ''."""
  for character in dict.fromkeys(text):
    if character == '\t':
      return 'tab is not allowed (use spaces)'
    category = unicodedata.category(character)
    is_forbidden = category in _FORBIDDEN_CATEGORIES and character != '\n'
    if is_forbidden or character in _NONCHARACTERS:
      return f'character U+{ord(character):04X} is not allowed'
  return ''
