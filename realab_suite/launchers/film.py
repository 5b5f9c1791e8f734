r"""Films an evaluation episode of a run: from above, and in the first person.

  python -m realab_suite.launchers.film --input=results/quick --run=reward \
    --video=reward.mp4

It is the valid episode of median corruption, or that of --episode. The input is
the folder of a sweep. The episode is repeated from its recorded actions, so the
learner is not needed.
"""

import pathlib
from typing import TYPE_CHECKING

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    flags.IMPORT, flags.INPUT, flags.ACCEPT_OTHER_CODE, flags.RUN, flags.VIDEO
)

if TYPE_CHECKING:
  from realab_suite.evaluation import results
  from realab_suite.lab.verdicts import study

_EPISODE = absl_flags.DEFINE_list(
    'episode',
    None,
    'Seed, world and episode, such as 1000000,36,0. Default: the episode of'
    ' median corruption.',
)


def main() -> None:
  """Films an episode."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  name = flags.required(flags.RUN, '; name a run of the sweep')
  path = flags.required(flags.VIDEO, '; name a new .mp4 or .webp file')
  if problem := renderers.why_no_film():
    raise errors.ResultsError(f'cannot make a film: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import replays
  from realab_suite.lab.experiments import studies
  from realab_suite.reports import films

  flags.load_imports()
  run = flags.find_run(
      studies.read_sweep(folder, flags.ACCEPT_OTHER_CODE.value).without_controls
  )
  row = replays.typical_row(run)
  if row is None:
    raise errors.ResultsError(f'{folder}: run {name} has no valid episode yet')
  if _EPISODE.value is not None:
    row = _named(run, ','.join(_EPISODE.value))
  replays.replay(
      run,
      row,
      lambda env, stack: stack.enter_context(films.film(env, path, name)),
  )
  program.say(f'The film {path} shows {replays.words(row)}')


def _named(run: 'study.Run', key: str) -> 'results.EpisodeResult':
  """Returns the episode that --episode names.

  Raises:
    SpecError: If the run has none of this name.
  """
  ordered = sorted(run.rows, key=lambda row: row.key)
  rows = {','.join(map(str, row.key)): row for row in ordered}
  if key not in rows:
    first, *_, last = rows
    raise errors.SpecError(
        f'--episode={key}: no evaluation episode of {run.name}; must be one of'
        f' its {len(rows)}, from {first} to {last}'
    )
  return rows[key]


if __name__ == '__main__':
  program.start(main)
