"""A dm_control suite for testing reinforcement learning agents for tampering.

Agents can tamper with all of their feedback in these worlds.
"""

from realab_suite import _display
from realab_suite import _versions

__version__ = '0.1.0'

_versions.check()
# Before the import of dm_control, which chooses a renderer.
_display.prepare()
