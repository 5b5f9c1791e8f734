"""Registry of the kinds of registers that designs can name."""

from realab_suite.config import registry
from realab_suite.entities import registers

REGISTER_KINDS: registry.Registry[type[registers.Register]] = registry.Registry(
    'register kind'
)
REGISTER_KINDS.add('two_block')(registers.TwoBlockRegister)
REGISTER_KINDS.add('block_position')(registers.BlockPositionRegister)
REGISTER_KINDS.add('block_orientation')(registers.BlockOrientationRegister)
REGISTER_KINDS.add('abacus_2')(registers.Abacus2)
REGISTER_KINDS.add('abacus_4')(registers.Abacus4)
REGISTER_KINDS.add('stored')(registers.StoredRegister)
