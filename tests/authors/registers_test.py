"""Tests of the contract of registers, which ships for tests of authors."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import testing
from realab_suite.entities import registers

_KINDS: dict[str, tuple[type[registers.Register], dict[str, Any]]] = {
    'two_block': (registers.TwoBlockRegister, {}),
    'small and light': (
        registers.TwoBlockRegister, {'block_size': 0.06, 'mass': 0.02}
    ),
    'in centimetres': (
        registers.BlockPositionRegister,
        {'value_range': (0, 900), 'scale': 0.001, 'initial': 20},
    ),
    'block_orientation': (
        registers.BlockOrientationRegister,
        {'value_range': (-1.5, 1.0), 'initial': 0.5},
    ),
    'abacus_2': (registers.Abacus2, {}),
    'abacus_4': (registers.Abacus4, {'value_range': (-1, 1), 'scale': 0.3}),
}  # fmt: skip


@pytest.mark.parametrize('name', _KINDS)
def test_kinds_keep_the_contract(name: str):
  kind, options = _KINDS[name]
  testing.check_register(kind, **options)


class _Counting(registers.Register):
  """A register of one block along its axis, written as simply as possible."""

  _TO = None

  def _build_blocks(self):
    self.count = 0
    return [self._add_block('block', 'offset_block', (0.0, 0.0), self._TO)]

  def _places(self, physics, value):
    place = np.array(self._origin(physics))
    place[..., 0] += value * self._scale
    return [place]

  def _read_blocks(self, physics):
    start = self._origin(physics)[..., 0]
    return (self._blocks[0].along(physics) - start) / self._scale


def _remembers(self, physics):
  self.count += 1
  return _Counting._read_blocks(self, physics) + 1e-6 * (self.count > 5)


def _ignores_where(self, physics, value, where=None):
  self._blocks[0].put(physics, *self._places(physics, value))


def _nudges(self, physics):
  self._blocks[0].put(physics, self._blocks[0].position(physics))
  return _Counting._read_blocks(self, physics)


def _only_half(self, physics, value, where=None):
  registers.Register._put(self, physics, value / 2, where)


def _stays_aside(self, physics, value, where=None):
  place = np.array(self._blocks[0].position(physics))
  place[..., 0] = self._places(physics, value)[0][..., 0]
  self._blocks[0].put(physics, place, where=where)


def _reads_aside(self, physics):
  aside = self._blocks[0].position(physics) - self._origin(physics)
  return _Counting._read_blocks(self, physics) + aside[..., 1]


def _along_only(self, physics):
  wrong = self._read_blocks(physics) - self.applied(physics)
  return np.abs(wrong)[..., np.newaxis] * self._scale


def _constant(self, physics):
  return self.applied(physics)


def _halved(self, value):
  return value / 2


def _one_more(self, physics, is_gone):
  return self.read(physics) + 1.0


_BREACHES: dict[str, tuple[dict[str, Any], str]] = {
    'remembers': ({'_read_blocks': _remembers}, 'read as'),
    'ignores masks': ({'_put': _ignores_where}, 'to other worlds of a batch'),
    'moves blocks when it is read': (
        {'_read_blocks': _nudges}, 'a look at the register changes the world'
    ),
    'puts blocks elsewhere': ({'_put': _only_half}, 'is read as'),
    'hides permanent corruption': (
        {'_put': _stays_aside, '_read_blocks': _reads_aside},
        'leaves a temporary corruption',
    ),
    'sees motion along its axis only': (
        {'displacements': _along_only}, 'displacements reports 0.0 m'
    ),
    'has a direction that lowers it': (
        {'_TO': (-1.0, 0.0)}, 'the direction of a block raises a reading'
    ),
    'rounds what is rounded': (
        {'nearest': _halved}, 'write(-1.0) returned -0.5'
    ),
    'is hidden by nothing': (
        {'read_without': _one_more}, 'without what is in the way'
    ),
    'cannot be corrupted': (
        {'_read_blocks': _constant}, 'no motion of a single block'
    ),
}  # fmt: skip


def test_a_simple_kind_keeps_the_contract():
  testing.check_register(_Counting)


@pytest.mark.parametrize('breach', _BREACHES)
def test_a_breach_of_the_contract_is_named(breach: str):
  members, message = _BREACHES[breach]
  broken: Any = type('Broken', (_Counting,), members)
  with pytest.raises(testing.ContractError) as raised:
    testing.check_register(broken)
  assert message in str(raised.value)
  assert str(raised.value).startswith('Broken, embedded')


class _Crowded(_Counting):
  """Has a second block beside the first one, and too close to it."""

  def _build_blocks(self):
    beside = self._add_block('beside', 'base_block', (0.0, 0.15))
    return [*_Counting._build_blocks(self), beside]

  def _places(self, physics, value):
    [place] = _Counting._places(self, physics, value)
    return [place, self._origin(physics) + np.array([0.0, 0.15, 0.0])]


def test_blocks_that_push_each_other_are_noticed():
  with pytest.raises(testing.ContractError, match='nobody has touched'):
    testing.check_register(_Crowded)


class _Turning(_Counting):
  """Turns its block, and takes every range."""

  _least = -np.pi

  def _places(self, physics, value):
    return [np.array(self._origin(physics))]

  def _put(self, physics, value, where=None):
    [place] = self._places(physics, value)
    self._blocks[0].put(physics, place, value * self._scale, where)

  def _read_blocks(self, physics):
    turned = self._blocks[0].heading(physics) - self._least
    return ((turned + 1e-12) % (2 * np.pi) + self._least - 1e-12) / self._scale

  def displacements(self, physics):
    wrong = self._read_blocks(physics) - self.applied(physics)
    sides = np.abs(wrong) * self._scale * self._blocks[0].half_size
    moved = super().displacements(physics)
    return np.maximum(moved, sides[..., np.newaxis])


@pytest.mark.parametrize('least', [-np.pi, -0.3])
def test_a_kind_that_wraps_outside_the_tried_range_is_noticed(least):
  wrapping: Any = type('Wrapping', (_Turning,), {'_least': least})
  with pytest.raises(testing.ContractError, match='is read as') as raised:
    testing.check_register(wrapping)
  assert 'angles of more than a turn' in str(raised.value)


def test_a_kind_that_refuses_one_end_alone_is_noticed():
  def build(self, *arguments, **options):
    _Turning._build(self, *arguments, **options)
    if self.value_range[1] * self._scale > 3.0:
      raise errors.SpecError('half a turn at most')

  guarded: Any = type('Guarded', (_Turning,), {'_build': build})
  with pytest.raises(testing.ContractError, match='is read as'):
    testing.check_register(guarded)
