"""Tests that the parts of a design fit each other."""

import json
import pathlib
from typing import Any, Literal, final

import pytest

from realab_suite import suite
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
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


_WRITER = {'kind': 'difference', 'reads': ['score'], 'writes': ['extra']}


def _with_extra(**changes: Any) -> dict[str, Any]:
  """Returns a design with a register `extra`, which has no writer."""
  extra = {
      'kind': 'two_block', 'role': 'feedback', 'place': 'station_3',
      'range': [-2, 12], **changes,
  }  # fmt: skip
  found = {**designs.SCORED['registers'], 'extra': extra}
  return {**designs.SCORED, 'registers': found}


def _unwritten(role: str = 'feedback') -> str:
  return (
      f'registers.extra: no provider writes this {role} register; allowed are'
      ' an entry of providers that does, such as {kind: difference, reads:'
      ' [score], writes: [extra]}, and a stated initial, which the register'
      ' keeps'
  )


@pytest.mark.parametrize('role', ['feedback', 'signal'])
def test_a_register_for_agents_needs_a_writer_or_an_initial_value(role: str):
  design = _with_extra(role=role)
  text = refusals.refusal(specs.load, design)
  assert text == f'design: {_unwritten(role)}'
  specs.load({**design, 'providers': [*design['providers'], _WRITER]})
  stated = specs.load(_with_extra(role=role, initial=0))
  assert stated.registers['extra'].initial == 0
  assert specs.load(design, ['registers.extra.initial=0']) == stated


@pytest.mark.parametrize('role', ['meter', 'memory', 'query'])
def test_other_registers_need_no_writer(role: str):
  assert specs.load(_with_extra(role=role)).registers['extra'].role == role


def test_stating_the_default_initial_value_keeps_the_digest():
  plain = _with_extra(role='memory')
  stated = _with_extra(role='memory', initial=0)
  assert specs.load(plain).digest() == specs.load(stated).digest()


def test_a_stored_design_can_be_loaded_and_states_every_field():
  for name in suite.DESIGNS:
    design = specs.load(name)
    assert specs.load(design.to_mapping()).digest() == design.digest()


def test_overrides_of_a_spec_do_not_state_its_initial_values(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
  monkeypatch.chdir(tmp_path)
  design = _with_extra()
  design['providers'] = [*design['providers'], _WRITER]
  override = f'providers={designs.SCORED["providers"]}'
  loaded = specs.load(design)
  (tmp_path / 'design.yaml').write_text(json.dumps(design))
  run = experiment_specs.RunSpec(design='design.yaml', learner={'gamma': 0.9})
  sources = (
      design,
      loaded,
      specs.load(loaded, ['name=other']),
      run.load(),
  )
  for source in sources:
    text = refusals.refusal(specs.load, source, (override,))
    assert text == f'override {override!r}: {_unwritten()}'


def test_a_design_in_a_world_does_not_state_its_initial_values():
  found = specs.load('myopic_approval').in_world('apple_seeker')
  text = refusals.refusal(specs.load, found, ('learner=null', 'providers=[]'))
  assert 'no provider writes this feedback register' in text


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


def test_a_meter_register_that_a_provider_reads_is_measured():
  text = refusals.refusal(specs.load, 'instantaneous_reward', ['meters=[]'])
  assert "providers[0].reads: no meter writes the register 'score'" in text
  kept = ['meters=[]', 'registers.score.initial=3']
  assert not specs.load('instantaneous_reward', kept).meters
