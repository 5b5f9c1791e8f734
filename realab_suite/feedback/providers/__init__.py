"""Feedback providers; importing this package registers all of its providers."""

from realab_suite.feedback.providers.appraisal import Appraisal
from realab_suite.feedback.providers.base import OWN
from realab_suite.feedback.providers.base import PROVIDERS
from realab_suite.feedback.providers.base import Observation
from realab_suite.feedback.providers.base import Provider
from realab_suite.feedback.providers.comparison import Comparison
from realab_suite.feedback.providers.constant import Constant
from realab_suite.feedback.providers.demonstration import Demonstration
from realab_suite.feedback.providers.difference import Difference
from realab_suite.feedback.providers.growth import Growth
from realab_suite.feedback.providers.inspection import Inspection
from realab_suite.feedback.providers.paired_advice import PairedAdvice
from realab_suite.feedback.providers.relay import Relay
from realab_suite.feedback.providers.value_advice import ValueAdvice
