r"""Unpacks the jobs of a packed sweep into the folder of a sweep.

  python -m realab_suite.launchers.unpack --input=docs/results/paper_near.zip \
    --output=results/paper_near

The folder is new, or that of a sweep of the same experiment, which gets the
jobs that it lacks. Every file is verified before anything is written.
"""

import pathlib

from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.INPUT, flags.OUTPUT)


def main() -> None:
  """Unpacks the file that the flags name."""
  path = pathlib.Path(flags.required(flags.INPUT))
  output = pathlib.Path(flags.required(flags.OUTPUT))
  renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import packing

  num_new, num_there = packing.unpack(path, output)
  program.say(
      f'{num_new} jobs were added to {output}; {num_there} were there already'
  )


if __name__ == '__main__':
  program.start(main)
