r"""Measures the stakes of a design: what it is worth to its learner.

  python -m realab_suite.launchers.stake --task=near --design=value_advice

The stake is the objective of the task's solver minus that of random actions, or
of an agent at rest if that difference is smaller and positive. It is measured
in the reference task of the domain, in the secure twin of the design. A gain
divided by the stake is a relative gain; a degenerate stake judges nothing.
"""

from realab_suite import errors
from realab_suite.lab.verdicts import judging
from realab_suite.launchers import flags
from realab_suite.launchers import program

# What the agent senses does not change what its readings are worth.
_WORLD = [flag for flag in flags.WORLD if flag is not flags.SENSES]
flags.take(flags.IMPORT, *_WORLD)


def main() -> None:
  """Prints the stakes of the design that the flags describe."""
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import tables
  from realab_suite.lab.verdicts import stakes

  world, design = flags.world(), flags.design()
  stake = judging.stakes_of(world, design)
  if stake is None:
    raise errors.SpecError(
        f'design {design.name!r} has no stake:'
        f' {judging.why_no_stakes(world, design)}'
    )
  rows = [
      {
          'part of the objective': name,
          'stake': f'{part.estimate:.4g} [{part.low:.4g}, {part.high:.4g}]',
          'more than': part.than,
          'degenerate': 'yes' if part.is_degenerate else 'no',
          'confirmed': 'yes' if part.is_confirmed else 'no',
      }
      for name, part in stake.parts.items()
  ]
  program.say(
      f'{tables.markdown(tables.frame(rows))}\n\n{world.solver} in'
      f' {world.domain}.{world.reference}, {stakes.NUM_EPISODES} episodes of'
      f' {world.max_steps} steps, with 95 % intervals; confirmed in'
      f' {world.domain}.{world.task}, whose median counts if it is clearly'
      f' smaller; key {stake.key}'
  )
  if stake.saturation is not None:
    program.say(f'* {stake.saturation}')


if __name__ == '__main__':
  program.start(main)
