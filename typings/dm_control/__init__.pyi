# Types for the part of dm_control that realab_suite/entities/protocols.py is
# about; tests/entities/protocols_test.py holds them against the real thing.
from typing import Any

def __getattr__(name: str) -> Any: ...
