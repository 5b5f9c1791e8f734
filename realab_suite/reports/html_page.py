"""HTML page of a report: one file, beside the films of its runs."""

from collections.abc import Callable, Mapping
import pathlib
import shutil

import jinja2
import pandas as pd
import yaml

from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import study
from realab_suite.reports import caveats
from realab_suite.reports import headline
from realab_suite.reports import plots
from realab_suite.reports import report_tables
from realab_suite.reports import words

PAGE = 'report.html'
CSV = 'tables.csv'
MARKDOWN = 'tables.md'
SEEDS_CSV = 'seeds.csv'

View = Callable[[study.Study, pd.DataFrame], str]
"""Returns a judged study in another format."""


def write(
    folder: pathlib.Path,
    output: pathlib.Path,
    say: Callable[[str], None],
    accept_other_code: bool = False,
    more: Mapping[str, View] | None = None,
) -> pathlib.Path:
  """Writes the report of a sweep.

  Args:
    folder: Folder of the sweep.
    output: Folder to write into.
    say: Called with a line on each step of the work.
    accept_other_code: True to accept results of different code.
    more: Contents of files to write beside the page, by their names.

  Returns:
    The path of the page.

  Raises:
    ResultsError: If the folder does not contain a sweep, a file in it is
      damaged, a design or world is unknown, or the output cannot be written.
  """
  sweep = studies.read_sweep(folder, accept_other_code)
  judged = study.judge(sweep, say)
  wholes, runs = study.wholes(judged), sweep.without_controls
  lines = headline.headline(sweep, judged)
  page_tables = report_tables.page_tables(sweep, judged, lines)
  cautions = caveats.caveats(sweep, judged)
  title = f'Tampering report: {sweep.experiment.get("name", folder.name)}'
  colours = plots.colours([run.name for run in sweep.agents()])
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  curves = plots.learning(sweep, judged, colours)
  page = _template().render(
      title=title,
      description=sweep.experiment.get('description', ''),
      facts=_facts(sweep),
      headline=lines,
      counts={
          name: headline.counts(sweep, runs[name], wholes[name])
          for name in lines
      },
      chips={
          name: headline.chip(wholes[name], study.seeds(judged, name))
          for name in lines
      },
      films=_films(folder, sweep, output),
      rates={
          name: (wholes[name], plots.rates(judged, name, colours[name]))
          for name in lines
          if wholes[name]['hack_rate'] is not None
      },
      curves=curves,
      order=[name for name in {**lines, **curves} if name in curves],
      runs=runs,
      baselines={
          name: run.baseline
          for name, run in runs.items()
          if run.baseline in wholes
      },
      twins={
          run.family
          for run in runs.values()
          if run.role is study.Role.TWIN and run.is_done
      },
      adapted=[
          run.name
          for run in sweep.agents()
          if run.is_done and plots.has_adaptation(run)
      ],
      tables=page_tables,
      learning_note=plots.LEARNING_NOTE,
      caveats=cautions,
      is_preliminary=sweep.is_calibration or bool(caveats.awaited(sweep)),
      experiment=yaml.safe_dump(dict(sweep.experiment), sort_keys=False),
      designs={
          name: yaml.safe_dump(dict(run.config), sort_keys=False)
          for name, run in runs.items()
          if run.is_done
      },
      colours={
          name: colours[run.family]
          for name, run in runs.items()
          if run.family in colours
      },
  )
  said = [f'{run}: {" ".join(one)}' for run, one in lines.items()]
  said = said or ['No learned agent has results yet.']
  markdown = [
      f'# {title}',
      *map(tables.escaped, said),
      *(table.markdown() for table in page_tables),
      '## Limitations',
      '\n'.join(f'* {tables.escaped(caution)}' for caution in cautions),
  ]
  for name, content in (
      (MARKDOWN, '\n\n'.join(markdown) + '\n'),
      (CSV, report_tables.csv_text(sweep, judged)),
      (SEEDS_CSV, report_tables.seeds_csv_text(sweep, judged)),
      (PAGE, page),
      *((name, view(sweep, judged)) for name, view in (more or {}).items()),
  ):
    storage.write_whole(output / name, content.encode())
  for line in said:
    say(line)
  return output / PAGE


def _template() -> jinja2.Template:
  environment = jinja2.Environment(
      loader=jinja2.PackageLoader('realab_suite.reports'),
      autoescape=True,
      undefined=jinja2.StrictUndefined,
      trim_blocks=True,
      lstrip_blocks=True,
  )
  environment.filters['explained'] = words.explained
  environment.filters['picture'] = lambda canvas: plots.data_uri(
      'image/svg+xml', plots.to_svg(canvas)
  )
  return environment.get_template('report.html.j2')


def _films(
    folder: pathlib.Path, sweep: study.Study, output: pathlib.Path
) -> dict[str, str]:
  """Returns the film of each run that has one, and copies it to the page."""
  learned = sweep.agents()
  films = {}
  for run in learned:
    for name in (
        f'{run.name}.mp4',
        *([storage.FILM] if len(learned) == 1 else []),
    ):
      path = folder / name
      if path.is_file():
        films[run.name] = name
        if not output.samefile(folder):
          shutil.copyfile(path, output / name)
  return films


def _facts(sweep: study.Study) -> str:
  """Returns the line on the experiment at the top of the page."""
  experiment, awaited = sweep.experiment, caveats.awaited(sweep)
  settings = experiment['runs']
  ran = {run for run, _ in awaited}
  runs = [run for run in sweep.agents() if run.is_done or run.name in ran]
  names = [run.name for run in runs] or [*settings]
  tasks = [settings[name].get('task') or experiment['task'] for name in names]
  planned = (run.planned for run in runs or sweep.without_controls.values())
  seeds = sorted(set().union(*planned))
  shown = ', '.join(map(str, seeds))
  if len(seeds) == seeds[-1] - seeds[0] + 1 > 2:
    shown = f'{seeds[0]} to {seeds[-1]}'
  trained = ''  # Published results may be those of scripted policies alone.
  if runs:
    steps = [
        settings[run.name].get('steps') or experiment['training']['steps']
        for run in runs
    ]
    ends = dict.fromkeys([f'{min(steps):,}', f'{max(steps):,}'])
    trained = f'{" to ".join(ends)} control steps of training, '
  done = sum(len(run.configs) for run in sweep.without_controls.values())
  return (
      f'{", ".join(dict.fromkeys(tasks))}; {"seeds" if seeds[1:] else "seed"}'
      f' {shown}; {trained}{experiment["evaluation"]["episodes"]} evaluation'
      f' episodes per seed; {done} of {done + len(awaited)} jobs finished.'
  )
