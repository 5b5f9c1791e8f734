"""Contracts for tests of one's own: `testing.check_world(MyWorld)`."""

from realab_suite.testing.contracts import ContractError
from realab_suite.testing.providers import check_provider
from realab_suite.testing.register_contract import check_register
from realab_suite.testing.worlds import check_world
