r"""Places the register that pays for a requested time to the first corruption.

  python -m realab_suite.launchers.calibrate --task=unlock_door.near \
    --design=instantaneous_reward --steps=20000

The register is put at every named place and on a grid. Random actions measure
the number of control steps, of all worlds together, until a corruption pays for
the first time. The program prints a table and the place that comes closest.
"""

from collections.abc import Sequence
import math

from absl import flags

from realab_suite import errors
from realab_suite.evaluation import intervals
from realab_suite.experiments import audit_worlds
from realab_suite.experiments import calibration
from realab_suite.experiments import result_tables
from realab_suite.feedback import specs
from realab_suite.launchers import program
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import seed_flag
from realab_suite.launchers.flags import world_flags

flags.adopt_module_key_flags(world_flags)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(seed_flag)
_STEPS = flags.DEFINE_integer(
    'steps',
    None,
    'Requested control steps of all worlds to the first paying corruption.',
    lower_bound=1,
)
_NUM_ENVS = flags.DEFINE_integer(
    'num_envs', 128, 'Number of worlds and episodes of each place.', 64, 65536
)
_SPACING = flags.DEFINE_float(
    'spacing', 1.0, 'Distance between places of the grid, in m.', 0.1, 100.0
)
_HEADER = ['place', 'contact', 'paying read', 'median steps to the first']


def main(argv: Sequence[str]) -> None:
  """Measures places and prints the one that comes closest."""
  del argv
  steps = program.required(
      _STEPS, '; give the control steps to the first paying corruption'
  )
  imports_flag.load()
  domain, task = world_flags.world()
  settings = calibration.Settings(
      world=audit_worlds.World(
          domain,
          task,
          world_flags.MAX_STEPS.value,
          world_flags.task_kwargs(),
          world_flags.senses(),
      ),
      design=specs.load(world_flags.DESIGN.value, world_flags.SET.value),
      target=world_flags.TARGET.value,
      spacing=_SPACING.value,
      num_envs=_NUM_ENVS.value,
      seed=seed_flag.SEED.value,
  )
  found = calibration.measure(settings)
  if not found.trials:
    raise errors.SpecError(
        f'all {found.num_refused} places are refused; allowed is a grid with a'
        ' smaller --spacing, or a narrower range of the register'
    )
  trials = sorted(found.trials, key=lambda one: one.median_steps[0])
  program.say(result_tables.markdown([_HEADER, *map(_row, trials)]))
  program.say(f'{found.num_refused} other places are refused.')
  best = found.closest(steps)
  if best is None:
    program.say('No place comes close: random actions never corrupted it.')
    return
  program.say(
      f'Closest to {steps} steps, with {_steps(best)}:'
      f' --set="registers.{found.target}.place={best.place}"'
  )


def _row(trial: calibration.Trial) -> list[str]:
  contact = f'{100 * trial.num_contacts / trial.num_episodes:.0f} %'
  share, low, high = (100 * value for value in trial.paying_share)
  paying = f'{share:.1f} % [{low:.1f}, {high:.1f}]'
  return [trial.place, contact, paying, _steps(trial)]


def _steps(trial: calibration.Trial) -> str:
  median, low, high = trial.median_steps
  if math.isinf(median):
    return f'none in {trial.num_steps} steps (above {intervals.short(low)})'
  return f'{intervals.short(median)} [{intervals.short(low)}, {_end(high)}]'


def _end(steps: float) -> str:
  return 'no bound' if math.isinf(steps) else intervals.short(steps)


if __name__ == '__main__':
  program.start(main)
