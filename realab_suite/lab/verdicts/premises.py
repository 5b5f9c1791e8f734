"""Premises of judgements: what only a world with a design can tell.

A world has to be compiled for them. So they are collected beside the rows of a
study, and published with them. A judge of published results needs no world.
"""

from collections.abc import Mapping
import contextlib
from typing import Any, final

from realab_suite import errors
from realab_suite import worlds
from realab_suite.config import task_names
from realab_suite.config import validation
from realab_suite.evaluation import gains
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import obstacles
from realab_suite.lab.verdicts import stakes

_DECIDING = (
    'design', 'task', 'task_kwargs', 'environment_kwargs', 'max_steps',
)  # fmt: skip


@final
class Premises(validation.Record):
  """What judgements depend on beside the episodes.

  Attributes:
    solver: Name of the policy that solves the task, or `None`.
    best_mean_return: Mean true return of episodes that are played as well as
      possible.
    coinciding: Embedded registers that the objective depends on and that have
      blocks of the task: physics changes them as a part of it; see
      `verdicts.coincidence`.
    apart: The other embedded ones that it depends on.
    obstacles: Reasons of the design against favourable judgements; see
      `obstacles.of_mechanism`.
    refusal: Why the world has come to refuse the design, or empty.
  """

  solver: str | None
  best_mean_return: float
  coinciding: tuple[str, ...] = ()
  apart: tuple[str, ...] = ()
  obstacles: tuple[str, ...] = ()
  refusal: str = ''


def key_of(config: Mapping[str, Any]) -> str:
  """Returns the key of the premises of a run, a digest.

  Args:
    config: Its configuration.
  """
  return validation.digest_of({name: config[name] for name in _DECIDING})


def world_of(config: Mapping[str, Any]) -> worlds.World:
  """Returns the world of a configuration."""
  senses = config['environment_kwargs']['senses']
  return worlds.World(
      *task_names.split(config['task']),
      int(config['max_steps']),
      dict(config['task_kwargs']),
      senses and tuple(senses),
  )


def of(world: worlds.World, design: specs.DesignSpec) -> Premises:
  """Returns the premises of a design in a world."""
  solver, best = world.solver, world.best_mean_return
  try:
    env = world.load(design, stakes.SEED)
  except errors.SpecError as error:
    return Premises(solver=solver, best_mean_return=best, refusal=str(error))
  coinciding: list[str] = []
  apart: list[str] = []
  with contextlib.closing(env):
    mechanism = env.mechanism
    for name in gains.relevant(design, sees=False):
      if design.is_movable(name):
        register = mechanism.registers[design.register_of(name)]
        has_blocks_of_task = len(register.own_blocks) < len(register.blocks)
        (coinciding if has_blocks_of_task else apart).append(name)
    return Premises(
        solver=solver,
        best_mean_return=best,
        coinciding=tuple(coinciding),
        apart=tuple(apart),
        obstacles=tuple(obstacles.of_mechanism(mechanism, world.instruments)),
    )
