"""Registers: physical objects whose poses store values."""

from realab_suite.entities.registers.abacus import Abacus
from realab_suite.entities.registers.abacus import Abacus2
from realab_suite.entities.registers.abacus import Abacus4
from realab_suite.entities.registers.arguments import CHANNELS
from realab_suite.entities.registers.arguments import DOFS
from realab_suite.entities.registers.arguments import Arguments
from realab_suite.entities.registers.base import Register
from realab_suite.entities.registers.block_orientation import (
    BlockOrientationRegister,
)
from realab_suite.entities.registers.block_position import BlockPositionRegister
from realab_suite.entities.registers.records import AGENT
from realab_suite.entities.registers.records import EVALUATOR
from realab_suite.entities.registers.records import INITIAL
from realab_suite.entities.registers.records import Read
from realab_suite.entities.registers.records import Record
from realab_suite.entities.registers.records import Write
from realab_suite.entities.registers.records import of_world
from realab_suite.entities.registers.stored import StoredRegister
from realab_suite.entities.registers.two_block import TwoBlockRegister
