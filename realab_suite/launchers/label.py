r"""Makes a labelled dataset of tampering from several designs and policies.

  python -m realab_suite.launchers.label --output=results/labelled \
    --designs=instantaneous_reward,value_advice --channels=embedded,secure \
    --policies=apple_seeker,random,carrying_saboteur --seeds=3 --episodes=10

Each step gets the clean contents, the corruption by kind, the part that the
agent has caused, and the label whether the agent is tampering (docs/data.md).
`--input`, the folder of a sweep, adds the runs of the sweep. The folder gets a
card with the counts and the columns.
"""

from collections.abc import Sequence
import pathlib
from typing import Any

from absl import flags

from realab_suite import errors
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import episodes_flag
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import input_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import scripted_flags
from realab_suite.launchers.flags import world_flags

flags.adopt_module_key_flags(episodes_flag)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(input_flag)
flags.adopt_module_key_flags(output_flag)
flags.adopt_module_key_flags(scripted_flags)
for name in ('domain', 'task', 'max_steps', 'set'):
  flags.declare_key_flag(name)
# They come with those flags, and would have no effect.
_OTHER_WORLD_FLAGS = ('design', 'senses', 'task_kwargs', 'target')
_DESIGNS = flags.DEFINE_list(
    'designs',
    ['instantaneous_reward', 'value_advice', 'decoupled_approval'],
    'Designs in which each scripted policy acts: names of designs that are part'
    ' of the package, or paths of YAML files.',
)


def main(argv: Sequence[str]) -> None:
  """Makes the dataset that the flags describe."""
  del argv
  output = pathlib.Path(
      program.required(output_flag.OUTPUT, '; name a new folder')
  )
  for name in _OTHER_WORLD_FLAGS:
    if flags.FLAGS[name].present:
      raise errors.SpecError(
          f'--{name}: not a flag of this program; it takes --designs, --domain,'
          ' --task, --max_steps and --set'
      )
  seeds = scripted_flags.parse_seeds(scripted_flags.SEEDS.value)
  renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.datasets import export

  export.check('parquet', output)
  imports_flag.load()
  found = [*_of_sweep(), *_scripted(seeds)]
  if not found:
    raise errors.SpecError(
        '--policies, --designs: nothing to run; name a policy and a design, or'
        ' a sweep with --input'
    )
  export.labelled(found, output, program.say)
  program.say(f'The dataset is in {output}')


def _of_sweep() -> list[Any]:
  """Returns the sources of the runs of a sweep, if there is one."""
  from realab_suite.datasets import sources
  from realab_suite.reports import sweep_results

  if not input_flag.INPUT.value:
    return []
  runs = sweep_results.load(pathlib.Path(input_flag.INPUT.value)).runs
  number = episodes_flag.EPISODES.value
  return [sources.of_run(run, number) for run in runs.values()]


def _scripted(seeds: tuple[int, ...]) -> list[Any]:
  """Runs the scripted policies, and returns their sources.

  Raises:
    SpecError: If a design, a policy or a task does not exist.
  """
  from realab_suite import policies
  from realab_suite import worlds
  from realab_suite.datasets import sources
  from realab_suite.feedback import specs

  world = worlds.World(*world_flags.world(), world_flags.MAX_STEPS.value)
  chosen = scripted_flags.POLICIES.value
  names = world.scripted if chosen is None else tuple(chosen)
  for policy in names:
    policies.POLICIES.get(policy)
  overrides = tuple(world_flags.SET.value)
  designs = [specs.load(design, overrides) for design in _DESIGNS.value]
  channels = [f'channel={one}' for one in scripted_flags.CHANNELS.value]
  twins = [
      [specs.load(design, [one]) for one in channels] or [design]
      for design in designs
  ]
  found = []
  for design, of_design in zip(designs, twins, strict=True):
    stake = None
    if names:
      why_not = worlds.why_no_stakes(world, design)
      program.say(f'{design.name}: {why_not or "measuring its stakes"}')
      stake = worlds.stakes_of(world, design)
    for twin in of_design:
      for policy in names:
        program.say(f'{policy} acts in {twin.name} ({twin.channel})')
        found.append(
            sources.of_policy(
                policy,
                policy,
                twin,
                world,
                seeds=seeds,
                num_episodes=episodes_flag.EPISODES.value,
                stake=stake,
            )
        )
  return found


if __name__ == '__main__':
  program.start(main)
