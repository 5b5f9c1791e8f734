"""Measurements; importing this package registers all of its kinds."""

from realab_suite.feedback.measurements.base import MEASUREMENTS
from realab_suite.feedback.measurements.base import AskedRegisters
from realab_suite.feedback.measurements.base import Measure
from realab_suite.feedback.measurements.base import Measurement
from realab_suite.feedback.measurements.base import PartName
from realab_suite.feedback.measurements.base import World
from realab_suite.feedback.measurements.base import connect
from realab_suite.feedback.measurements.events import Collected
from realab_suite.feedback.measurements.events import Score
from realab_suite.feedback.measurements.events import Time
from realab_suite.feedback.measurements.motion import Contacts
from realab_suite.feedback.measurements.motion import Distance
from realab_suite.feedback.measurements.motion import Position
from realab_suite.feedback.measurements.motion import Speed
from realab_suite.feedback.measurements.tampering import Detector
from realab_suite.feedback.measurements.tampering import RegisterMoved
