"""Feedback providers; modules of this package register their own."""

from realab_suite.feedback.providers.base import OWN
from realab_suite.feedback.providers.base import PROVIDERS
from realab_suite.feedback.providers.base import Names
from realab_suite.feedback.providers.base import Observation
from realab_suite.feedback.providers.base import Provider
