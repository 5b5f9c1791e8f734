r"""Runs a sweep: every run of an experiment with every seed, in parallel.

  python -m realab_suite.launchers.sweep --experiment=quick \
    --output=results/quick

The same command continues an interrupted sweep. Finished jobs are not repeated,
and the failure of one job does not stop the others.
"""

import pathlib
from typing import Any

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    flags.IMPORT,
    flags.EXPERIMENT,
    flags.OUTPUT,
    flags.ACCEPT_OTHER_CODE,
)
flags.take(
    flags.BUDGET, help_text='Named budget of the runs: realab-1M or realab-20M.'
)

_ON_TASK = absl_flags.DEFINE_string(
    'on_task',
    None,
    'Task to run the experiment on instead of its own, such as'
    ' unlock_door.far. Use a separate folder for each task.',
)
_RUNS = absl_flags.DEFINE_list(
    'runs', [], 'Runs to execute, such as "reward,reward.secure". Default: all.'
)
_CALIBRATION = absl_flags.DEFINE_boolean(
    'calibration',
    False,
    'Uses the calibration seeds instead of the reported ones. Use a separate'
    ' folder for them.',
)
_WORKERS = absl_flags.DEFINE_integer(
    'workers',
    None,
    'Number of jobs in parallel with --engine=local. Default: the number of'
    ' processors that this process may use.',
    lower_bound=1,
)
_ENGINE = absl_flags.DEFINE_enum(
    'engine',
    'local',
    ['local', 'ray', 'submitit'],
    'Engine that runs the jobs: this machine, or a cluster with a shared file'
    ' system (needs the extra `cluster`).',
)

# Number of jobs that take a while to begin.
_MANY = 10


def main() -> None:
  """Runs the sweep that the flags describe."""
  name, output = flags.required(flags.EXPERIMENT), flags.required(flags.OUTPUT)
  threads.use_one()
  flags.prepare()
  # Imports numerical libraries, so the number of threads has to be set first.
  from realab_suite.engine import arguments
  from realab_suite.lab.experiments import engines
  from realab_suite.lab.experiments import experiment_specs
  from realab_suite.lab.experiments import jobs
  from realab_suite.lab.experiments import scheduler
  from realab_suite.lab.experiments import storage
  from realab_suite.lab.experiments import training

  experiment = experiment_specs.load(name)
  if _ON_TASK.value is not None:
    experiment = experiment.on_task(_ON_TASK.value)
  if flags.BUDGET.value is not None:
    experiment = _in_budget(experiment, str(flags.BUDGET.value))
  folder, only = pathlib.Path(output), _RUNS.value
  seeds = (
      experiment.calibration_seeds if _CALIBRATION.value else experiment.seeds
  )
  planned = jobs.plan(experiment, seeds, only)
  storage.check_access(folder)
  unfinished = [
      job
      for job in planned
      if not (folder / job.folder() / storage.DONE).exists()
  ]
  if len(unfinished) > _MANY:
    program.say(
        f'{len(unfinished)} of {len(planned)} jobs are not finished; checking'
        ' their learners'
    )
  training.rehearse(unfinished, name, program.say)
  engine = engines.ENGINES[_ENGINE.value](
      _WORKERS.value or arguments.processors()
  )
  scheduler.sweep(
      experiment,
      folder,
      engine,
      program.say,
      only=only,
      calibration=_CALIBRATION.value,
      arguments=flags.import_arguments(),
      accept_other_code=flags.ACCEPT_OTHER_CODE.value,
  )


def _in_budget(experiment: Any, name: str) -> Any:
  """Returns the experiment in a budget, and says what that takes."""
  from realab_suite import sources
  from realab_suite.lab.experiments import budgets
  from realab_suite.lab.experiments import machines

  if _CALIBRATION.value:
    raise errors.SpecError(
        f'--budget={name}: fixes the reported seeds; allowed without'
        ' --calibration'
    )
  changed = budgets.apply(experiment, name)
  program.say(f'Budget {name}: {budgets.summary(changed)}')
  if changes := budgets.changes(experiment, name):
    words = (f'{key} {a} by {b}' for key, (a, b) in changes.items())
    program.say(f'Budget {name} replaces {", ".join(words)}')
  machine = machines.here()['processor']
  program.say(f'This machine: {machine}; code: {sources.digest()}')
  return changed


if __name__ == '__main__':
  program.start(main)
