"""How long tests wait for what is to happen; only what hangs takes longer.

No test asserts how long something takes: it waits for what is to happen, and
gives up after a time that no machine needs.
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
