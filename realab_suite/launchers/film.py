r"""Films an evaluation episode of a run: from above, and in the first person.

  python -m realab_suite.launchers.film --input=results/quick --run=reward \
    --video=reward.mp4

The input is the folder of a sweep. The episode is repeated from its recorded
actions, so the learner is not needed.
"""

import pathlib

from realab_suite import errors
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    flags.IMPORT, flags.INPUT, flags.ACCEPT_OTHER_CODE, flags.RUN, flags.VIDEO
)


def main() -> None:
  """Films the valid episode of median corruption."""
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
  replays.replay(
      run,
      row,
      lambda env, stack: stack.enter_context(films.film(env, path, name)),
  )
  program.say(f'The film {path} shows {replays.words(row)}')


if __name__ == '__main__':
  program.start(main)
