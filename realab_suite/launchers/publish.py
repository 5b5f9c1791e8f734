r"""Publishes the results of a sweep: small files that anybody can read.

  python -m realab_suite.launchers.publish --input=results/paper \
    --output=docs/results/paper

`report` and `scorecard` read the folder like that of the sweep. The tables are
Parquet files: `pandas.read_parquet('docs/results/paper/rows.parquet')`. Actions
and learners are left out, so films need the experiment again.
"""

import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.INPUT, flags.OUTPUT)


def main() -> None:
  """Publishes the sweep that the flags describe."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  output = pathlib.Path(flags.required(flags.OUTPUT))
  if problem := requirements.missing('pyarrow'):
    raise errors.SpecError(f'cannot publish results: {problem}')
  renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import publishing

  num_done, num_others = publishing.publish(folder, output)
  program.say(
      f'{num_done} finished jobs are in {output}; {num_others} are unfinished'
  )


if __name__ == '__main__':
  program.start(main)
