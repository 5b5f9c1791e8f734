# Types for the part of dm_control that this package uses.
# tests/entities/protocols_test.py holds those of mjcf against the real thing.
from typing import Any

def __getattr__(name: str) -> Any: ...
