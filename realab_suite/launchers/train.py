r"""Trains and evaluates one run of an experiment, with one seed.

  python -m realab_suite.launchers.train --experiment=quick --run=reward \
    --seed=0 --output=results/quick

The same command continues an interrupted run from its last checkpoint. `sweep`
executes all runs of an experiment.
"""

from collections.abc import Sequence
import pathlib

from absl import flags

from realab_suite.experiments import threads
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import learning_flags
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import run_flag
from realab_suite.launchers.flags import seed_flag

flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(learning_flags)
flags.adopt_module_key_flags(output_flag)
flags.adopt_module_key_flags(run_flag)
flags.adopt_module_key_flags(seed_flag)
_PARENT = flags.DEFINE_integer(
    'parent', None, 'Process whose end also ends the run; used by sweeps.'
)


def main(argv: Sequence[str]) -> None:
  """Executes the run that the flags describe."""
  del argv
  output = program.required(
      output_flag.OUTPUT, '; name a folder for the results'
  )
  name = program.required(learning_flags.EXPERIMENT)
  run = program.required(
      run_flag.RUN, '; name one run of the experiment; `sweep` executes all'
  )
  # NumPy and JAX read these settings once, when they are imported.
  threads.use_one()
  renderers.render_on_demand()
  from realab_suite.experiments import experiment_specs
  from realab_suite.experiments import jobs
  from realab_suite.experiments import training

  imports_flag.load()
  [job] = jobs.plan(experiment_specs.load(name), [seed_flag.SEED.value], [run])
  options = training.Options(
      program.say, learning_flags.TENSORBOARD.value, _PARENT.value
  )
  training.run(job, pathlib.Path(output), options)


if __name__ == '__main__':
  program.start(main)
