"""Tests that the parts of a design fit each other."""

from typing import Any, Literal, final

import pytest

from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import stubs


def _register(role: str, low: float, high: float) -> dict[str, Any]:
  initial = max(low, 0)
  return {
      **designs.REWARD, 'role': role, 'range': [low, high], 'initial': initial,
  }  # fmt: skip


def _design(
    given: list[dict[str, Any]], meters: tuple[str, ...] = (), **ranges: Any
) -> dict[str, Any]:
  """Returns a design; `ranges` are those of some registers."""
  roles = {
      'a': 'feedback', 'b': 'feedback', 'c': 'signal', 'm': 'meter',
      'n': 'meter', 'q': 'query', 'p': 'query',
  }  # fmt: skip
  return {
      'schema': 1,
      'name': 'd',
      'action_set': designs.ACTION_SET,
      'registers': {
          name: _register(role, *ranges.get(name, [0, 13]))
          for name, role in roles.items()
      },
      'meters': [{'measures': 'score', 'writes': name} for name in meters],
      'providers': given,
  }


def _constant(*writes: str, reads: tuple[str, ...] = ()) -> dict[str, Any]:
  return {'kind': 'constant', 'reads': list(reads), 'writes': list(writes)}


def _demonstration(write: str = 'a', **changes: Any) -> dict[str, Any]:
  return {
      'kind': 'demonstration', 'policy': 'no_op', 'writes': [write], **changes,
  }  # fmt: skip


def _advice(query: str = 'q', **changes: Any) -> dict[str, Any]:
  return {
      'kind': 'value_advice', 'value_function': 'apple_seeker_approval',
      'reads': [query], 'writes': ['a'], **changes,
  }  # fmt: skip


def _paired(*queries: str) -> dict[str, Any]:
  return _advice(kind='paired_advice', reads=list(queries))


@final
class _Relay(stubs.Zero):
  """Writes the index of an action that it reads."""

  kind: Literal['test_relay'] = 'test_relay'

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.reads[:1]

  @property
  def action_writes(self) -> tuple[str, ...]:
    return self.writes[-1:]


@final
class _Broken(stubs.Zero):
  """Fails in its check."""

  kind: Literal['test_broken'] = 'test_broken'

  def check(self, design: Any) -> None:
    raise {'a': KeyError('x'), 'b': ZeroDivisionError('y')}[self.writes[0]]


@pytest.fixture(autouse=True)
def _kinds() -> Any:
  with (
      helpers.registered(providers.PROVIDERS, 'test_relay', _Relay),
      helpers.registered(providers.PROVIDERS, 'test_broken', _Broken),
  ):
    yield


def _relay(**changes: Any) -> dict[str, Any]:
  return {
      'kind': 'test_relay', 'reads': ['q', 'm'], 'writes': ['b', 'a'],
      **changes,
  }  # fmt: skip


def _excludes(name: str, given: list[float], user: str) -> str:
  return (
      f'registers.{name}.range: {[float(bound) for bound in given]} excludes'
      f' actions of dmlab_like v1, whose indices {user} uses; allowed are'
      ' ranges that contain [0, 13]'
  )


_WRONG = {
    'two providers of one register': (_design([_constant('a'), _constant('a')]),
        "providers[1].writes: register 'a' is written by providers[0] already;"
        ' allowed is one writer'),
    'two providers of different kinds': (
        _design([_advice(), _demonstration('b'), _constant('c', 'b')]),
        "providers[2].writes: register 'b' is written by providers[1] already"),
    'a register written twice': (_design([_constant('a', 'a')]),
        "providers[0].writes: register 'a' is listed twice; allowed is once"),
    'a register read twice': (_design([_constant('a', reads=('m', 'q', 'm'))]),
        "providers[0].reads: register 'm' is listed twice; allowed is once"),
    'two meters of one register': (_design([], meters=('m', 'm')),
        "meters[1].writes: register 'm' is written by meters[0] already;"
        ' allowed is one writer'),
    **{
        f'imitation in {given}': (
            _design([_constant('b'), _demonstration()], a=given),
            _excludes('a', given, 'providers[1]'))
        for given in ([0, 12.9], [0.001, 20])
    },
    **{
        f'a query in {given}': (_design([_advice()], q=given),
            _excludes('q', given, 'providers[0]'))
        for given in ([1, 13], [-20, 0])
    },
    'an earlier query': (_design([_advice(query_delay=1)], q=[0, 1]),
        _excludes('q', [0, 1], 'providers[0]')),
    'the first of two queries': (_design([_paired('q', 'p')], q=[0, 1]),
        _excludes('q', [0, 1], 'providers[0]')),
    'the second of two queries': (_design([_paired('q', 'p')], p=[0, 1]),
        _excludes('p', [0, 1], 'providers[0]')),
    'a query of a registered provider': (_design([_relay()], q=[0, 1]),
        _excludes('q', [0, 1], 'providers[0]')),
    'an index that a registered provider writes': (
        _design([_relay()], a=[0, 1]),
        _excludes('a', [0, 1], 'providers[0]')),
    'a provider that fails in its check': (
        _design([_constant('c'), {'kind': 'test_broken', 'writes': ['a']}]),
        "providers[1]: KeyError: 'x'"),
    'a provider that fails in another way': (
        _design([{'kind': 'test_broken', 'writes': ['b']}]),
        'providers[0]: ZeroDivisionError: y'),
}  # fmt: skip


@pytest.mark.parametrize(('design', 'problem'), _WRONG.values(), ids=_WRONG)
def test_parts_that_do_not_fit_are_refused(design: Any, problem: str):
  text = refusals.refusal(specs.load, design)
  assert text.startswith(f'design: {problem}')


_RIGHT = {
    'a register each': _design([_constant('a'), _constant('b', 'c')]),
    'one measurement in two registers': _design([], meters=('m', 'n')),
    'imitation in a wider range': _design([_demonstration()], a=[-1, 20]),
    'a query in a wider range': _design([_advice()], q=[-0.5, 13.5]),
    'one query for two providers': _design([_advice(), _advice(writes=['b'])]),
    'no action set': {**_design([_relay()], q=[0, 1]), 'action_set': None},
    'a small register that holds no index': _design(
        [_relay(), _advice(writes=['c'])], b=[0, 1], m=[0, 1]
    ),
    # Registers may be scenery, and a control experiment has no feedback.
    'registers without a writer': _design([]),
    'a provider that reads what it wrote last': _design(
        [_constant('a', reads=('a',))]
    ),
}  # fmt: skip


@pytest.mark.parametrize('design', _RIGHT.values(), ids=_RIGHT)
def test_parts_that_fit_are_accepted(design: Any):
  assert specs.load(design).to_mapping()['providers'] is not None


def test_registers_of_shipped_designs_hold_every_action():
  for name in suite.DESIGNS:
    design = specs.load(name)
    for provider in design.providers:
      for register in (*provider.action_queries, *provider.action_writes):
        low, high = design.registers[register].range
        assert low <= 0
        assert high >= 13
  override = 'registers.demonstration.range=[0, 12]'
  text = refusals.refusal(specs.load, 'online_imitation', (override,))
  problem = _excludes('demonstration', [0, 12], 'providers[0]')
  assert text == f"override '{override}': {problem}"


def test_a_class_registered_anew_replaces_the_old_one():
  design = _design([{'kind': 'test_again', 'writes': ['a']}])

  def kind(default: int) -> Any:
    class Again(stubs.Zero):
      kind: Literal['test_again'] = 'test_again'
      value: int = default

    return Again

  for default in (1, 2):
    with helpers.registered(providers.PROVIDERS, 'test_again', kind(default)):
      assert specs.load(design).providers[0].value == default
