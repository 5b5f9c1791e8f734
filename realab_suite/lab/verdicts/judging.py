"""Stakes of designs in worlds, and obstacles to judging them."""

import contextlib
import dataclasses
from typing import NamedTuple, final

from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import gains
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import obstacles
from realab_suite.lab.verdicts import stakes


def stakes_of(
    world: worlds.World,
    design: specs.DesignSpec,
    share: stakes.Share = lambda play: play(),
) -> stakes.Stakes | None:
  """Measures the stakes of a design in the domain of a world.

  Args:
    world: The world.
    design: The design.
    share: As in `stakes.measure`.

  Returns:
    The stakes; `None` if the task names no solver, or the learner is not
    judged.
  """
  key = key_of_stakes(world, design)
  if key is None or world.solver is None:
    return None
  return stakes.measure(
      world.for_stakes(design, world.reference).load_batch,
      world.for_stakes(design, world.task).load_batch,
      design,
      world.solver,
      key,
      share,
  )


def key_of_stakes(world: worlds.World, design: specs.DesignSpec) -> str | None:
  """Returns the key of the stakes of a design, or `None` if there are none.

  Args:
    world: The world.
    design: The design.
  """
  if design.objective is None or world.solver is None:
    return None
  return stakes.key_of(
      design,
      solver=world.solver,
      world=dataclasses.asdict(world.for_stakes(design, world.task)),
      reference=world.reference,
      dynamics=[
          suite.dynamics(world.domain, task)
          for task in (world.reference, world.task)
      ],
  )


def obstacles_of(
    world: worlds.World, design: specs.DesignSpec, stake: stakes.Stakes | None
) -> list[str]:
  """Returns reasons against favourable judgements; see `obstacles`.

  Args:
    world: The world.
    design: The design.
    stake: Stakes of the design, or `None`.
  """
  with contextlib.closing(world.load(design, stakes.SEED)) as env:
    return obstacles.of_mechanism(env.mechanism, world.instruments, stake)


@final
class Coupling(NamedTuple):
  """Embedded registers that the objective depends on, by name.

  Attributes:
    of_task: Those with blocks of the task: physics changes them as a part of
      it; see `verdicts.coincidence`.
    apart: The others.
  """

  of_task: list[str]
  apart: list[str]


def coupling(world: worlds.World, design: specs.DesignSpec) -> Coupling:
  """Returns the registers that have blocks of the task, and the others.

  Args:
    world: The world.
    design: The design.
  """
  coupled = Coupling([], [])
  with contextlib.closing(world.load(design, stakes.SEED)) as env:
    for name in gains.relevant(design, sees=False):
      if design.channel_of(name) == 'embedded':
        register = env.mechanism.registers[design.register_of(name)]
        of_task = len(register.own_blocks) < len(register.blocks)
        (coupled.of_task if of_task else coupled.apart).append(name)
  return coupled


def why_no_stakes(world: worlds.World, design: specs.DesignSpec) -> str:
  """Returns the reason for missing stakes, or an empty string."""
  if design.objective is None:
    return design.why_not_judged
  if world.solver is None:
    return (
        f'{world.domain}.{world.task} names no solver, so the design has no'
        ' stake'
    )
  return ''
