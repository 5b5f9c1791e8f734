"""Ids of all shipped worlds in Gymnasium's registry."""

from collections.abc import Callable
import functools
import inspect
from typing import Any

import gymnasium as gym

from realab_suite import suite
from realab_suite.doors.gymnasium import interfaces
from realab_suite.doors.gymnasium import single
from realab_suite.doors.gymnasium import vector
from realab_suite.feedback import specs

NAMESPACE = 'realab'
"""Namespace of the ids."""


def make(
    domain_name: str,
    task_name: str | None = None,
    design: specs.Design | suite.Omitted | None = suite.Omitted.DESIGN,
    **options: Any,
) -> Any:
  """Loads a world: the entry point of the registered ids.

  Args:
    domain_name: Same as in `suite.load`.
    task_name: Same as in `suite.load`.
    design: Same as in `suite.load`.
    **options: Other arguments of `suite.load`, and values of
      `interfaces.Options`.

  Returns:
    A `RealabEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  load = functools.partial(suite.load, domain_name, task_name)
  return _adapted(load, single.RealabEnv, {'design': design, **options})


def make_vector(
    domain_name: str,
    task_name: str | None = None,
    design: specs.Design | suite.Omitted | None = suite.Omitted.DESIGN,
    *,
    num_envs: int,
    **options: Any,
) -> Any:
  """Loads a batch of worlds: the vector entry point of the registered ids.

  Args:
    domain_name: Same as in `suite.load`.
    task_name: Same as in `suite.load`.
    design: Same as in `suite.load`.
    num_envs: Number of worlds.
    **options: Other arguments of `suite.load_batch`, `autoreset_mode`, and
      values of `interfaces.Options`.

  Returns:
    A `RealabVectorEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  load = functools.partial(
      suite.load_batch, domain_name, task_name, num_envs=num_envs
  )
  return _adapted(load, vector.RealabVectorEnv, {'design': design, **options})


def id_of(domain_name: str, task_name: str, design: str) -> str:
  """Returns the id of a shipped world with a shipped design.

  Its version is that of the dynamics of the task.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.
    design: Name of the design.

  Raises:
    UnknownNameError: If there is no such task.
  """
  domain, design = (
      ''.join(word.capitalize() for word in name.split('_'))
      for name in (domain_name, design)
  )
  version = _version(domain_name, task_name)
  return f'{NAMESPACE}/{domain}-{task_name}-{design}-v{version}'


def ids() -> list[str]:
  """Returns the ids of all shipped worlds with all shipped designs."""
  return [id_of(*names) for names in _worlds()]


def register_all() -> None:
  """Registers all ids, unless they are registered already."""
  for names in _worlds():
    name = id_of(*names)
    if name not in gym.registry:
      gym.register(
          name,
          entry_point=f'{__name__}:make',
          vector_entry_point=f'{__name__}:make_vector',
          kwargs=dict(
              zip(('domain_name', 'task_name', 'design'), names, strict=True)
          ),
      )


def _worlds() -> list[tuple[str, str, str]]:
  """Returns the domain, the task and the design of every id."""
  return [
      (*task, design)
      for task in suite.ALL_TASKS
      for design in suite.designs_for(task[0])
  ]


def _adapted(
    load: Callable[..., Any], adapter: Any, options: dict[str, Any]
) -> Any:
  """Returns the adapter of what a loader loads.

  Raises:
    SpecError: If an option is invalid.
  """
  of_load = inspect.signature(load).parameters
  rest = {key: options[key] for key in options if key not in of_load}
  allowed = [
      # One has a single allowed value, and the other is set already.
      *(key for key in of_load if key not in ('visualize_reward', 'num_envs')),
      *(['autoreset_mode'] if adapter is vector.RealabVectorEnv else []),
      *interfaces.Options.model_fields,
  ]
  interfaces.check_names(rest, allowed)
  loaded = load(**{key: options[key] for key in options if key in of_load})
  try:
    return adapter(loaded, **rest)
  except BaseException:
    loaded.close()
    raise


@functools.cache
def _version(domain_name: str, task_name: str) -> int:
  version, _ = suite.dynamics(domain_name, task_name)
  return version
