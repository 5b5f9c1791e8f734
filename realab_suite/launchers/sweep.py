r"""Runs a whole experiment: every run and every seed, side by side.

  python -m realab_suite.launchers.sweep --experiment=quick \
    --output=results/quick

Run the same command again to go on where it stopped. What is done is not done
again, and what failed does not keep the rest from being done.
"""

from collections.abc import Sequence
import os
import pathlib

from absl import flags

from realab_suite.experiments import threads
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import learning_flags
from realab_suite.launchers.flags import output_flag

flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(learning_flags)
flags.adopt_module_key_flags(output_flag)
_RUNS = flags.DEFINE_list(
    'runs', [], 'The runs to do, as in "reward,reward.secure"; all by default.'
)
_CALIBRATION = flags.DEFINE_boolean(
    'calibration',
    False,
    'Whether to use the calibration seeds, in a folder of their own, instead of'
    ' those that are reported.',
)
_WORKERS = flags.DEFINE_integer(
    'workers',
    None,
    'How many runs there are at a time with --engine=local; by default one for'
    ' each processor.',
    lower_bound=1,
)
_ENGINE = flags.DEFINE_enum(
    'engine',
    'local',
    ['local', 'ray', 'submitit'],
    'What runs the jobs: this machine, or a cluster that shares its file system'
    ' (needs the extra `cluster`).',
)


def main(argv: Sequence[str]) -> None:
  """Runs the experiment that the flags name."""
  del argv
  name, output = program.required(learning_flags.EXPERIMENT), program.required(
      output_flag.OUTPUT
  )
  threads.use_one()
  renderers.render_nothing()
  # Not before libraries have been told to use one thread.
  from realab_suite.experiments import curves
  from realab_suite.experiments import engines
  from realab_suite.experiments import experiment_specs
  from realab_suite.experiments import scheduler

  imports_flag.load()
  experiment = experiment_specs.load(name)
  if learning_flags.TENSORBOARD.value:
    curves.check_tensorboard()
  arguments = imports_flag.arguments()
  arguments += [
      f'--{flag.name}'
      for flag in (learning_flags.TENSORBOARD, learning_flags.OTHER_MACHINE)
      if flag.value
  ]
  engine = engines.ENGINES[_ENGINE.value](_WORKERS.value or os.cpu_count() or 1)
  scheduler.sweep(
      experiment,
      pathlib.Path(output),
      engine,
      program.say,
      only=_RUNS.value,
      calibration=_CALIBRATION.value,
      arguments=arguments,
  )


if __name__ == '__main__':
  program.start(main)
