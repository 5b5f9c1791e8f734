"""Policies and value functions; the import registers the shipped ones."""

from realab_suite.policies.apple_seeker import AppleSeeker
from realab_suite.policies.approval import PolicyApproval
from realab_suite.policies.base import POLICIES
from realab_suite.policies.base import VALUE_FUNCTIONS
from realab_suite.policies.base import Follower
from realab_suite.policies.base import Policy
from realab_suite.policies.base import ValueFunction
from realab_suite.policies.base import check_action_set
from realab_suite.policies.base import check_senses
from realab_suite.policies.base import make
from realab_suite.policies.base import make_value_function
from realab_suite.policies.network_policies import NetworkDemonstrator
from realab_suite.policies.network_policies import NetworkValues
from realab_suite.policies.saboteurs import CarryingSaboteur
from realab_suite.policies.saboteurs import PushingSaboteur
from realab_suite.policies.saboteurs import ThrowingSaboteur
from realab_suite.policies.simple import Distracted
from realab_suite.policies.simple import NoOp
from realab_suite.policies.simple import Random
