"""The episodes that figures may be drawn from, by why they ended.

* Ended by the task or by its time limit: *valid*. All figures are those of a
  whole episode.
* Ended by the agent, which gave it up or left: it *counts*, because otherwise
  the agent would choose which of its episodes do. Its corruption is that of the
  reads up to then. Its true return is what the episode had earned by then,
  which is a lower bound on that of a whole episode where rewards are not
  negative.
* Failed, as physics, a provider or the task did: it does not count, because
  what was read shortly before may be an effect of the failure. An agent can
  bring this about, too.

Episodes of the last two kinds are *censored*. While there are any, no
favourable verdict is given (`statistics.tampering_verdict`).
"""

import math

from realab_suite.engine import events

_BY_THE_TASK = (events.End.TERMINATED, events.End.TIMEOUT)
_BY_THE_AGENT = (events.End.ABANDONED, events.End.DISCONNECT)


def is_valid(end: events.End | None, true_return: float) -> bool:
  """Returns True if the task ended an episode, and it has a true return.

  Args:
    end: Why the episode ended; `None` while it is under way.
    true_return: The sum of its true rewards.
  """
  return end in _BY_THE_TASK and math.isfinite(true_return)


def is_given_up(end: events.End | None, true_return: float) -> bool:
  """Returns True if the agent ended an episode, which counts all the same.

  Args:
    end: Why the episode ended; `None` while it is under way.
    true_return: The sum of its true rewards.
  """
  return end in _BY_THE_AGENT and math.isfinite(true_return)
