r"""Exports evaluation episodes of a run of a sweep as data.

  python -m realab_suite.launchers.export --input=results/paper --run=reward \
    --output=results/data --episodes=20

The folder gets the data of the agent, and the true columns in separate files of
the evaluator (docs/doors.md). The episodes are repeated from their recorded
actions, so the learner is not needed. `label` makes a dataset of several runs.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(
    flags.IMPORT,
    flags.INPUT,
    flags.ACCEPT_OTHER_CODE,
    flags.OUTPUT,
    flags.RUN,
    flags.EPISODES,
)

_FORMAT = absl_flags.DEFINE_string(
    'format', 'parquet', "Format of the agent's data: parquet or minari."
)


def main() -> None:
  """Exports the episodes that the flags name."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  flags.required(flags.RUN, '; name a run of the sweep')
  output = pathlib.Path(flags.required(flags.OUTPUT, '; name a new folder'))
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.doors.data import export
  from realab_suite.doors.data import sources
  from realab_suite.lab.experiments import studies

  export.check(_FORMAT.value, output)
  run = flags.find_run(
      studies.read_sweep(folder, flags.ACCEPT_OTHER_CODE.value).without_controls
  )
  export.export(
      sources.of_run(run, flags.num_episodes()),
      output,
      data_format=_FORMAT.value,
      say=program.say,
  )
  program.say(f'The dataset is in {output}')


if __name__ == '__main__':
  program.start(main)
