"""Designs with one meter, and what the meter measures."""

import copy
from typing import Any

from tests.feedback import designs

TASK = 'unlock_door', 'standard'


def design(measures: Any, **register: Any) -> dict[str, Any]:
  """Returns a design whose meter `score` measures something."""
  made: dict[str, Any] = copy.deepcopy(designs.SCORED)
  made['registers']['reward'].update(register)
  made['registers']['score']['range'] = [-200, 200]
  # Far values do not fit into the room, and saturate; requests do not.
  made['registers']['score']['scale'] = 1e-3
  made['meters'][0]['measures'] = measures
  return made


def measure(env: Any) -> Any:
  """Returns the present measurement of the meter, `(...)`."""
  (write,) = env.mechanism.phases.update_meters(env.physics)
  return write.requested
