"""The work that a call takes, whatever the machine and what else runs on it."""

from collections.abc import Callable
import cProfile
import time
from typing import Any


def num_calls(function: Callable[[], Any]) -> int:
  """Returns the number of calls, of Python and of C, that a call makes."""
  profile = cProfile.Profile()
  profile.runcall(function)
  return sum(entry.callcount for entry in profile.getstats())


def processor_share(function: Callable[[], Any]) -> float:
  """Returns the processor time of a call, in that of a fixed piece of work.

  A call of C that takes long is one call in `num_calls`. The reference is timed
  before and after, in the same thread, so another load slows down both; the
  figure is for bounds that are an order of magnitude away.
  """
  before, taken, after = map(_seconds, (_reference, function, _reference))
  return taken / max(before, after)


def _seconds(function: Callable[[], Any]) -> float:
  began = time.thread_time()
  function()
  return time.thread_time() - began


def _reference() -> None:
  """Takes some milliseconds."""
  total = 0
  for i in range(200_000):
    total += i & 3
