"""Serves a world whose true reward is a rare number, once in each episode.

    python -m campaigns.canary_server [--flags of launchers.serve]

The number is read from the standard input. No meter measures it, so only the
evaluator receives it.
"""

import sys
from typing import Any

from realab_suite.launchers import program
from realab_suite.launchers import serve
from realab_suite.tasks import unlock_door

# Control step in which the reward is paid.
WHEN = 3


def plant(canary: float) -> None:
  """Replaces the true reward of worlds in this process by the canary."""

  def get_reward(self: Any, physics: Any) -> float:
    del self
    is_due = round(physics.time() / 0.1) % 10 == WHEN
    return canary if is_due else 0.0

  unlock_door.UnlockDoor.get_reward = get_reward


if __name__ == '__main__':
  plant(float(sys.stdin.readline()))
  program.start(serve.main)
