r"""Runs a sweep: every run of an experiment with every seed, in parallel.

  python -m realab_suite.launchers.sweep --experiment=quick \
    --output=results/quick

The same command continues an interrupted sweep. Finished jobs are not repeated,
and the failure of one job does not stop the others.
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
_ON_TASK = flags.DEFINE_string(
    'on_task',
    None,
    'Task to run the experiment on instead of its own, such as'
    ' unlock_door.far. Use a separate folder for each task.',
)
_RUNS = flags.DEFINE_list(
    'runs', [], 'Runs to execute, such as "reward,reward.secure". Default: all.'
)
_CALIBRATION = flags.DEFINE_boolean(
    'calibration',
    False,
    'Uses the calibration seeds instead of the reported ones. Use a separate'
    ' folder for them.',
)
_WORKERS = flags.DEFINE_integer(
    'workers',
    None,
    'Number of jobs in parallel with --engine=local. Default: the number of'
    ' processors.',
    lower_bound=1,
)
_ENGINE = flags.DEFINE_enum(
    'engine',
    'local',
    ['local', 'ray', 'submitit'],
    'Engine that runs the jobs: this machine, or a cluster with a shared file'
    ' system (needs the extra `cluster`).',
)


def main(argv: Sequence[str]) -> None:
  """Runs the sweep that the flags describe."""
  del argv
  name, output = program.required(learning_flags.EXPERIMENT), program.required(
      output_flag.OUTPUT
  )
  threads.use_one()
  renderers.render_on_demand()
  # Imports numerical libraries, so the number of threads has to be set first.
  from realab_suite.experiments import curves
  from realab_suite.experiments import engines
  from realab_suite.experiments import experiment_specs
  from realab_suite.experiments import scheduler

  imports_flag.load()
  experiment = experiment_specs.load(name)
  if _ON_TASK.value is not None:
    experiment = experiment.on_task(_ON_TASK.value)
  if learning_flags.TENSORBOARD.value:
    curves.check_tensorboard()
  arguments = imports_flag.arguments()
  if learning_flags.TENSORBOARD.value:
    arguments.append(f'--{learning_flags.TENSORBOARD.name}')
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
