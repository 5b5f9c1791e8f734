r"""Replays evaluation episodes of a run in 3D, in pages that open offline.

  python -m realab_suite.launchers.replay --input=results/quick --run=reward

The input is the folder of a sweep. Each page is one HTML file in its folder
`replays`: the scene with a free camera or in the first person, above a time
line of the returns, the writes, the readings, the corruption and the contacts.
A report of the sweep that is written afterwards links to the pages.
"""

import pathlib
import re

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.IMPORT, flags.INPUT, flags.OUTPUT, flags.RUN)

_EPISODE = absl_flags.DEFINE_string(
    'episode',
    'typical',
    'Episode to replay: "typical" (median corruption), "all", or its seed,'
    ' world and number, such as 10000,3,0.',
)


def main() -> None:
  """Writes the pages that the flags describe."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  name = flags.required(flags.RUN, '; name a run of the sweep')
  if problem := requirements.missing('viser', 'mjviser', extra='browser'):
    raise errors.ResultsError(f'cannot write a replay: {problem}')
  renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import replay_pages
  from realab_suite.reports import replays
  from realab_suite.reports import sweep_results

  flags.load_imports()
  run = flags.find_run(sweep_results.load(folder).runs)
  if _EPISODE.value == 'typical':
    typical = replays.typical_row(run) or replays.first_row(run)
    rows = [] if typical is None else [typical]
  else:
    rows = [row for row in run.rows if row.is_valid and _is_chosen(row)]
  if not rows:
    raise errors.ResultsError(
        f'{folder}: run {name} has no valid episode {_EPISODE.value!r}; allowed'
        ' are typical, all, and seed,world,episode of a finished job'
    )
  output = flags.OUTPUT.value
  pages = pathlib.Path(output) if output else folder / sweep_results.REPLAYS
  for row in rows:
    path = replay_pages.write(run, row, pages)
    program.say(f'The replay is {path}')


def _is_chosen(row: results.EpisodeRow) -> bool:
  if _EPISODE.value == 'all':
    return True
  if re.fullmatch('[0-9]+,[0-9]+,[0-9]+', _EPISODE.value) is None:
    raise errors.SpecError(
        f'--episode={_EPISODE.value:.40}: allowed are typical, all, and numbers'
        ' of seed, world and episode such as 10000,3,0'
    )
  return _EPISODE.value == f'{row.seed},{row.world},{row.episode}'


if __name__ == '__main__':
  program.start(main)
