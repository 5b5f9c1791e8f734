"""Tests for `config.validation`: models, and errors with key paths."""

from typing import Annotated, Any, Literal

import pydantic
import pytest

from realab_suite import errors
from realab_suite.config import option_types
from realab_suite.config import registry
from realab_suite.config import validation
from tests.config import refusals

_KINDS: registry.Registry[Any] = registry.Registry('provider kind')


class _Spec(validation.Model):
  model_config = pydantic.ConfigDict(allow_inf_nan=False)


@_KINDS.add('constant')
class _Constant(_Spec):
  kind: Literal['constant']
  value: float


@_KINDS.add('scaled')
class _Scaled(_Spec):
  kind: Literal['scaled']
  scale: float


class _Register(_Spec):
  shape: Literal['two_block', 'scale'] = pydantic.Field(alias='type')
  range: Annotated[list[float], pydantic.Field(max_length=2)]
  scale: Annotated[float, pydantic.Field(gt=0)] = 1.0
  blocks: int = 2
  label: str = ''
  meters: list[str] = pydantic.Field(default_factory=list)

  @pydantic.field_validator('meters')
  @classmethod
  def _refuse(cls, meters: list[str]) -> list[str]:
    if 'reward' in meters:
      raise errors.SpecError('a meter may\nnot be called reward')
    return meters


class _Design(_Spec):
  registers: dict[str, _Register] = pydantic.Field(default_factory=dict)
  providers: list[Annotated[Any, option_types.ModelIn(_KINDS)]] = (
      pydantic.Field(default_factory=list)
  )
  spare: _Register | None = None
  either: _Constant | _Scaled | None = None
  mixed: int | list[_Register] = 0
  nested: int | list[_Constant | _Scaled] = 0


def _refusal(data: dict[str, Any]) -> str:
  return refusals.refusal(validation.validate, _Design, data, 'd.yaml')


def _register(**changes: Any) -> dict[str, Any]:
  register = {'type': 'two_block', 'range': [0, 1], **changes}
  return {'registers': {'reward': register}}


@pytest.mark.parametrize(('data', 'expected'), [
    (_register(scale=float('nan')),
        'registers.reward.scale: must be a finite number, got nan'),
    (_register(meters=['reward']),
        'registers.reward.meters: a meter may not be called reward,'
        " got ['reward']"),
    (_register(tpye=1),
        "registers.reward: unknown key 'tpye'; did you mean 'type'?"
        ' (allowed: type, range, scale, blocks, label, meters)'),
    ({'registers': {'a b': 3}}, "registers['a b']: must be a mapping, got 3"),
    ({'spare': {'type': 'scale'}}, 'spare.range: required key is missing'),
    ({'providers': [{'kind': 'constant', 'valeu': 1, 'value': 1}]},
        "providers[0]: unknown key 'valeu'; did you mean 'value'?"
        ' (allowed: kind, value)'),
    ({'providers': [{'kind': 'scale'}]},
        "providers[0].kind: provider kind 'scale' is unknown; did you mean"
        " 'scaled'?; known are ['constant', 'scaled'], and others once"
        ' their module is imported, as by --import'),
    ({'mixed': [{'type': 'scale', 'range': 1}]},
        'mixed[0].range: must be a list, got 1'),
    # Pydantic's names for the two unions are left out.
    ({'nested': [{'kind': 'scaled', 'scale': 'x'}]},
        "nested[0].scale: must be a valid number, got 'x'"),
    ({'either': 3}, 'either: must be a mapping, got 3'),
    ({'registers': {1: _register()['registers']['reward']}},
        'registers[1]: must be a valid string, got 1')
])  # fmt: skip
def test_a_problem_names_its_keys_and_the_value(data, expected):
  message = _refusal(data)
  assert message.startswith('d.yaml: ')
  # A union may have further problems.
  problems = message.removeprefix('d.yaml: ') + '; '
  assert f'{expected}; ' in problems


def test_all_problems_are_named_in_one_line():
  message = _refusal(
      {
          **_register(range=[0, 'x'], scale=-1),
          'providers': [{'kind': 'constant'}],
      }
  )
  assert message == (
      "d.yaml: registers.reward.range[1]: must be a valid number, got 'x';"
      ' registers.reward.scale: must be greater than 0, got -1;'
      ' providers[0].value: required key is missing'
  )


def test_a_long_value_is_cut():
  message = _refusal(_register(scale='x' * 10_000))
  assert message.endswith('x' * 76 + '...')
  assert len(message) < 200


def test_a_value_that_python_cannot_print_is_replaced_by_its_type():
  message = _refusal(_register(range=10**5000))
  assert message.endswith('must be a list, got <int>')
