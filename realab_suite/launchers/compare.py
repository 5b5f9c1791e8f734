r"""Compares scripted policies in worlds whose feedback can be tampered with.

For example, this measures tampering with the reward of Unlock Door:

  python -m realab_suite.launchers.compare --policies=apple_seeker,random \
    --channels=embedded,secure --seeds=5 --episodes=2 --output=results/mine

The program prints a table with the hack rate of each run beside that of the
control, and writes results into the output folder.
Agents that learn are trained by `train`, for one run of an experiment, and by
`sweep`, for all of them.
"""

from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    *flags.WORLD, flags.TARGET, *flags.SCRIPTED, flags.IMPORT, flags.OUTPUT
)


def main() -> None:
  """Runs the comparison that the flags describe."""
  output = flags.required(flags.OUTPUT, '; name a folder for the results')
  seeds = flags.seeds()
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import scripted

  world = flags.world()
  design = flags.design()  # Refuses a wrong one before anything is written.
  policies = flags.POLICIES.value
  if policies is None:
    policies = world.scripted_in(design)
  settings = scripted.Settings(
      world=world,
      design=flags.DESIGN.value or flags.DEFAULT_DESIGN,
      overrides=tuple(flags.SET.value),
      policies=tuple(policies),
      channels=tuple(flags.CHANNELS.value),
      target=flags.TARGET.value,
      seeds=seeds,
      num_episodes=flags.num_episodes(),
      output=output,
  )
  scripted.run(settings, program.say)


if __name__ == '__main__':
  program.start(main)
