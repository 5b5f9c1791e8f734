"""What goes wrong with the options of registers and policies names its key."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds
from tests.engine import helpers

_FAILURES = {
    'spec': errors.SpecError('held: 7; allowed is 1'),
    'unknown': errors.UnknownNameError('held: seven; known is one'),
    'value': ValueError('seven\nis too many'),
    'key': KeyError('seven'),
    'zero': ZeroDivisionError(),
}


class _Fragile(registers.Register):
  """Fails as it is told to."""

  def _build(
      self, name: str, *, fail: str = '', held: Any = 0.0, **kwargs: Any
  ) -> None:
    if fail in _FAILURES:
      raise _FAILURES[fail]
    self.held = held + 1.0
    super()._build(name, **kwargs)

  def _build_blocks(self) -> list[Any]:
    return [self._add_block('block', 'offset_block', (0.0, 0.0))]

  def _put(self, physics: Any, value: np.ndarray) -> None:
    del physics, value

  def _read_blocks(self, physics: Any) -> np.ndarray:
    return self.applied(physics)


@pytest.fixture(autouse=True)
def _fragile() -> Iterator[None]:
  kinds = register_kinds.REGISTER_KINDS
  with helpers.registered(kinds, 'test_fragile', _Fragile):
    yield


def _design(kind: str = 'test_fragile', **options: Any) -> dict[str, Any]:
  register = {
      'kind': kind, 'role': 'feedback', 'place': [0, 2], 'range': [0, 1]
  }  # fmt: skip
  return {
      'schema': 1,
      'name': 'd',
      'registers': {'other': {**register, 'options': {}, 'kind': 'two_block',
                              'place': [2, 2]},
                    'reward': {**register, 'options': options}},
  }  # fmt: skip


def _refusal(design: dict[str, Any]) -> str:
  with pytest.raises(errors.SpecError) as caught:
    suite.load('collect_apples', 'standard', design=design)
  text = str(caught.value)
  assert '\n' not in text
  return text


def test_a_kind_gets_its_options():
  env = suite.load('collect_apples', 'standard', design=_design(held=2))
  assert env.mechanism.registers['reward'].held == 3.0
  env.close()


@pytest.mark.parametrize('kind', ['test_fragile', 'two_block'])
@pytest.mark.parametrize(
    'option',
    ['name', 'self', 'value_range', 'scale', 'role', 'args', 'kwargs', 'held_'],
)
def test_what_is_no_option_of_a_kind_is_refused(kind: str, option: str):
  text = _refusal(_design(kind, **{option: 1}))
  assert 'registers.reward.options' in text
  assert f"'{option}'" in text
  assert ('held' in text.split('allowed')[1]) == (kind == 'test_fragile')


@pytest.mark.parametrize('held', ['x', [1], {'a': 1}, None])
def test_a_value_that_a_kind_cannot_use_names_the_register(held: Any):
  text = _refusal(_design(held=held))
  assert 'registers.reward' in text
  assert 'registers.other' not in text


@pytest.mark.parametrize('fail', _FAILURES)
def test_whatever_a_kind_raises_names_the_register(fail: str):
  failure = _FAILURES[fail]
  text = _refusal(_design(fail=fail))
  assert 'registers.reward' in text
  if isinstance(failure, errors.SpecError):
    assert text.endswith(str(failure))
  else:
    assert type(failure).__name__ in text
    assert 'seven' in text or not str(failure)


def test_what_a_kind_raises_is_the_cause():
  with pytest.raises(errors.SpecError) as caught:
    suite.load('collect_apples', 'standard', design=_design(fail='value'))
  assert caught.value.__cause__ is _FAILURES['value']


def test_an_option_of_a_policy_may_be_called_as_anything():
  class Named(policies.Policy):
    """Has options with names that other functions use, too."""

    def __init__(self, name: str = '', what: str = '', names: str = '') -> None:
      self.given = name, what, names

    def step(
        self, observation: Any, episode_start: Any, key: Any, state: Any
    ) -> tuple[Any, Any]:
      raise NotImplementedError

  with helpers.registered(policies.POLICIES, 'test_named', Named):
    made = policies.make('test_named', name='a', what='b', names='c')
  assert made.given == ('a', 'b', 'c')
  with pytest.raises(errors.SpecError, match="policy 'no_op' with options"):
    policies.make('no_op', name=1)
