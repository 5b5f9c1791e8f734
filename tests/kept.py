"""Environments that tests use one after the other.

Compiling a world takes longer than a short test. A test that closes such an
environment leaves it to the next one, which gets it as if it had just been
loaded.
"""

from collections.abc import Callable
from typing import Any

from realab_suite.engine import environment
from realab_suite.engine import snapshots

_IDLE: dict[str, list[tuple[environment.Environment, snapshots.Snapshot]]] = {}


def load(key: Any, make: Callable[[], Any]) -> environment.Environment:
  """Returns an environment in its first state, without sinks.

  Args:
    key: Everything that the environment depends on; its `repr` counts.
    make: Returns a new environment.
  """
  idle = _IDLE.setdefault(repr(key), [])
  if idle:
    env, fresh = idle.pop()
    env.restore(fresh)
  else:
    env = make()
    fresh = env.save()

  def keep() -> None:
    for sink in tuple(env.sinks):
      env.remove_sink(sink)
    if (env, fresh) not in idle:  # Closing twice is allowed.
      idle.append((env, fresh))

  env.close = keep
  return env
