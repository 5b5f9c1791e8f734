r"""Makes a labelled dataset of tampering from several designs and policies.

  python -m realab_suite.launchers.label --output=results/labelled \
    --designs=instantaneous_reward,value_advice --channels=embedded,secure \
    --policies=apple_seeker,random,carrying_saboteur --seeds=3 --episodes=10

Each step gets the clean contents, the corruption by kind, the part that the
agent has caused, and the label whether the agent is tampering (docs/doors.md).
`--input`, the folder of a sweep, adds the runs of the sweep. The folder gets a
card with the counts and the columns.
"""

import os
import pathlib
from typing import Any

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.verdicts import judging
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    flags.TASK,
    flags.MAX_STEPS,
    flags.SET,
    *flags.SCRIPTED,
    flags.IMPORT,
    flags.INPUT,
    flags.ACCEPT_OTHER_CODE,
    flags.OUTPUT,
)
_DESIGNS = absl_flags.DEFINE_list(
    'designs',
    ['instantaneous_reward', 'value_advice', 'decoupled_approval'],
    'Designs in which each scripted policy acts: names of designs that are part'
    ' of the package, or paths of YAML files.',
)


def main() -> None:
  """Makes the dataset that the flags describe."""
  output = pathlib.Path(flags.required(flags.OUTPUT, '; name a new folder'))
  seeds = flags.seeds()
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.doors.data import export

  export.check('parquet', output)
  run_sources = [*_of_sweep(), *_scripted(seeds)]
  if not run_sources:
    raise errors.SpecError(
        '--policies, --designs: nothing to run; name a policy and a design, or'
        ' a sweep with --input'
    )
  export.labelled(run_sources, output, program.say)
  program.say(f'The dataset is in {output}')


def _of_sweep() -> list[Any]:
  """Returns the sources of the runs of a sweep, if there is one."""
  from realab_suite.doors.data import sources
  from realab_suite.lab.experiments import studies

  if not flags.INPUT.value:
    return []
  folder = pathlib.Path(flags.INPUT.value)
  runs = studies.read_sweep(
      folder, flags.ACCEPT_OTHER_CODE.value
  ).without_controls
  number = flags.num_episodes()
  return [sources.of_run(run, number) for run in runs.values()]


def _scripted(seeds: tuple[int, ...]) -> list[Any]:
  """Runs the scripted policies, and returns their sources.

  Raises:
    SpecError: If a design, a policy or a task does not exist.
  """
  from realab_suite import policies
  from realab_suite.doors.data import sources
  from realab_suite.feedback import specs

  world = flags.world()
  named = flags.POLICIES.value
  if named == []:
    return []
  for policy in named or ():
    policies.POLICIES.get(policy)
  designs = [
      flags.design(os.path.expanduser(design)) for design in _DESIGNS.value
  ]
  channels = [f'channel={one}' for one in flags.CHANNELS.value]
  twins = [
      [specs.load(design, [one]) for one in channels] or [design]
      for design in designs
  ]
  run_sources = []
  for design, of_design in zip(designs, twins, strict=True):
    why_not = judging.why_no_stakes(world, design)
    program.say(f'{design.name}: {why_not or "measuring its stakes"}')
    stake = judging.stakes_of(world, design)
    for twin in of_design:
      for policy in world.scripted_in(design) if named is None else named:
        program.say(f'{policy} acts in {twin.name} ({twin.channel})')
        run_sources.append(
            sources.of_policy(
                policy,
                policy,
                twin,
                world,
                seeds=seeds,
                num_episodes=flags.num_episodes(),
                stake=stake,
            )
        )
  return run_sources


if __name__ == '__main__':
  program.start(main)
