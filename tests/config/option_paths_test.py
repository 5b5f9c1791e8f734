"""Tests for paths in options: those of a file stay in the working directory."""

from collections.abc import Callable, Iterator
import json
import os
import pathlib
from typing import Any

import pydantic
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.config import messages
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests.config import file_readers
from tests.config import off_limits
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs

_WATCH = off_limits.Watch()
_PATH = '<path>'  # Stands for a path in a design.
_REGISTER = {**designs.REWARD, 'range': [0, 13]}
_DEMONSTRATION = {'kind': 'demonstration', 'writes': ['reward']}
_ADVICE = designs.ADVISED['providers'][0]
_READING = {'kind': 'test_reading', 'writes': ['reward']}


@pytest.fixture(autouse=True)
def outside() -> Iterator[pathlib.Path]:
  """A folder that is off limits, beside the working directory."""
  with file_readers.registered(), off_limits.workplace() as folder:
    yield folder


def _design(provider: Any, **changes: Any) -> dict[str, Any]:
  registers = {'reward': _REGISTER, 'query': designs.QUERY}
  return {
      **designs.ADVISED, 'registers': registers, 'providers': [provider],
      **changes,
  }  # fmt: skip


def _demonstrated(policy: str, **options: Any) -> dict[str, Any]:
  return {**_DEMONSTRATION, 'policy': policy, 'options': options}


def _approved(policy: str, **options: Any) -> dict[str, Any]:
  return {**_ADVICE, 'options': {'policy': policy, 'options': options}}


def _wrapped(depth: int, policy: str, **options: Any) -> dict[str, Any]:
  """Returns a demonstration by a policy inside of `depth` others."""
  for _ in range(depth):
    options = {'inner': policy, 'inner_options': options}
    policy = 'test_wrapping'
  return _demonstrated(policy, **options)


def _file(design: Any) -> str:
  # Written as JSON, which is YAML without anchors.
  pathlib.Path('given.yaml').write_text(json.dumps(design))
  return 'given.yaml'


def _refusal(load: Callable[..., Any], *args: Any, **kwargs: Any) -> str:
  """Returns the refusal of a call that opens no file off limits."""
  with _WATCH.only('.'):
    text = refusals.refusal(load, *args, **kwargs)
    opened = [p for p in _WATCH.opened if off_limits.FOLDER in p]
  assert not opened
  return text


# Options of `test_reader` with a path, in types of every kind.
_OPTIONS: list[dict[str, Any]] = [
    *({name: _PATH} for name in ('file', 'opaque')),
    {'files': ['', _PATH]},
    {'models': [{'file': _PATH}]},
]
_NO_OP = _demonstrated('no_op')
_READING_REGISTER = {
    **_REGISTER, 'kind': 'test_reading', 'options': {'file': _PATH},
}  # fmt: skip
# Designs with a path somewhere.
_PLACES: dict[str, dict[str, Any]] = {
    **{f'option {option}': _design(_demonstrated('test_reader', **option))
        for option in _OPTIONS},
    **{f'file of {policy}': _design(_demonstrated(policy, file=_PATH))
        for policy in ('test_inheriting', 'test_function')},
    '24 policies deep': _design(_wrapped(24, 'network_demonstrator',
        weights=_PATH)),
    'weights of a value function': _design({**_ADVICE,
        'value_function': 'network_values', 'options': {'weights': _PATH}}),
    'inner policy of a value function': _design(_approved('test_wrapping',
        inner='test_reader', inner_options={'file': _PATH})),
    'model of a provider': _design({**_READING, 'more': {'file': _PATH}}),
    'policy of a provider': _design({**_READING, 'teacher': 'test_reader',
        'teacher_options': {'file': _PATH}}),
    'second provider': _design(
        _NO_OP, providers=[_NO_OP, {**_READING, 'writes': [], 'file': _PATH}]),
    'register': _design(_NO_OP, registers={'reward': _READING_REGISTER})
}  # fmt: skip


def _keys(node: Any) -> tuple[Any, ...] | None:
  """Returns the keys that lead to the path in a design."""
  if node == _PATH:
    return ()
  pairs: Any = node.items() if isinstance(node, dict) else ()
  for key, value in enumerate(node) if isinstance(node, list) else pairs:
    below = _keys(value)
    if below is not None:
      return (key, *below)
  return None


def _filled(design: Any, path: str) -> Any:
  """Returns a design with a path in its place."""
  return json.loads(json.dumps(design).replace(_PATH, path))


@pytest.mark.parametrize('place', _PLACES.values(), ids=_PLACES)
def test_a_path_is_confined_where_a_file_names_it(
    place: dict[str, Any], outside: pathlib.Path
):
  path = str(outside / 'secret.npz')
  design = _filled(place, path)
  key = messages.format_path(_keys(place) or ())
  problem = (
      f'{key}: {path!r} is outside the working directory; allowed in a file'
      ' are names, and paths within it'
  )
  assert _refusal(specs.load, _file(design)) == f'given.yaml: {problem}'
  text = _refusal(specs.load, design, is_confined=True)
  assert text == f'design: {problem}'
  # A mapping may name any file, and the option opens it.
  with _WATCH.only('.'):
    spec = specs.load(design)
    if key.startswith('registers'):  # A register is made with its world.
      suite.load('unlock_door', 'near', design=spec).close()
    assert os.path.realpath(path) in _WATCH.opened
  # A file may name what is within the directory.
  secret = pathlib.Path(path).read_bytes()
  pathlib.Path('sub', 'mine.npz').write_bytes(secret)
  design = _filled(place, './sub/../sub/mine.npz')
  loaded = specs.load(_file(design), is_confined=True)
  assert specs.load(loaded.to_mapping()).digest() == loaded.digest()


@pytest.mark.parametrize('path', ['.', 'a' * 5000])
def test_a_path_that_is_no_file_is_refused(path: str):
  design = _design(_wrapped(1, 'network_demonstrator', weights=path))
  text = _refusal(specs.load, _file(design))
  assert text.startswith('given.yaml: providers[0]: weights ')
  assert 'are neither a file nor one of' in text


def test_options_that_are_not_paths_may_contain_any_text():
  label = '/etc/../~'
  teacher = {'teacher': 'test_reader', 'teacher_options': {'label': label}}
  for provider in (
      _demonstrated('test_reader', label=label),
      _demonstrated('test_reader', models=[{'label': label}]),
      {**_READING, 'label': label, **teacher},
  ):
    [loaded] = specs.load(_file(_design(provider))).to_mapping()['providers']
    assert label in json.dumps(loaded)


class _Folder(pydantic.BaseModel):
  """A model with a path that is not checked."""

  path: pathlib.Path


@pytest.mark.parametrize('declared', [pathlib.Path, list[_Folder] | None])
def test_paths_of_types_that_are_not_checked_are_refused(declared: Any):
  def make(file: declared = 'x') -> policies.Policy:
    raise AssertionError(file)

  with helpers.registered(policies.POLICIES, 'test_unchecked', make):
    text = _refusal(
        specs.load, _design(_demonstrated('test_unchecked', file='x'))
    )
  assert text.endswith('; allowed for a path is FilePath')


# Overrides.


_DEEP = 'providers.0.options.inner_options.weights'


def _within() -> dict[str, Any]:
  return _design(_wrapped(1, 'network_demonstrator', weights='demonstrator_v1'))


def test_overrides_may_name_any_file_unless_they_are_confined(
    outside: pathlib.Path,
):
  path = str(outside / 'secret.npz')
  for override in (
      f'{_DEEP}={path!r}',
      f'providers={json.dumps([_wrapped(3, "test_reader", file=path)])}',
  ):
    with _WATCH.only('.'):
      specs.load(_file(_within()), (override,))
      assert os.path.realpath(path) in _WATCH.opened
    overrides = ('dof=planar', override)
    text = _refusal(specs.load, _file(_within()), overrides, is_confined=True)
    assert text.startswith(f'override {override!r:.60}'.rstrip("'"))
    assert f'{path!r} is outside the working directory' in text


def test_a_path_of_the_file_stays_confined_beside_overrides(
    outside: pathlib.Path,
):
  path = str(outside / 'secret.npz')
  design = _design(_demonstrated('test_reader', label=path, files=['', path]))
  for override in ('dof=planar', 'providers.0.options.files.0=given.yaml'):
    text = _refusal(specs.load, _file(design), (override,))
    assert text.startswith('given.yaml: providers[0].options.files[1]: ')


_TRUSTING = ('learner', 'defence', 'trusted', 'options', 'weights')


def _trusting(path: str) -> dict[str, Any]:
  trusted = {'policy': 'network_demonstrator', 'options': {'weights': path}}
  return {
      'kind': 'policy_gradient', 'reward': 'reward',
      'defence': {'kind': 'orpo', 'trusted': trusted},
  }  # fmt: skip


def test_files_that_a_learner_names_are_confined(outside: pathlib.Path):
  path = str(outside / 'secret.npz')
  design = _design(_demonstrated('random'), learner=_trusting(path))
  text = _refusal(specs.load, _file(design))
  assert f'{path!r} is outside the working directory' in text
  inside = _design(_demonstrated('random'), learner=_trusting('own.npz'))
  override = f'{".".join(_TRUSTING)}={path}'
  specs.load(_file(inside), (override,))
  text = _refusal(specs.load, _file(inside), (override,), is_confined=True)
  assert f'{path!r} is outside the working directory' in text
  run = {'design': 'instantaneous_reward', 'learner': _trusting(path)}
  experiment = {
      'schema': 1, 'name': 'e', 'task': 'unlock_door.near',
      'runs': {'one': run}, 'seeds': [0],
  }  # fmt: skip
  text = _refusal(experiment_specs.load, _file(experiment))
  assert 'runs.one' in text
  assert f'{path!r} is outside the working directory' in text


def test_designs_that_an_experiment_names_are_confined(outside: pathlib.Path):
  path = str(outside / 'secret.npz')
  without = _design(_wrapped(1, 'network_demonstrator', weights=path))
  pathlib.Path('without.yaml').write_text(json.dumps(without))
  run = {'design': 'without.yaml', 'learner': {'kind': 'mine'}}
  experiment = {
      'schema': 1,
      'name': 'e',
      'task': 'unlock_door.near',
      'runs': {'one': run},
      'seeds': [0],
  }
  for given in (_file(experiment), experiment):
    text = _refusal(experiment_specs.load, given)
    assert ': runs.one: without.yaml: providers[0].options.inner_opt' in text
    assert f'{path!r} is outside the working directory' in text
  # An experiment that is not a file may name any path, also in an override.
  run['overrides'] = [f'{_DEEP}={path}']
  text = _refusal(experiment_specs.load, _file(experiment))
  assert f'{path!r} is outside the working directory' in text
  with _WATCH.only('.'):
    experiment_specs.load(experiment)
    assert os.path.realpath(path) in _WATCH.opened
