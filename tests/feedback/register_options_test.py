"""Tests for options of register kinds: errors name the register."""

from collections.abc import Iterator
from typing import Any

import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.feedback import register_kinds
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import stubs

_FAILURES = {
    'spec': errors.SpecError('held: 7; allowed is 1'),
    'unknown': errors.UnknownNameError('held: seven; known is one'),
    'value': ValueError('seven\nis too many'),
    'zero': ZeroDivisionError(),
}


class _Fragile(stubs.Still):
  """Raises the error that its option `fail` names."""

  def _build(
      self, name: str, *, fail: str = '', held: Any = 0.0, **kwargs: Any
  ) -> None:
    if fail in _FAILURES:
      raise _FAILURES[fail]
    self.held = held + 1.0
    super()._build(name, **kwargs)


@pytest.fixture(autouse=True)
def _fragile() -> Iterator[None]:
  kinds = register_kinds.REGISTER_KINDS
  with helpers.registered(kinds, 'test_fragile', _Fragile):
    yield


def _load(kind: str = 'test_fragile', **options: Any) -> Any:
  design = designs.changed(f'registers.reward.kind={kind}')
  design['registers']['reward']['options'] = options
  return suite.load('collect_apples', 'standard', design=design)


def test_a_kind_gets_its_options():
  env = _load(held=2)
  assert env.mechanism.registers['reward'].held == 3.0
  env.close()


@pytest.mark.parametrize('kind', ['test_fragile', 'two_block'])
@pytest.mark.parametrize('option', ['name', 'self', 'scale', 'kwargs', 'held_'])
def test_an_unknown_option_is_refused(kind: str, option: str):
  text = refusals.refusal(_load, kind, **{option: 1})
  assert 'registers.reward.options' in text
  assert f"'{option}'" in text
  assert ('held' in text.split('allowed')[1]) == (kind == 'test_fragile')


@pytest.mark.parametrize('held', ['x', [1], {'a': 1}, None])
def test_a_value_that_a_kind_cannot_use_names_the_register(held: Any):
  text = refusals.refusal(_load, held=held)
  assert 'registers.reward' in text
  assert 'registers.score' not in text


@pytest.mark.parametrize('fail', _FAILURES)
def test_any_error_of_a_kind_names_the_register(fail: str):
  failure = _FAILURES[fail]
  with pytest.raises(errors.SpecError) as caught:
    _load(fail=fail)
  text = str(caught.value)
  assert '\n' not in text
  assert 'registers.reward' in text
  if isinstance(failure, errors.SpecError):
    assert text.endswith(str(failure))
  else:
    assert type(failure).__name__ in text
    assert 'seven' in text or not str(failure)
    assert caught.value.__cause__ is failure


def test_an_option_of_a_policy_may_have_any_name():
  class Named(stubs.Idle):
    """Has options with the names of arguments of `policies.make`."""

    def __init__(self, name: str = '', what: str = '', names: str = '') -> None:
      self.given = name, what, names

  with helpers.registered(policies.POLICIES, 'test_named', Named):
    made = policies.make('test_named', name='a', what='b', names='c')
  assert made.given == ('a', 'b', 'c')
  with pytest.raises(errors.SpecError, match="policy 'no_op' with options"):
    policies.make('no_op', name=1)
