r"""Writes a report of a sweep: a page with tables and learning curves.

  python -m realab_suite.launchers.report --input=results/paper

The files report.html, tables.csv and tables.md are written into the folder of
the sweep, or into the --output folder. The page needs no network and no other
file. The report of an unfinished sweep lists the missing jobs. With `--latex`
and `--rliable`, its figures are written for a paper as well.
"""

import pathlib

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(flags.IMPORT, flags.INPUT, flags.OUTPUT, flags.ACCEPT_OTHER_CODE)
_LATEX = absl_flags.DEFINE_boolean(
    'latex',
    False,
    'Writes report.tex as well, with methods, table, caveats and versions.',
)
_RLIABLE = absl_flags.DEFINE_boolean(
    'rliable',
    False,
    'Writes rliable.json as well, the scores of runs as rliable takes them.',
)


def main() -> None:
  """Writes the report that the flags describe."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  if problem := requirements.missing('matplotlib', 'jinja2'):
    raise errors.SpecError(f'cannot write a report: {problem}')
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import html_page
  from realab_suite.reports import latex
  from realab_suite.reports import rliable_scores

  folder_name = flags.OUTPUT.value
  output = pathlib.Path(folder_name) if folder_name else folder
  more: dict[str, html_page.View] = {}
  if _LATEX.value:
    more[latex.FILE] = latex.text
  if _RLIABLE.value:
    more[rliable_scores.FILE] = rliable_scores.text
  path = html_page.write(
      folder, output, program.say, flags.ACCEPT_OTHER_CODE.value, more
  )
  program.say(f'The report is {path}')


if __name__ == '__main__':
  program.start(main)
