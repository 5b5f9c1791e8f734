"""Flags that choose a world, a design and the target of saboteurs."""

from typing import Any

from absl import flags

from realab_suite import errors
from realab_suite.config import loading

DOMAIN = flags.DEFINE_string(
    'domain', 'unlock_door', 'Domain, such as unlock_door or collect_apples.'
)
TASK = flags.DEFINE_string(
    'task',
    'standard',
    'Task of the domain: standard, near, far or boxed; or with its domain, such'
    ' as unlock_door.near.',
)
DESIGN = flags.DEFINE_string(
    'design',
    'instantaneous_reward',
    'Agent design: name of one that is part of the package, or path of a YAML'
    ' file.',
)
SET = flags.DEFINE_multi_string(
    'set',
    [],
    'Dotted override of the design, such as --set=registers.reward.scale=0.2',
)
MAX_STEPS = flags.DEFINE_integer(
    'max_steps', 250, 'Maximum length of an episode, in control steps.'
)
SENSES = flags.DEFINE_list(
    'senses',
    None,
    'Senses of the agent, such as --senses=camera or'
    ' --senses=ray_distances,velocity. Default: those of the task.',
)
TASK_KWARGS = flags.DEFINE_string(
    'task_kwargs',
    '{}',
    'Arguments of the task, as a YAML mapping, such as'
    ' --task_kwargs="{camera_size: [32, 32]}".',
)
TARGET = flags.DEFINE_string(
    'target',
    None,
    'Register that saboteurs attack. Default: the first feedback register; in'
    ' an audit, all registers.',
)


def senses() -> tuple[str, ...] | None:
  """Returns the names of the selected senses, or `None` for the default."""
  return None if SENSES.value is None else tuple(SENSES.value)


def task_kwargs() -> dict[str, Any]:
  """Returns the arguments of the task.

  Raises:
    SpecError: If they are not a YAML mapping, or contain the seed.
  """
  kwargs = loading.parse_yaml(TASK_KWARGS.value, '--task_kwargs')
  if 'random' in kwargs:
    raise errors.SpecError(
        '--task_kwargs: random: seeds have flags of their own; allowed are'
        ' arguments of the task'
    )
  return kwargs


def world() -> tuple[str, str]:
  """Returns the names of the domain and the task.

  Raises:
    SpecError: If the flags name two domains.
  """
  domain, dot, task = TASK.value.rpartition('.')
  if not dot:
    return DOMAIN.value, task
  if DOMAIN.present and DOMAIN.value != domain:
    raise errors.SpecError(
        f'--task={TASK.value} is not a task of --domain={DOMAIN.value}'
    )
  return domain, task
