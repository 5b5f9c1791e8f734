r"""Writes a report of a sweep: a page with tables, curves, plots and clips.

  python -m realab_suite.launchers.report --input=results/paper

The files report.html, tables.csv and tables.md are written into the folder of
the sweep, or into the --output folder. The page needs no network and no other
file. The report of an unfinished sweep lists the missing jobs.
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
from realab_suite.launchers.flags import output_flag

flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(input_flag)
flags.adopt_module_key_flags(output_flag)
_CLIPS = flags.DEFINE_boolean(
    'clips', True, 'Films a typical episode of each design.'
)


def main(argv: Sequence[str]) -> None:
  """Writes the report that the flags describe."""
  del argv
  folder = pathlib.Path(program.required(input_flag.INPUT))
  if problem := requirements.missing('matplotlib', 'jinja2'):
    raise errors.SpecError(f'cannot write a report: {problem}')
  no_clips = _why_no_clips()
  if no_clips is not None:
    renderers.render_on_demand()
    program.say(f'clips are skipped: {no_clips}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import html_page

  imports_flag.load()
  chosen = output_flag.OUTPUT.value
  output = pathlib.Path(chosen) if chosen else folder
  path = html_page.write(folder, output, program.say, no_clips)
  program.say(f'The report is {path}')


def _why_no_clips() -> str | None:
  if not _CLIPS.value:
    return 'turned off by --noclips'
  return (
      requirements.missing('imageio', 'av', 'PIL')
      or renderers.choose_renderer()
  )


if __name__ == '__main__':
  program.start(main)
