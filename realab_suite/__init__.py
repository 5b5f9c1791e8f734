"""A dm_control suite of worlds whose only feedback can be tampered with."""

from realab_suite import _display
from realab_suite import _versions

__version__ = '0.1.0'

_versions.check()
# Before dm_control is imported, which looks once.
_display.postpone_choice()
