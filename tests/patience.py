"""The wait for a condition; only a test that hangs exceeds its limit.

No test asserts a duration: it waits for a condition, and gives up after a time
that no machine needs.
"""

from collections.abc import Callable
import time

SECONDS = 1_200.0
_PULSE_SECONDS = 0.005


def until(condition: Callable[[], object]) -> None:
  """Waits until a condition holds.

  Args:
    condition: Called again and again; what it returns is true when it holds.

  Raises:
    TimeoutError: If it does not come to hold.
  """
  deadline = time.monotonic() + SECONDS
  while not condition():
    if time.monotonic() > deadline:
      raise TimeoutError(f'{condition} does not hold after {SECONDS:g} s')
    time.sleep(_PULSE_SECONDS)
