r"""Trains and evaluates one run of an experiment, with one seed.

  python -m realab_suite.launchers.train --experiment=quick --run=reward \
    --seed=0 --output=results/quick

The same command continues an interrupted run from its last checkpoint. `sweep`
executes all runs of an experiment.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite.lab.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    flags.IMPORT,
    flags.EXPERIMENT,
    flags.RUN,
    flags.SEED,
    flags.OUTPUT,
)

_PARENT = absl_flags.DEFINE_integer(
    'parent', None, 'Process whose end also ends the run; used by sweeps.'
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
  flags.prepare()
  from realab_suite.lab.experiments import experiment_specs
  from realab_suite.lab.experiments import jobs
  from realab_suite.lab.experiments import training

  [job] = jobs.plan(experiment_specs.load(name), [flags.SEED.value], [run])
  training.check_learners([job], name)
  options = training.Options(program.say, _PARENT.value)
  training.run(job, pathlib.Path(output), options)


if __name__ == '__main__':
  program.start(main)
