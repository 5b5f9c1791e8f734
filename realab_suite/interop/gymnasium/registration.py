"""Ids of all shipped worlds in Gymnasium's registry."""

from collections.abc import Callable, Mapping
import functools
import inspect
from typing import Any, TypeVar

import gymnasium as gym

from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.interop.gymnasium import single
from realab_suite.interop.gymnasium import vector

NAMESPACE = 'realab'
"""Namespace of the ids."""

_Adapter = TypeVar('_Adapter', single.RealabEnv, vector.RealabVectorEnv)


def make(
    domain_name: str,
    task_name: str,
    design: specs.Design | None = None,
    **options: Any,
) -> single.RealabEnv:
  """Loads a world: the entry point of the registered ids.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.
    design: Design, by name, path or contents.
    **options: Other arguments of `suite.load`, and keyword arguments of
      `RealabEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  world = (domain_name, task_name)
  return _adapted(single.RealabEnv, suite.load, world, design, options)


def make_vector(
    num_envs: int,
    domain_name: str,
    task_name: str,
    design: specs.Design | None = None,
    **options: Any,
) -> vector.RealabVectorEnv:
  """Loads a batch of worlds: the vector entry point of the registered ids.

  Args:
    num_envs: Number of worlds.
    domain_name: Name of the domain.
    task_name: Name of the variation.
    design: Design, by name, path or contents.
    **options: Other arguments of `suite.load_batch`, and keyword arguments of
      `RealabVectorEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  world = (domain_name, task_name)
  load = functools.partial(suite.load_batch, num_envs=num_envs)
  return _adapted(vector.RealabVectorEnv, load, world, design, options)


def _adapted(
    adapter: Callable[..., _Adapter],
    load: Callable[..., Any],
    world: tuple[str, str],
    design: specs.Design | None,
    options: Mapping[str, Any],
) -> _Adapter:
  """Loads worlds, and returns them in an adapter.

  Args:
    adapter: Class of the adapter.
    load: Function that loads the worlds.
    world: Names of the domain and the task.
    design: The design.
    options: Arguments of `load`, and keyword arguments of the adapter.
  """
  of_load = inspect.signature(load).parameters.keys() & options.keys()
  of_adapter = options.keys() - of_load
  loaded = load(*world, design=design, **{k: options[k] for k in of_load})
  try:
    return adapter(loaded, **{k: options[k] for k in of_adapter})
  except BaseException:
    loaded.close()
    raise


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
