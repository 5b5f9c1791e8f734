r"""Packs the finished jobs of a sweep into one file, to be published.

  python -m realab_suite.launchers.pack --input=results/paper \
    --output=docs/results/paper.zip

The file has all that `report` needs. `unpack` makes the folder of a sweep from
it, and `sweep` continues there without training the jobs again. The same
results give the same bytes.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.INPUT, flags.OUTPUT)

_LEARNERS = absl_flags.DEFINE_boolean(
    'learners', False, 'Includes trained learners, about 3 MB each.'
)


def main() -> None:
  """Packs the sweep that the flags describe."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  output = pathlib.Path(flags.required(flags.OUTPUT))
  renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import packing

  num_done, num_others = packing.pack(folder, output, learners=_LEARNERS.value)
  program.say(
      f'{num_done} finished jobs are in {output}; {num_others} are unfinished'
  )


if __name__ == '__main__':
  program.start(main)
