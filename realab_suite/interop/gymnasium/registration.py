"""Ids of all shipped worlds in Gymnasium's registry."""

from collections.abc import Mapping, Sequence
import functools
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
    *,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
    **options: Any,
) -> single.RealabEnv:
  """Loads a world: the entry point of the registered ids.

  Args:
    domain_name: As in `suite.load`; so are the next five.
    task_name: Name of the variation.
    design: Design, by name, path or contents.
    task_kwargs: Seed `random` and arguments of the task.
    environment_kwargs: `max_steps`, `senses` and `world`.
    overrides: Dotted overrides of the design.
    **options: Keyword arguments of `RealabEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  env = suite.load(
      domain_name,
      task_name,
      task_kwargs,
      environment_kwargs,
      design=design,
      overrides=overrides,
  )
  try:
    return single.RealabEnv(env, **options)
  except BaseException:
    env.close()
    raise


def make_vector(
    num_envs: int,
    domain_name: str,
    task_name: str,
    design: specs.Design | None = None,
    *,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
    num_threads: int = 0,
    sleep: bool = False,
    **options: Any,
) -> vector.RealabVectorEnv:
  """Loads a batch of worlds: the vector entry point of the registered ids.

  Args:
    num_envs: Number of worlds.
    domain_name: As in `suite.load_batch`; so are the next seven.
    task_name: Name of the variation.
    design: Design, by name, path or contents.
    task_kwargs: Seed `random` and arguments of the task.
    environment_kwargs: `max_steps` and `senses`.
    overrides: Dotted overrides of the design.
    num_threads: Number of threads; 0 for one per processor.
    sleep: True if blocks at rest sleep.
    **options: Keyword arguments of `RealabVectorEnv`.

  Raises:
    SpecError: If an argument is invalid.
  """
  batch = suite.load_batch(
      domain_name,
      task_name,
      task_kwargs,
      environment_kwargs,
      num_envs=num_envs,
      num_threads=num_threads,
      sleep=sleep,
      design=design,
      overrides=overrides,
  )
  try:
    return vector.RealabVectorEnv(batch, **options)
  except BaseException:
    batch.close()
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
