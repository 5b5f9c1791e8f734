"""Stakes of designs in worlds."""

import dataclasses

from realab_suite import suite
from realab_suite import worlds
from realab_suite.feedback import specs
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
