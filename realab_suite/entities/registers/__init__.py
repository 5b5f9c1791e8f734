"""Registers: physical objects that keep a value in how they stand."""

from realab_suite.entities.registers.base import CHANNELS
from realab_suite.entities.registers.base import DOFS
from realab_suite.entities.registers.base import OVERFLOWS
from realab_suite.entities.registers.base import Inspection
from realab_suite.entities.registers.base import Register
from realab_suite.entities.registers.block_orientation import (
    BlockOrientationRegister,
)
from realab_suite.entities.registers.block_position import BlockPositionRegister
from realab_suite.entities.registers.two_block import TwoBlockRegister

__all__ = [
    'CHANNELS',
    'DOFS',
    'OVERFLOWS',
    'BlockOrientationRegister',
    'BlockPositionRegister',
    'Inspection',
    'Register',
    'TwoBlockRegister',
]
