r"""Trains and evaluates one run of an experiment, with one seed.

  python -m realab_suite.launchers.train --experiment=quick --run=reward \
    --seed=0 --output=results/quick

The same command continues an interrupted run from its last checkpoint. `sweep`
executes all runs of an experiment.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    flags.IMPORT,
    flags.EXPERIMENT,
    flags.RUN,
    flags.SEED,
    flags.OUTPUT,
    flags.ACCEPT_OTHER_CODE,
)

_PARENT = absl_flags.DEFINE_integer(
    'parent', None, 'Process whose end also ends the run; used by sweeps.'
)
_CODE = absl_flags.DEFINE_string(
    'code', None, 'Digest of the sources of the sweep; used by sweeps.'
)
_PLANNED = absl_flags.DEFINE_string(
    'planned', None, 'Name of the folder of the run; used by sweeps.'
)


def main() -> None:
  """Executes the run that the flags describe."""
  output = flags.required(flags.OUTPUT, '; name a folder for the results')
  name = flags.required(flags.EXPERIMENT)
  run = flags.required(
      flags.RUN, '; name one run of the experiment; `sweep` executes all'
  )
  # NumPy and JAX read these settings once, when they are imported.
  threads.use_one()
  from realab_suite.lab.experiments import machines  # Imports NumPy.

  machines.keep_compiled(pathlib.Path(output))
  flags.prepare()
  from realab_suite.lab.experiments import experiment_specs
  from realab_suite.lab.experiments import jobs
  from realab_suite.lab.experiments import training

  experiment, folder = experiment_specs.load(name), pathlib.Path(output)
  [job] = jobs.plan(experiment, [flags.SEED.value], [run])
  training.check_learners([job], name)
  if _PLANNED.value not in (None, job.folder()):
    raise errors.ResultsError(
        f'{folder}: {_PLANNED.value} was planned, and {job.folder()} would be'
        ' run; a file that the design names, or a version, is another one here'
        ' than in the sweep; start the sweep again'
    )
  seeds = *experiment.seeds, *experiment.calibration_seeds
  is_accepted = flags.ACCEPT_OTHER_CODE.value
  planned = jobs.plan(experiment, seeds)
  jobs.check_codes([job, *planned], folder, is_accepted, _CODE.value)
  options = training.Options(program.say, _PARENT.value, is_accepted)
  training.run(job, folder, options)


if __name__ == '__main__':
  program.start(main)
