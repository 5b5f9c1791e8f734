"""Tests for the names and types of options."""

from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Annotated, Any, final

import numpy as np
import pydantic
import pytest

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback import specs
from tests.config import refusals
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import stubs

_REGISTER = {**designs.REWARD, 'range': [0, 13]}


class _Labelled(stubs.Idle):
  """The base class of a policy that passes its options on."""

  def __init__(self, label: str = '', file: option_types.FilePath = '') -> None:
    del label, file


@final
class _Inheriting(_Labelled):

  def __init__(self, mine: int = 0, **kwargs: Any) -> None:
    del mine
    super().__init__(**kwargs)


@final
class _Wrapping(stubs.Idle):
  """Runs another policy."""

  def __init__(
      self,
      inner: Annotated[str, option_types.NameIn(policies.POLICIES)] = 'no_op',
      inner_options: Annotated[
          dict[str, Any] | None,
          option_types.OptionsOf(policies.POLICIES, 'inner'),
      ] = None,
  ) -> None:
    self._inner = policies.make(inner, **(inner_options or {}))


def _made(label: str = '') -> policies.Policy:
  """Makes a policy: a function instead of a class."""
  return _Labelled(label)


@pytest.fixture(autouse=True)
def _policies() -> Iterator[None]:
  with (
      helpers.registered(policies.POLICIES, 'test_inheriting', _Inheriting),
      helpers.registered(policies.POLICIES, 'test_wrapping', _Wrapping),
      helpers.registered(policies.POLICIES, 'test_function', _made),
  ):
    yield


def _design(
    policy: str, options: dict[str, Any] | None = None, **changes: Any
) -> dict[str, Any]:
  """Returns a design with a demonstration by a policy."""
  demonstration = {
      'kind': 'demonstration', 'writes': ['reward'], 'policy': policy,
      'options': options or {},
  }  # fmt: skip
  return {
      'schema': 1, 'name': 'd', 'action_set': designs.ACTION_SET,
      'registers': {'reward': _REGISTER}, 'providers': [demonstration],
      **changes,
  }  # fmt: skip


def _wrapped(depth: int, policy: str, options: Any) -> dict[str, Any]:
  """Returns a design with a policy inside of `depth` others."""
  for _ in range(depth):
    options = {'inner': policy, 'inner_options': options}
    policy = 'test_wrapping'
  return _design(policy, options)


def _approved(policy: str, **options: Any) -> dict[str, Any]:
  """Returns a design with approval by a policy."""
  design = designs.changed(base=designs.ADVISED)
  design['providers'][0]['options'] = {'policy': policy, 'options': options}
  return design


@final
class _Typed(stubs.Idle):
  """Declares options of many types."""

  def __init__(
      self,
      needed: int,
      number: Annotated[float, pydantic.Field(gt=0)] = 1.0,
      flag: bool = False,
      pair: tuple[float, float] = (0.0, 0.0),
      sequence: Sequence[float] = (),
      mapping: Mapping[str, int] | None = None,
      ndarray: np.ndarray | None = None,
      untyped=None,
      odd: 'list[str]' = (),  # type: ignore[assignment]
      copy: bool = True,
      model_config: int = 0,
  ) -> None:
    self.given = needed, number, flag, pair, sequence, mapping
    self.more = ndarray, untyped, odd, copy, model_config


@final
class _Unreadable(stubs.Idle):
  """Has an annotation with an undefined name."""

  def __init__(self, thing: 'Nothing' = None) -> None:  # type: ignore # noqa
    del thing


@pytest.fixture
def _typed() -> Iterator[None]:
  with (
      helpers.registered(policies.POLICIES, 'test_typed', _Typed),
      helpers.registered(policies.POLICIES, 'test_unreadable', _Unreadable),
  ):
    yield


@pytest.mark.parametrize(('policy', 'options', 'message'), [
    ('no_op', {'speed': 1}, ": unknown key 'speed' (allowed: action_set)"),
    ('pushing_saboteur', {'traget': [1, 2]},
        ": unknown key 'traget'; did you mean 'target'? (allowed: target,"),
    ('pushing_saboteur', {'target': [1, 1e5]},
        '.target[1]: must be less than or equal to 10000, got 100000.0'),
    ('pushing_saboteur', {'target': [1]},
        '.target: must have at least 2 items, got [1]'),
    ('test_typed', {'flag': False}, '.needed: required key is missing'),
    ('test_typed', {'needed': 1, 'mapping': {'a': 'x'}},
        ".mapping.a: must be a valid integer, got 'x'"),
    ('test_unreadable', {'thing': 1},
        ": the options of 'test_unreadable' cannot be read from its"
        " signature: name 'Nothing' is not defined"),
    ('test_wrapping', {'inner': 'no_opp'},
        ".inner: policy 'no_opp' is unknown; did you mean 'no_op'?"),
    ('test_inheriting', {'no': 1}, ": unknown key 'no' (allowed: mine, la"),
    ('test_function', {'lable': 'x'}, "; did you mean 'label'? (allowed: ")
])  # fmt: skip
@pytest.mark.usefixtures('_typed')
def test_wrong_options_are_refused_when_a_design_is_loaded(
    policy: str, options: dict[str, Any], message: str
):
  text = refusals.refusal(specs.load, _design(policy, options))
  assert text.startswith('design: providers[0].options')
  assert message in text
  # No further problem is reported.
  assert ';' not in text.replace('; did you mean', '').replace('; known', '')


@pytest.mark.parametrize(
    ('policy', 'options'),
    [
        ('pushing_saboteur', {'target': [1, -2.5], 'direction': [0, 1]}),
        ('test_typed', {'needed': 3, 'pair': [1, 2], 'sequence': [1, 2.5]}),
        ('test_typed', {'needed': 3, 'mapping': {'a': 1}, 'untyped': {'b': 0}}),
        # Arrays are converted by the class, not by the validation.
        ('test_typed', {'needed': 3, 'ndarray': [1, 2]}),
        # Names that a pydantic model uses itself.
        ('test_typed', {'needed': 3, 'copy': False, 'model_config': 1}),
        ('test_unreadable', {}),
        ('test_wrapping', {'inner_options': None}),
    ],
)
@pytest.mark.usefixtures('_typed')
def test_right_options_are_accepted_unchanged(
    policy: str, options: dict[str, Any]
):
  for depth in (0, 2):
    design = _wrapped(depth, policy, options)
    loaded = specs.load(design).to_mapping()
    assert json.dumps(loaded['providers'][0]['options']) == (
        json.dumps(design['providers'][0]['options'])
    )


def test_a_constructor_that_fails_is_a_spec_error():
  for error in (ValueError('bad'), OSError(2, 'no'), MemoryError()):

    def make(error: Exception = error) -> policies.Policy:
      raise error

    with helpers.registered(policies.POLICIES, 'test_failing', make):
      for load in (
          lambda: policies.make('test_failing'),
          lambda: specs.load(_design('test_failing')),
          lambda: specs.load(_approved('test_failing')),
      ):
        text = refusals.refusal(load)
        assert type(error).__name__ in text
        assert "policy 'test_failing'" in text
