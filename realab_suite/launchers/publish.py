r"""Publishes the results of a sweep: small files that anybody can read.

  python -m realab_suite.launchers.publish --input=results/paper \
    --output=docs/results/paper

`report` and `scorecard` read the folder like that of the sweep. The tables are
Parquet files: `pandas.read_parquet('docs/results/paper/rows.parquet')`. Actions
and learners are left out, so films need the experiment again.

  python -m realab_suite.launchers.publish --input=results/mine \
    --entry=entries/realab-1M/mine

adds the policies of the learners to a sweep with this --budget, for `check`.
"""

import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(flags.IMPORT, flags.INPUT, flags.OUTPUT, flags.ENTRY)


def main() -> None:
  """Publishes the sweep that the flags describe."""
  folder = pathlib.Path(
      flags.required(
          flags.INPUT,
          '; must be the folder of a sweep, with --output or --entry for a new'
          ' folder',
      )
  )
  if (flags.OUTPUT.value is None) == (flags.ENTRY.value is None):
    given = 'both missing' if flags.ENTRY.value is None else 'both given'
    raise errors.SpecError(f'--output, --entry: {given}; must be one of them')
  output = pathlib.Path(flags.OUTPUT.value or flags.ENTRY.value)
  if problem := requirements.missing('pyarrow'):
    raise errors.SpecError(f'cannot publish results: {problem}')
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import entries
  from realab_suite.lab.experiments import publishing

  room = publishing if flags.ENTRY.value is None else entries
  num_done, num_others = room.publish(folder, output)
  program.say(
      f'{num_done} finished jobs are in {output}; {num_others} are unfinished'
  )


if __name__ == '__main__':
  program.start(main)
