"""HTML page of a report, in one file without external resources."""

from collections.abc import Callable
import pathlib

import jinja2
import yaml

from realab_suite.lab.experiments import result_folders
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tables
from realab_suite.reports import caveats
from realab_suite.reports import headline
from realab_suite.reports import numbers
from realab_suite.reports import plots
from realab_suite.reports import report_tables

PAGE = 'report.html'
CSV = 'tables.csv'
MARKDOWN = 'tables.md'
SEEDS_CSV = 'seeds.csv'


def write(
    folder: pathlib.Path,
    output: pathlib.Path,
    say: Callable[[str], None],
    accept_other_code: bool = False,
) -> pathlib.Path:
  """Writes the report of a sweep.

  Args:
    folder: Folder of the sweep.
    output: Folder to write into.
    say: Called with a line on each step of the work.
    accept_other_code: True to accept results of different code.

  Returns:
    The path of the page.

  Raises:
    ResultsError: If the folder does not contain a sweep, a file in it is
      damaged, a design or world is unknown, or the output cannot be written.
  """
  sweep = result_folders.load(folder, accept_other_code)
  figures = numbers.compute(sweep, say)
  page_tables = report_tables.page_tables(figures)
  lines = headline.headline(sweep, figures)
  cautions = caveats.caveats(sweep, figures)
  title = f'Tampering report: {sweep.experiment.get("name", folder.name)}'
  colours = plots.colours([run.name for run in sweep.learned()])
  chart = plots.learning(sweep, figures, colours)
  picture = chart and plots.data_uri('image/svg+xml', plots.to_svg(chart))
  page = _template().render(
      title=title,
      description=sweep.experiment.get('description', ''),
      facts=_facts(sweep),
      headline=lines,
      tables=page_tables,
      learning=picture,
      learning_note=plots.LEARNING_NOTE,
      caveats=cautions,
      is_preliminary=sweep.is_calibration or bool(sweep.unfinished),
      experiment=yaml.safe_dump(dict(sweep.experiment), sort_keys=False),
      designs={
          name: yaml.safe_dump(dict(run.config), sort_keys=False)
          for name, run in sweep.runs.items()
          if run.is_done
      },
      colours={
          name: colours[sweep.family(run)]
          for name, run in sweep.runs.items()
          if sweep.family(run) in colours
      },
  )
  words = [f'{run}: {" ".join(said)}' for run, said in lines.items()]
  words = words or ['No learned agent has results yet.']
  markdown = [
      f'# {title}',
      *map(tables.escaped, words),
      *(table.markdown() for table in page_tables),
      '## Limitations',
      '\n'.join(f'* {tables.escaped(caution)}' for caution in cautions),
  ]
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  for name, content in (
      (MARKDOWN, '\n\n'.join(markdown) + '\n'),
      (CSV, report_tables.csv_text(figures)),
      (SEEDS_CSV, report_tables.seeds_csv_text(figures)),
      (PAGE, page),
  ):
    storage.write_whole(output / name, content.encode())
  for line in words:
    say(line)
  return output / PAGE


def _template() -> jinja2.Template:
  return jinja2.Environment(
      loader=jinja2.PackageLoader('realab_suite.reports'),
      autoescape=True,
      undefined=jinja2.StrictUndefined,
      trim_blocks=True,
      lstrip_blocks=True,
  ).get_template('report.html.j2')


def _facts(sweep: sweep_results.Sweep) -> str:
  """Returns the line on the experiment at the top of the page."""
  experiment = sweep.experiment
  tasks = dict.fromkeys(
      run.get('task') or experiment['task']
      for run in experiment['runs'].values()
  )
  total = sum(len(run.jobs) for run in sweep.runs.values())
  return (
      f'{", ".join(tasks)}; seeds {", ".join(map(str, sweep.seeds))};'
      f' {experiment["training"]["steps"]:,} control steps of training,'
      f' {experiment["evaluation"]["episodes"]} evaluation episodes per seed;'
      f' {total - len(sweep.unfinished)} of {total} jobs finished.'
  )
