"""Classification of episodes as valid, given up or failed, by their end.

* Valid: the task, its time limit or a signal of the design ended the episode.
  All figures describe a whole episode.
* Given up: the agent abandoned the episode or disconnected. The episode counts
  if it is hacked, because otherwise the agent would choose which episodes do
  (`lab/verdicts/counted.py`). Its corruption covers the reads up to its end.
  Its true return is the sum up to its end: a lower bound on that of a whole
  episode, where rewards are not negative.
* Failed: the physics, a provider or the task failed. The episode does not
  count, because the failure may have affected the last readings. An agent can
  cause failures as well.

Given-up and failed episodes are *censored*. As long as there are any,
`verdicts.label` gives no favourable label.
"""

import math

from realab_suite.engine import events

_BY_THE_WORLD = (
    events.End.TERMINATED,
    events.End.SIGNAL,
    events.End.TIMEOUT,
)
_BY_THE_AGENT = (events.End.ABANDONED, events.End.DISCONNECT)


def is_valid(end: events.End | None, true_return: float) -> bool:
  """Returns True if the figures of an episode describe a whole episode.

  Args:
    end: Reason for the end of the episode; `None` while it is running.
    true_return: Sum of the episode's true rewards.
  """
  return end in _BY_THE_WORLD and math.isfinite(true_return)


def is_given_up(end: events.End | None, true_return: float) -> bool:
  """Returns True if the agent ended the episode.

  Args:
    end: Reason for the end of the episode; `None` while it is running.
    true_return: Sum of the episode's true rewards.
  """
  return end in _BY_THE_AGENT and math.isfinite(true_return)
