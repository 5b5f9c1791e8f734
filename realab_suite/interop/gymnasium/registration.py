"""Ids of all shipped worlds in Gymnasium's registry."""

import functools
import inspect
from typing import Any

import gymnasium as gym

from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.interop.gymnasium import single
from realab_suite.interop.gymnasium import vector

NAMESPACE = 'realab'
"""Namespace of the ids."""


def make(
    domain_name: str,
    task_name: str,
    design: specs.Design | None = None,
    num_envs: int | None = None,
    **options: Any,
) -> Any:
  """Loads a world, or a batch: the entry points of the registered ids.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.
    design: Design, by name, path or contents.
    num_envs: Number of worlds, or `None` for a single one.
    **options: Other arguments of `suite.load` or `suite.load_batch`, and
      keyword arguments of the adapter.

  Returns:
    A `RealabEnv`, or a `RealabVectorEnv` with a number of worlds.

  Raises:
    SpecError: If an argument is invalid.
  """
  adapter: Any = single.RealabEnv
  load: Any = suite.load
  if num_envs is not None:
    adapter = vector.RealabVectorEnv
    load = functools.partial(suite.load_batch, num_envs=num_envs)
  of_load = inspect.signature(load).parameters.keys() & options.keys()
  loaded = load(
      domain_name,
      task_name,
      design=design,
      **{name: options.pop(name) for name in of_load},
  )
  try:
    return adapter(loaded, **options)
  except BaseException:
    loaded.close()
    raise


make_vector = make
"""Vector entry point: `gymnasium.make_vec` adds `num_envs`."""


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
  version = _version(domain_name, task_name)
  words = (_camel_case(domain_name), task_name, _camel_case(design))
  return f'{NAMESPACE}/{"-".join(words)}-v{version}'


def ids() -> list[str]:
  """Returns the ids of all shipped worlds with all shipped designs."""
  return [
      id_of(*task, design)
      for task in suite.ALL_TASKS
      for design in suite.DESIGNS
  ]


def register_all() -> None:
  """Registers all ids, unless they are registered already."""
  for domain_name, task_name in suite.ALL_TASKS:
    for design in suite.DESIGNS:
      name = id_of(domain_name, task_name, design)
      if name in gym.registry:
        continue
      gym.register(
          name,
          entry_point=f'{__name__}:make',
          vector_entry_point=f'{__name__}:make_vector',
          kwargs={
              'domain_name': domain_name,
              'task_name': task_name,
              'design': design,
          },
      )


@functools.cache
def _version(domain_name: str, task_name: str) -> int:
  version, _ = suite.dynamics(domain_name, task_name)
  return version


def _camel_case(name: str) -> str:
  return ''.join(word.capitalize() for word in name.split('_'))
