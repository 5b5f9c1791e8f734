"""Worlds with a register of every kind, channel and freedom.

All registers of a world stand out of reach of the others, so that a test of
many values costs no more than the stepping.
"""

import itertools
from typing import Any, NamedTuple

from dm_control import mjcf
import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import worlds

KINDS = {
    'two_block': registers.TwoBlockRegister,
    'block_position': registers.BlockPositionRegister,
    'block_orientation': registers.BlockOrientationRegister,
}
LOW, HIGH, INITIAL = -2.0, 5.0, 1.5
SCALE = 0.1
# What a float64 loses on its way into a pose and back.
ROUNDING = 1e-12
_SPACING = 1.4


class Variety(NamedTuple):
  """Everything that a register's promises must not depend on."""

  kind: str
  channel: str
  dof: str
  yaw: float

  @property
  def name(self) -> str:
    return f'{self.kind}_{self.channel}_{self.dof}_{self.yaw:g}'.replace(
        '.', '_'
    )


def variety_of(kind: str, channel: str, dof: str) -> Variety:
  """Returns a variety whose yaw is the same over all channels."""
  turned = (list(KINDS).index(kind) + registers.DOFS.index(dof)) % 2
  return Variety(kind, channel, dof, (0.0, 0.7)[turned])


VARIETIES = [
    variety_of(*each)
    for each in itertools.product(KINDS, registers.CHANNELS, registers.DOFS)
]
# Each kind with each channel; freedoms alternate.
SOME_VARIETIES = [VARIETIES[i] for i in (0, 3, 5, 6, 8, 11)]


class World(NamedTuple):
  """A compiled world with one register of every variety."""

  physics: mjcf.Physics
  registers: dict[str, registers.Register]

  def restart(self, seed: int = 0) -> None:
    worlds.start_episode(self.physics, *self.registers.values(), seed=seed)


def make(variety: Variety, **options: Any) -> registers.Register:
  return KINDS[variety.kind](
      variety.name,
      value_range=(LOW, HIGH),
      scale=SCALE,
      initial=INITIAL,
      channel=variety.channel,
      dof=variety.dof,
      **options,
  )


def make_world(
    kind: type[mjcf.Physics] = mjcf.Physics,
    spread: tuple[float, float] = (0.0, 0.0),
    **options: Any,
) -> World:
  columns = int(np.ceil(np.sqrt(len(VARIETIES))))
  arena = arenas.OpenRoom(half_width=_SPACING * columns / 2)
  corner = -_SPACING * (columns - 1) / 2
  made = {}
  for i, variety in enumerate(VARIETIES):
    register = make(variety, **options)
    row, column = divmod(i, columns)
    place = (corner + _SPACING * column, corner + _SPACING * row)
    register.attach_to(arena, place, variety.yaw, spread)
    made[variety.name] = register
  return World(worlds.compile_world(arena, kind), made)


some_varieties = pytest.mark.parametrize(
    'variety',
    SOME_VARIETIES,
    ids=[variety.name for variety in SOME_VARIETIES],
)
every_kind = pytest.mark.parametrize('kind', KINDS)
