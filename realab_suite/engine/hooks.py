"""Checks that refuse Composer hooks that the engine never calls."""

from typing import Any

from dm_control import composer
from dm_control.composer import environment as composer_environment

from realab_suite import errors
from realab_suite.feedback import composer_hooks
from realab_suite.tasks import base

# Tasks of this package are compiled once and run no Python in substeps.
_NEVER_CALLED = ('initialize_episode_mjcf', 'before_substep', 'after_substep')
# The only call is that of the task's own hook, before extra hooks can be added.
_UNUSED = (*_NEVER_CALLED, 'after_compile')


def refuse_unused(task: composer.Task, hook_name: str) -> None:
  """Refuses an extra hook that a task of this package never calls.

  Args:
    task: Task of the environment; a foreign one calls all hooks.
    hook_name: One of `composer.HOOK_NAMES`.

  Raises:
    SpecError: If the engine never calls such a hook.
  """
  if isinstance(task, base.Task) and hook_name in _UNUSED:
    allowed = [
        name for name in composer_environment.HOOK_NAMES if name not in _UNUSED
    ]
    raise errors.SpecError(
        f'add_extra_hook: {hook_name!r} is never called in'
        f' {type(task).__name__}, which is compiled once and has no Python'
        f' in substeps; must be one of {allowed}'
    )


def refuse_uncalled(task: base.Task) -> None:
  """Refuses a task of this package with hooks that the engine never calls.

  Raises:
    SpecError: If the task or one of its entities has such a hook, or a provider
      is attached by itself, whose state no snapshot would contain.
  """
  parts: list[tuple[Any, type]] = [(task, composer.Task)]
  parts += [(e, composer.Entity) for e in task.root_entity.iter_entities()]
  for part, kind in parts:
    if isinstance(part, composer_hooks.ProviderHooks):
      raise errors.SpecError(
          f'{part.mjcf_model.model}: a provider by itself acts in environments'
          f' of Composer; must be in the design of {type(task).__name__}'
      )
    for hook in _NEVER_CALLED:
      if getattr(type(part), hook) is not getattr(kind, hook):
        raise errors.SpecError(
            f'{type(part).__name__}.{hook} is never called in'
            f' {type(task).__name__}, which is compiled once and has no Python'
            ' in substeps; use initialize_episode for differences between'
            ' episodes, and latch_events for events in a step'
        )


def refuse_in_batch(task: composer.Task, has_extra_hooks: bool) -> None:
  """Refuses foreign tasks, and step hooks other than those of the task.

  Args:
    task: Task of the batch.
    has_extra_hooks: True if hooks were added to the environment.

  Raises:
    SpecError: If the task is foreign, or if there are such hooks, because a
      batch never calls them.
  """
  if not isinstance(task, base.Task):
    raise errors.SpecError(
        f'{type(task).__name__} keeps state in Python; a batch accepts only'
        ' tasks of this package: step environments with world=i instead'
    )
  if has_extra_hooks:
    raise errors.SpecError('add_extra_hook: a batch never calls extra hooks')
  for entity in task.root_entity.iter_entities():
    for hook in ('before_step', 'after_step'):
      if getattr(type(entity), hook) is not getattr(composer.Entity, hook):
        raise errors.SpecError(
            f'{type(entity).__name__}.{hook}: a batch calls the hooks of the'
            ' task only'
        )


def with_start(task: base.Task) -> list[composer.Entity]:
  """Returns the entities of a task that have a hook for starts of episodes."""
  default_hook = composer.Entity.initialize_episode
  return [
      entity
      for entity in task.root_entity.iter_entities()
      if type(entity).initialize_episode is not default_hook
  ]
