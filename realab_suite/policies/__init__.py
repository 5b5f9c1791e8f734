"""Policies and value functions; modules of this package register their own."""

from realab_suite.policies.base import POLICIES
from realab_suite.policies.base import VALUE_FUNCTIONS
from realab_suite.policies.base import Follower
from realab_suite.policies.base import Policy
from realab_suite.policies.base import ValueFunction
from realab_suite.policies.base import check_action_set
from realab_suite.policies.base import check_senses
from realab_suite.policies.base import make
from realab_suite.policies.base import make_value_function
