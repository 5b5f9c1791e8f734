r"""Writes a report of a sweep: a page with tables and learning curves.

  python -m realab_suite.launchers.report --input=results/paper

The files report.html, tables.csv and tables.md are written into the folder of
the sweep, or into the --output folder. The page needs no network and no other
file. The report of an unfinished sweep lists the missing jobs.
"""

import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program

flags.take(flags.IMPORT, flags.INPUT, flags.OUTPUT, flags.ACCEPT_OTHER_CODE)


def main() -> None:
  """Writes the report that the flags describe."""
  folder = pathlib.Path(flags.required(flags.INPUT))
  if problem := requirements.missing('matplotlib', 'jinja2'):
    raise errors.SpecError(f'cannot write a report: {problem}')
  flags.prepare()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.reports import html_page

  folder_name = flags.OUTPUT.value
  output = pathlib.Path(folder_name) if folder_name else folder
  path = html_page.write(
      folder, output, program.say, flags.ACCEPT_OTHER_CODE.value
  )
  program.say(f'The report is {path}')


if __name__ == '__main__':
  program.start(main)
