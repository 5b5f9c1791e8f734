"""Tests that nothing is learned from a register that nobody writes."""

import pytest

from realab_suite import errors
from realab_suite.feedback import specs
from tests.feedback import designs

_EXTRA = {'kind': 'two_block', 'place': 'station_3', 'range': [0, 2]}


def _load(**extra):
  registers = {**designs.SCORED['registers'], 'extra': {**_EXTRA, **extra}}
  return specs.load({**designs.SCORED, 'registers': registers})


@pytest.mark.parametrize('role', ['feedback', 'signal'])
def test_a_register_that_nobody_writes_is_refused(role):
  with pytest.raises(errors.SpecError) as raised:
    _load(role=role)
  assert str(raised.value) == (
      f'design: registers.extra: no provider writes this {role} register;'
      ' allowed are an entry of providers that does, such as {kind: difference,'
      ' reads: [score], writes: [extra]}, and a stated initial, which the'
      ' register keeps'
  )


@pytest.mark.parametrize(
    'stated', [{'role': 'feedback', 'initial': 0}, {'role': 'memory'}]
)
def test_a_constant_and_a_memory_are_no_mistakes(stated):
  design = _load(**stated)
  assert design.registers['extra'].initial == 0.0
  # What a result stores can be loaded again.
  assert specs.load(design.to_mapping()).digest() == design.digest()


def test_a_stated_default_is_the_same_design():
  unstated = {k: v for k, v in designs.REWARD.items() if k != 'initial'}
  one, other = (
      specs.load(
          {
              **designs.SCORED,
              'registers': {**designs.SCORED['registers'], 'reward': reward},
          }
      )
      for reward in (unstated, {**unstated, 'initial': 0})
  )
  assert one.digest() == other.digest()


def test_an_override_that_removes_the_writer_is_refused():
  with pytest.raises(errors.SpecError, match='no provider writes'):
    specs.load('instantaneous_reward', ['providers=[]', 'learner=null'])
