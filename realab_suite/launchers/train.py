r"""Trains and judges one run of an experiment, with one seed.

  python -m realab_suite.launchers.train --experiment=quick --run=reward \
    --seed=0 --output=results/quick

A run that was killed continues where it stopped. `sweep` does all runs of an
experiment.
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
from realab_suite.launchers.flags import seed_flag

flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(learning_flags)
flags.adopt_module_key_flags(output_flag)
flags.adopt_module_key_flags(seed_flag)
_RUN = flags.DEFINE_string(
    'run',
    None,
    'Which run of an experiment, as in "reward", "reward.secure" (its twin) or'
    ' "reward.random" (a baseline).',
)
_PARENT = flags.DEFINE_integer(
    'parent', None, 'Ends the run when this process is gone; for sweeps.'
)


def main(argv: Sequence[str]) -> None:
  """Does the run that the flags name."""
  del argv
  output = program.required(
      output_flag.OUTPUT, '; name a folder for the results'
  )
  name = program.required(learning_flags.EXPERIMENT)
  run = program.required(
      _RUN, '; name one run of the experiment; `sweep` does all'
  )
  # Before numpy and JAX are imported, which look once.
  threads.use_one()
  renderers.render_nothing()
  from realab_suite.experiments import experiment_specs
  from realab_suite.experiments import jobs
  from realab_suite.experiments import training

  imports_flag.load()
  [job] = jobs.plan(experiment_specs.load(name), [seed_flag.SEED.value], [run])
  options = training.Options(
      program.say,
      learning_flags.TENSORBOARD.value,
      _PARENT.value,
      learning_flags.OTHER_MACHINE.value,
  )
  training.run(job, pathlib.Path(output), options)


if __name__ == '__main__':
  program.start(main)
