"""Measurements; modules of this package register their own."""

from realab_suite.feedback.measurements.base import MEASUREMENTS
from realab_suite.feedback.measurements.base import AskedRegisters
from realab_suite.feedback.measurements.base import Measure
from realab_suite.feedback.measurements.base import Measurement
from realab_suite.feedback.measurements.base import PartName
from realab_suite.feedback.measurements.base import Range
from realab_suite.feedback.measurements.base import World
from realab_suite.feedback.measurements.base import connect
