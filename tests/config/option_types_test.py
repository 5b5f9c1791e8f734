"""Tests for options: their names, their types, and the paths among them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
import json
import os
import pathlib
from typing import Annotated, Any, final

import numpy as np
import numpy.typing as npt
import pydantic
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.experiments import experiment_specs
from realab_suite.feedback import specs
from tests.config import file_readers
from tests.config import off_limits
from tests.engine import helpers

_WATCH = off_limits.Watch()
_REGISTER = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': 'station_1',
    'range': [0, 13],
}
_QUERY = {**_REGISTER, 'role': 'query', 'place': 'station_2'}
_DEMONSTRATION = {'kind': 'demonstration', 'writes': ['reward']}
_ADVICE = {
    'kind': 'value_advice',
    'reads': ['query'],
    'writes': ['reward'],
    'value_function': 'apple_seeker_approval',
}
_READING = {'kind': 'test_reading', 'writes': ['reward']}


@pytest.fixture(autouse=True)
def _readers() -> Iterator[None]:
  with file_readers.registered():
    yield


@pytest.fixture
def outside() -> Iterator[pathlib.Path]:
  """A folder that is off limits, beside the working directory."""
  with off_limits.workplace() as folder:
    yield folder


def _design(provider: Any, **changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'd',
      'action_set': {'name': 'dmlab_like', 'version': 1},
      'registers': {'reward': _REGISTER, 'query': _QUERY},
      'providers': [provider],
      **changes,
  }


def _demonstrated(policy: str, **options: Any) -> dict[str, Any]:
  return {**_DEMONSTRATION, 'policy': policy, 'options': options}


def _approved(policy: str, **options: Any) -> dict[str, Any]:
  return {**_ADVICE, 'options': {'policy': policy, 'options': options}}


def _wrapped(depth: int, policy: str, **options: Any) -> dict[str, Any]:
  """A policy in so many others, as a demonstration."""
  for _ in range(depth):
    options = {'inner': policy, 'inner_options': options}
    policy = 'test_wrapping'
  return _demonstrated(policy, **options)


def _file(design: Any) -> str:
  # Written as JSON, which is YAML without anchors.
  pathlib.Path('given.yaml').write_text(json.dumps(design))
  return 'given.yaml'


def _refusal(load: Callable[[], Any]) -> str:
  """Returns why something is refused; nothing is opened off limits."""
  with _WATCH.only('.'):
    with pytest.raises(errors.SpecError) as caught:
      load()
    opened = [p for p in _WATCH.opened if off_limits.FOLDER in p]
  assert not opened
  text = str(caught.value)
  assert text.isprintable()
  return text


# Where a path can be, given the path: a design, and the key path.
_PLACES: dict[str, Callable[[Any], tuple[dict[str, Any], str]]] = {
    'weights of a demonstrator': lambda path: (
        _design(_demonstrated('network_demonstrator', weights=path)),
        'providers[0].options.weights',
    ),
    'weights of a value function': lambda path: (
        _design(
            {
                **_ADVICE,
                'value_function': 'network_values',
                'options': {'weights': path},
            }
        ),
        'providers[0].options.weights',
    ),
    'weights of the policy of a value function': lambda path: (
        _design(_approved('network_demonstrator', weights=path)),
        'providers[0].options.options.weights',
    ),
    'file of a policy in the policy of a value function': lambda path: (
        _design(
            _approved(
                'test_wrapping',
                inner='test_reader',
                inner_options={'file': path},
            )
        ),
        'providers[0].options.options.inner_options.file',
    ),
    **{
        f'{depth} policies deep': lambda path, depth=depth: (
            _design(_wrapped(depth, 'network_demonstrator', weights=path)),
            f'providers[0].options{".inner_options" * depth}.weights',
        )
        for depth in (1, 2, 5, 24)
    },
    **{
        what: lambda path, options=options, key=key: (
            _design(_demonstrated('test_reader', **options(path))),
            f'providers[0].options.{key}',
        )
        for what, options, key in (
            ('file', lambda p: {'file': p}, 'file'),
            ('optional file', lambda p: {'maybe': p}, 'maybe'),
            ('file or number', lambda p: {'either': p}, 'either'),
            ('file or object', lambda p: {'opaque': p}, 'opaque'),
            ('new type', lambda p: {'source': p}, 'source'),
            ('pathlib', lambda p: {'pure': p}, 'pure'),
            ('path-like', lambda p: {'like': p}, 'like'),
            ('list', lambda p: {'files': ['', p]}, 'files[1]'),
            ('tuple', lambda p: {'pair': ['/', p]}, 'pair[1]'),
            ('table', lambda p: {'table': {'/': ['', p]}}, "table['/'][1]"),
            ('model', lambda p: {'model': {'file': p}}, 'model.file'),
            ('models', lambda p: {'models': [{'file': p}]}, 'models[0].file'),
            ('dataclass', lambda p: {'data': {'file': p}}, 'data.file'),
            ('typed dict', lambda p: {'typed': {'file': p}}, 'typed.file'),
            ('required', lambda p: {'typed': {'must': p}}, 'typed.must'),
            ('root', lambda p: {'root': ['', p]}, 'root[1]'),
            ('own class', lambda p: {'own': p}, 'own'),
            ('annotation in quotes', lambda p: {'text': [p]}, 'text[0]'),
            ('quotes within', lambda p: {'inner': ['', p]}, 'inner[1]'),
            ('named tuple', lambda p: {'named': ['/', p]}, 'named[1]'),
        )
    },
    **{
        policy: lambda path, policy=policy: (
            _design(_demonstrated(policy, file=path)),
            'providers[0].options.file',
        )
        for policy in (
            'test_inheriting',
            'test_any_file',
            'test_function',
            'test_factory',
            'test_model',
            'test_partial',
            'test_partial_class',
        )
    },
    'key': lambda path: (
        _design(_demonstrated('test_reader', keyed={path: 1})),
        messages.format_path(('providers', 0, 'options', 'keyed', path)),
    ),
    'file of a provider': lambda path: (
        _design({**_READING, 'file': path}),
        'providers[0].file',
    ),
    'model of a provider': lambda path: (
        _design({**_READING, 'more': {'file': path}}),
        'providers[0].more.file',
    ),
    'policy that a provider names in its own way': lambda path: (
        _design(
            {
                **_READING,
                'teacher': 'test_reader',
                'teacher_options': {'file': path},
            }
        ),
        'providers[0].teacher_options.file',
    ),
    'second provider': lambda path: (
        _design(
            _demonstrated('no_op'),
            providers=[
                {**_DEMONSTRATION, 'policy': 'no_op'},
                {**_READING, 'writes': [], 'file': path},
            ],
        ),
        'providers[1].file',
    ),
    'file of a register': lambda path: (
        _design(
            _demonstrated('no_op'),
            registers={
                'reward': {
                    **_REGISTER,
                    'kind': 'test_reading',
                    'options': {'file': path},
                }
            },
        ),
        'registers.reward.options.file',
    ),
}


@pytest.mark.parametrize('place', _PLACES.values(), ids=_PLACES)
def test_a_path_is_found_at_any_depth_of_a_file(
    place: Any, outside: pathlib.Path
):
  for path in (
      str(outside / 'secret.npz'),
      f'../{outside.name}/secret.npz',
  ):
    design, key = place(path)
    text = _refusal(lambda design=design: specs.load(_file(design)))
    assert text == (
        f'given.yaml: {key}: {path!r} is outside the working directory; allowed'
        ' in a file are names, and paths within it'
    )
    text = _refusal(lambda design=design: specs.load(design, is_confined=True))
    assert text.startswith(f'design: {key}: ')


@pytest.mark.parametrize('place', _PLACES.values(), ids=_PLACES)
def test_a_path_that_a_user_gives_is_opened(place: Any, outside: pathlib.Path):
  # So that the test above can fail.
  path = str(outside / 'secret.npz')
  design, key = place(path)
  with _WATCH.only('.'):
    spec = specs.load(design)
    if key.startswith('registers'):  # A register is made with its world.
      suite.load('unlock_door', 'near', design=spec).close()
    assert os.path.realpath(path) in _WATCH.opened


@pytest.mark.parametrize('place', _PLACES.values(), ids=_PLACES)
def test_a_path_within_the_directory_may_be_named(
    place: Any, outside: pathlib.Path
):
  secret = (outside / 'secret.npz').read_bytes()
  pathlib.Path('sub', 'mine.npz').write_bytes(secret)
  for path in (
      'sub/mine.npz',
      './sub/../sub/mine.npz',
      os.path.abspath('sub/mine.npz'),
  ):
    design, _ = place(path)
    loaded = specs.load(_file(design), is_confined=True)
    assert specs.load(loaded.to_mapping()).digest() == loaded.digest()


@pytest.mark.parametrize(
    'path',
    [
        '/',
        '//etc/passwd',
        '..',
        '../',
        './..',
        'sub/../../x',
        'sub/./../..',
        '~',
        '~/x',
        '~root/x',
        'C:x',
        'c:/x',
        'C:\\x',
        '\\\\server\\share',
        '..\\x',
        'sub\\..\\..\\x',
        'file:///etc/passwd',
        'https://example.org/x.npz',
        's3://bucket/x',
        '/proc/self/environ',
        '/dev/stdin',
        'link.yaml',
        'linked/secret.npz',
        'linked/../off_limits/secret.npz',
        'twice/secret.npz',
        'sub/../linked/secret.npz',
        'loop/../../x',
    ],
)
def test_what_leads_out_of_the_directory(path: str, outside: pathlib.Path):
  off_limits.make_paths(outside)  # Makes links.
  os.symlink('loop', 'loop')
  design = _design(_wrapped(2, 'network_demonstrator', weights=path))
  text = _refusal(lambda: specs.load(_file(design)))
  assert 'is outside the working directory' in text
  assert 'inner_options.weights: ' in text


@pytest.mark.parametrize(
    'path', ['', '.', 'sub', 'x', 'a' * 5000, 'a/' * 300, '%s', '$HOME/x', '-']
)
def test_what_is_within_but_no_file_is_refused_too(
    path: str, outside: pathlib.Path
):
  design = _design(_wrapped(2, 'network_demonstrator', weights=path))
  text = _refusal(lambda: specs.load(_file(design)))
  assert text.startswith('given.yaml: providers[0]: weights ')
  assert 'are neither a file nor one of' in text


def test_a_path_with_an_escaped_nul_is_no_text(outside: pathlib.Path):
  design = _design(_wrapped(1, 'network_demonstrator', weights='a\0b'))
  text = _refusal(lambda: specs.load(_file(design)))
  assert 'inner_options.weights: character U+0000 is not allowed' in text


def test_a_text_that_is_no_path_may_be_anything(outside: pathlib.Path):
  label = '/etc/../~'
  for provider in (
      _demonstrated('test_reader', label=label, pair=[label, '']),
      _demonstrated('test_reader', model={'label': label}, either=3),
      {**_READING, 'label': label, 'teacher_options': {}},
      {
          **_READING,
          'teacher': 'test_reader',
          'teacher_options': {'label': label},
      },
  ):
    specs.load(_file(_design(provider)))


# Overrides.


_DEEP = 'providers.0.options.inner_options.weights'


def _within() -> dict[str, Any]:
  return _design(_wrapped(1, 'network_demonstrator', weights='demonstrator_v1'))


def test_overrides_are_the_users_own_unless_told_otherwise(
    outside: pathlib.Path,
):
  path = str(outside / 'secret.npz')
  wrapped = {
      'inner': 'network_demonstrator',
      'inner_options': {'weights': path},
  }
  for override in (
      f'{_DEEP}={path!r}',
      f'providers.0.options={json.dumps(wrapped)}',
      f'providers.0={json.dumps(_wrapped(1, "test_reader", file=path))}',
      f'providers={json.dumps([_wrapped(3, "test_reader", file=path)])}',
  ):
    with _WATCH.only('.'):
      specs.load(_file(_within()), (override,))
      assert os.path.realpath(path) in _WATCH.opened
    text = _refusal(
        lambda override=override: specs.load(
            _file(_within()), ('dof=planar', override), is_confined=True
        )
    )
    assert text.startswith(f'override {override!r:.60}'.rstrip("'"))
    assert f'{path!r} is outside the working directory' in text


def test_an_override_does_not_free_what_the_file_says(outside: pathlib.Path):
  path = str(outside / 'secret.npz')
  design = _design(_demonstrated('test_reader', label=path, files=['', path]))
  # The file has a path already.
  for override in ('dof=planar', 'providers.0.options.files.0=given.yaml'):
    text = _refusal(
        lambda override=override: specs.load(_file(design), (override,))
    )
    assert text.startswith('given.yaml: providers[0].options.files[1]: ')
  # What the file has becomes a path by the policy that the override names.
  design = _design(_demonstrated('test_wrapping', inner_options={'file': path}))
  override = 'providers.0.options.inner=test_reader'
  text = _refusal(lambda: specs.load(_file(design), (override,)))
  assert 'providers[0].options.inner_options' in text
  del design['providers'][0]['options']['inner_options']['file']
  design['providers'][0]['options'] = {'weights': path}
  text = _refusal(
      lambda: specs.load(
          _file(design), ('providers.0.policy=network_demonstrator',)
      )
  )
  assert text.startswith(
      "override 'providers.0.policy=network_demonstrator':"
      f' providers[0].options.weights: {path!r} is outside'
  )
  # A key that only begins alike frees nothing.
  design = _design(_demonstrated('test_any_file', weights=path))
  override = 'providers.0.options.weights_2=x'
  text = _refusal(lambda: specs.load(_file(design), (override,)))
  assert text.startswith('given.yaml: providers[0].options.weights: ')


def test_experiments_are_confined_with_their_overrides(outside: pathlib.Path):
  path = str(outside / 'secret.npz')
  pathlib.Path('within.yaml').write_text(json.dumps(_within()))
  without = _design(_wrapped(1, 'network_demonstrator', weights=path))
  pathlib.Path('without.yaml').write_text(json.dumps(without))
  (outside / 'design.yaml').write_text(json.dumps(_within()))
  learner = {'learner': {'kind': 'behavioural_cloning'}}

  def experiment(**run: Any) -> dict[str, Any]:
    return {
        'schema': 1,
        'name': 'e',
        'task': 'unlock_door.near',
        'runs': {'one': {**learner, **run}},
        'seeds': [0],
    }

  for run, place in (
      ({'design': 'without.yaml'}, 'runs.one: without.yaml: providers[0].opt'),
      (
          {'design': 'within.yaml', 'overrides': [f'{_DEEP}={path}']},
          f"runs.one: override '{_DEEP}=",
      ),
      ({'design': str(outside / 'design.yaml')}, 'runs.one.design: '),
      ({'design': f'../{outside.name}/design.yaml'}, 'runs.one.design: '),
  ):
    text = _refusal(
        lambda run=run: experiment_specs.load(_file(experiment(**run)))
    )
    assert text.startswith(f'given.yaml: {place}')
    assert 'is outside the working directory' in text
  experiment_specs.load(_file(experiment(design='within.yaml')))
  # Users name what they like.
  own = experiment(
      design=str(outside / 'design.yaml'), overrides=[f'{_DEEP}={path}']
  )
  with _WATCH.only('.'):
    experiment_specs.load(own)
    assert os.path.realpath(path) in _WATCH.opened


# Names and types.


@final
class _Typed(policies.Policy):
  """Declares options of many types."""

  def __init__(
      self,
      needed: int,
      number: Annotated[float, pydantic.Field(gt=0)] = 1.0,
      flag: bool = False,
      pair: tuple[float, float] = (0.0, 0.0),
      sequence: Sequence[float] = (),
      mapping: Mapping[str, int] | None = None,
      array: npt.ArrayLike = (),
      ndarray: np.ndarray | None = None,
      untyped=None,
      odd: 'list[str]' = (),  # type: ignore[assignment]
  ) -> None:
    self.given = needed, number, flag, pair, sequence, mapping, array
    self.more = ndarray, untyped, odd

  def step(
      self, observation: Any, episode_start: Any, key: Any, state: Any
  ) -> tuple[np.ndarray, Any]:
    return np.zeros(np.shape(episode_start), int), state


@final
class _Unreadable(policies.Policy):
  """Has an annotation that names nothing."""

  def __init__(self, thing: 'Nothing' = None) -> None:  # type: ignore # noqa
    del thing

  def step(
      self, observation: Any, episode_start: Any, key: Any, state: Any
  ) -> tuple[np.ndarray, Any]:
    return np.zeros(np.shape(episode_start), int), state


@pytest.fixture
def _typed() -> Iterator[None]:
  with (
      helpers.registered(policies.POLICIES, 'test_typed', _Typed),
      helpers.registered(policies.POLICIES, 'test_unreadable', _Unreadable),
  ):
    yield


@pytest.mark.parametrize('depth', [0, 1, 3])
@pytest.mark.parametrize(
    ('policy', 'options', 'message'),
    [
        ('no_op', {'speed': 1}, ": unknown key 'speed' (allowed: none)"),
        (
            'apple_seeker',
            {'half_widht': 3},
            ": unknown key 'half_widht'; did you mean 'half_width'? (allowed:"
            ' half_width)',
        ),
        ('apple_seeker', {'self': 3}, ": unknown key 'self' (allowed: half_w"),
        (
            'apple_seeker',
            {'half_width': 'wide'},
            ".half_width: must be a valid number, got 'wide'",
        ),
        (
            'apple_seeker',
            {'half_width': True},
            '.half_width: must be a valid number, got True',
        ),
        (
            'apple_seeker',
            {'half_width': None},
            '.half_width: must be a valid number, got None',
        ),
        (
            'apple_seeker',
            {'half_width': -1},
            '.half_width: must be greater than 0, got -1',
        ),
        (
            'apple_seeker',
            {'half_width': 1e9},
            '.half_width: must be less than or equal to 100, got 1000000000.0',
        ),
        (
            'network_demonstrator',
            {'weights': 5},
            '.weights: must be a valid string, got 5',
        ),
        (
            'network_demonstrator',
            {'weights': ['demonstrator_v1']},
            ".weights: must be a valid string, got ['demonstrator_v1']",
        ),
        (
            'pushing_saboteur',
            {'target': [1, 2, 3]},
            '.target: must have at most 2 items',
        ),
        (
            'pushing_saboteur',
            {'target': [1]},
            '.target[1]: required key is missing',
        ),
        (
            'pushing_saboteur',
            {'target': [1, 'x']},
            ".target[1]: must be a valid number, got 'x'",
        ),
        (
            'pushing_saboteur',
            {'target': [1e300, 0]},
            '.target[0]: must be less than or equal to 10000, got 1e+300',
        ),
        ('test_typed', {'flag': False}, '.needed: required key is missing'),
        ('test_typed', {'needed': 1.5}, '.needed: must be a valid integer, g'),
        ('test_typed', {'needed': '1'}, '.needed: must be a valid integer, g'),
        (
            'test_typed',
            {'needed': 1, 'flag': 'no'},
            ".flag: must be a valid boolean, got 'no'",
        ),
        (
            'test_typed',
            {'needed': 1, 'number': 0},
            '.number: must be greater than 0, got 0',
        ),
        (
            'test_typed',
            {'needed': 1, 'mapping': {'a': 'x'}},
            ".mapping.a: must be a valid integer, got 'x'",
        ),
        (
            'test_typed',
            {'needed': 1, 'odd': ['x', 3]},
            '.odd[1]: must be a valid string, got 3',
        ),
        (
            'test_unreadable',
            {'thing': 1},
            ": the options of 'test_unreadable' cannot be read from its"
            " signature: name 'Nothing' is not defined",
        ),
        (
            'test_wrapping',
            {'inner': 'no_opp'},
            ".inner: policy 'no_opp' is unknown; did you mean 'no_op'?",
        ),
        (
            'test_wrapping',
            {'inner': 3},
            '.inner: must be a valid string, got 3',
        ),
        (
            'test_wrapping',
            {'inner_options': [1]},
            '.inner_options: must be a mapping, got [1]',
        ),
        (
            'test_any_file',
            {'this': 3},
            '.this: must be a valid string, got 3',
        ),
        (
            'test_inheriting',
            {'mine': 'x'},
            ".mine: must be a valid integer, got 'x'",
        ),
        (
            'test_inheriting',
            {'files': 'x'},
            ".files: must be a valid list, got 'x'",
        ),
        ('test_inheriting', {'no': 1}, ": unknown key 'no' (allowed: mine, fi"),
        ('test_function', {'lable': 'x'}, "; did you mean 'label'? (allowed: "),
    ],
)
@pytest.mark.usefixtures('_typed')
def test_wrong_options_are_refused_when_a_design_is_loaded(
    policy: str, options: dict[str, Any], message: str, depth: int
):
  with pytest.raises(errors.SpecError) as caught:
    specs.load(_design(_wrapped(depth, policy, **options)))
  key = f'providers[0].options{".inner_options" * depth}'
  text = str(caught.value)
  assert text.startswith(f'design: {key}')
  assert message in text
  assert text.isprintable()
  assert ';' not in text.replace('; did you mean', '').replace('; known', '')


def test_several_wrong_options_are_all_named():
  options = {'half_width': 'x', 'speed': 1}
  with pytest.raises(errors.SpecError) as caught:
    specs.load(_design(_approved('apple_seeker', **options)))
  text = str(caught.value)
  assert "options.options.half_width: must be a valid number, got 'x'" in text
  assert "options.options: unknown key 'speed' (allowed: half_width)" in text


@pytest.mark.usefixtures('_typed')
def test_right_options_are_accepted_and_stay_as_they_are():
  for policy, options in (
      ('apple_seeker', {'half_width': 3}),
      ('network_demonstrator', {'weights': 'demonstrator_v1'}),
      ('pushing_saboteur', {'target': [1, -2.5], 'direction': [0, 1]}),
      ('test_typed', {'needed': 3, 'pair': [1, 2], 'sequence': [1, 2.5]}),
      ('test_typed', {'needed': 3, 'mapping': {'a': 1}, 'untyped': {'b': []}}),
      # Only the class can tell what it makes of these.
      ('test_typed', {'needed': 3, 'array': [[1, 2], [3, 4]]}),
      ('test_typed', {'needed': 3, 'ndarray': [1, 2]}),
      ('test_unreadable', {}),
      ('test_wrapping', {}),
      ('test_wrapping', {'inner_options': None}),
  ):
    for depth in (0, 2):
      design = _design(_wrapped(depth, policy, **options))
      loaded = specs.load(design)
      assert json.dumps(loaded.to_mapping()['providers'][0]['options']) == (
          json.dumps(design['providers'][0]['options'])
      )


def test_a_constructor_that_fails_is_a_spec_error():
  for error in (
      ValueError('bad'),
      KeyError('k'),
      OSError(2, 'no'),
      MemoryError(),
  ):

    def make(error: Exception = error) -> policies.Policy:
      raise error

    with helpers.registered(policies.POLICIES, 'test_failing', make):
      for load in (
          lambda: policies.make('test_failing'),
          lambda: specs.load(_design(_demonstrated('test_failing'))),
          lambda: specs.load(_design(_approved('test_failing'))),
      ):
        with pytest.raises(errors.SpecError) as caught:
          load()
        assert type(error).__name__ in str(caught.value)
        assert "policy 'test_failing'" in str(caught.value)


def test_options_of_a_register_are_checked_when_a_design_is_loaded():
  for options, message in (
      ({'name': 'x'}, "options: unknown key 'name' (allowed: file, label)"),
      ({'scale': 1}, "options: unknown key 'scale' (allowed: file, label)"),
      ({'file': 1}, 'options.file: must be a valid string, got 1'),
      ({'labl': 'x'}, "options: unknown key 'labl'; did you mean 'label'?"),
  ):
    register = {**_REGISTER, 'kind': 'test_reading', 'options': options}
    with pytest.raises(errors.SpecError) as caught:
      specs.load(
          _design(_demonstrated('no_op'), registers={'reward': register})
      )
    assert f'registers.reward.{message}' in str(caught.value)


def test_what_classes_declare():
  declared = option_types.declared_by(file_readers.Inheriting)
  assert list(declared.annotations)[:3] == ['mine', 'file', 'maybe']
  assert declared.defaults['mine'] == 0
  assert declared.others is None
  declared = option_types.declared_by(file_readers.AnyFile)
  assert not declared.annotations
  assert declared.others == option_types.FilePath
