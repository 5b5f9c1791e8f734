r"""Films an evaluation episode of a run: from above, and in the first person.

  python -m realab_suite.launchers.film --input=results/quick --run=reward \
    --video=reward.mp4

The input is the folder of a sweep. The episode is repeated from its recorded
actions, so the learner is not needed.
"""

from collections.abc import Sequence
import pathlib

from absl import flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import input_flag
from realab_suite.launchers.flags import run_flag
from realab_suite.launchers.flags import video_flag

flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(input_flag)
flags.adopt_module_key_flags(run_flag)
flags.adopt_module_key_flags(video_flag)


def main(argv: Sequence[str]) -> None:
  """Films the valid episode of median corruption."""
  del argv
  folder = pathlib.Path(program.required(input_flag.INPUT))
  name = program.required(run_flag.RUN, '; name a run of the sweep')
  path = program.required(video_flag.VIDEO, '; name a new .mp4 or .webp file')
  problem = (
      requirements.missing('imageio', 'av', 'PIL')
      or renderers.choose_renderer()
  )
  if problem is not None:
    raise errors.ResultsError(f'cannot make a film: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import films
  from realab_suite.reports import replays
  from realab_suite.reports import sweep_results

  imports_flag.load()
  run = run_flag.find(name, sweep_results.load(folder).runs, folder)
  row = replays.typical_row(run)
  if row is None:
    raise errors.ResultsError(f'{folder}: run {name} has no valid episode yet')
  replays.replay(
      run,
      row,
      lambda env, stack: stack.enter_context(
          films.Film(env, path, name, tuple(films.WIDTHS))
      ).add,
  )
  program.say(
      f'The film of seed {row.seed}, world {row.world}, episode {row.episode}'
      f' is {path}'
  )


if __name__ == '__main__':
  program.start(main)
