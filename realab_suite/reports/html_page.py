"""HTML page of a report, in one file without external resources.

The pictures and films are made by `plots` and `page_episodes`.
"""

from collections.abc import Callable, Mapping, Sequence
import pathlib
from typing import Any

import jinja2
import numpy as np
import yaml

from realab_suite import errors
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tables
from realab_suite.reports import caveats
from realab_suite.reports import headline
from realab_suite.reports import numbers
from realab_suite.reports import page_episodes
from realab_suite.reports import plots
from realab_suite.reports import report_tables

PAGE = 'report.html'
CSV = 'tables.csv'
MARKDOWN = 'tables.md'
SEEDS_CSV = 'seeds.csv'
_Say = Callable[[str], None]


def write(
    folder: pathlib.Path,
    output: pathlib.Path,
    say: _Say,
    no_clips: str | None = None,
) -> pathlib.Path:
  """Writes the report of a sweep.

  Args:
    folder: Folder of the sweep.
    output: Folder to write into.
    say: Called with a line on each step of the work.
    no_clips: Reason to leave out the clips, or `None` to include them.

  Returns:
    The path of the page.

  Raises:
    ResultsError: If the folder does not contain a sweep, a file in it is
      damaged, a design or world is unknown, or the output cannot be written.
  """
  sweep = sweep_results.load(folder)
  _check_modules(sweep)
  figures = numbers.compute(sweep, say)
  top = headline.headline(sweep, figures)
  overview = report_tables.overview(sweep, figures)
  details = report_tables.details(figures)
  cautions = caveats.caveats(sweep, figures)
  page = _render(
      sweep, figures, output, say, no_clips,
      headline=top, overview=overview, tables=details, caveats=cautions,
  )  # fmt: skip
  words = [f'{run}: {" ".join(lines)}' for run, lines in top.items()]
  words = words or ['No learned agent has results yet.']
  limitations = [f'* {tables.escaped(caution)}' for caution in cautions]
  text = '\n\n'.join(
      [
          f'# {_title(sweep)}',
          *map(tables.escaped, words),
          *(table.markdown() for table in (overview, *details)),
          '## Limitations',
          '\n'.join(limitations),
      ]
  )
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  for name, content in (
      (MARKDOWN, f'{text}\n'),
      (CSV, report_tables.csv_text(figures)),
      (SEEDS_CSV, report_tables.seeds_csv_text(figures)),
      (PAGE, page),
  ):
    storage.write_whole(output / name, content.encode())
  for line in words:
    say(line)
  return output / PAGE


def _render(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    output: pathlib.Path,
    say: _Say,
    no_clips: str | None,
    **texts: Any,
) -> str:
  """Returns the page; the same inputs give the same text.

  Args:
    sweep: The sweep.
    figures: Figures of its runs.
    output: Folder of the page.
    say: Called with a line on each step of the work.
    no_clips: Reason to leave out the clips, or `None` to include them.
    **texts: What the page shares with the Markdown file.
  """
  learned = [figures[r.name] for r in sweep.learned() if r.name in figures]
  styles = plots.styles([run.name for run in sweep.learned()])
  pictures: dict[str, plots.Picture | None] = {
      'learning': plots.learning(sweep, figures, styles),
      'plane': plots.plane(sweep, figures, styles),
      'maps': None,
      'paths': None,
  }
  no_paths: str | None = 'published results have no actions'
  clips: list[page_episodes.Clip] = []
  if sweep.has_traces:
    pictures['maps'] = plots.maps(sweep, figures, styles)
    say('typical episodes')
    pictures['paths'], no_paths = page_episodes.paths(learned)
    if no_clips is None:
      clips, no_clips = page_episodes.clips(learned, say)
  else:
    no_clips = no_paths
  first = next(iter(texts['headline']), None)
  film = next((clip for clip in clips if clip.run == first), None)
  return _template().render(
      **texts,
      title=_title(sweep),
      description=str(sweep.experiment.get('description', '')),
      film=film,
      facts=_facts(sweep),
      is_calibration=sweep.is_calibration,
      unfinished=sweep.unfinished,
      units=_units(learned),
      pictures=pictures,
      no_paths=no_paths,
      clips=[clip for clip in clips if clip is not film],
      no_clips=no_clips,
      records=[
          table
          for table in (_made_with(sweep), _speeds(sweep))
          if not table.frame.empty
      ],
      experiment=yaml.safe_dump(dict(sweep.experiment), sort_keys=False),
      designs={
          name: yaml.safe_dump(dict(run.config), sort_keys=False)
          for name, run in sweep.runs.items()
          if run.is_done
      },
      colours={
          name: styles[sweep.family(run)].colour
          for name, run in sweep.runs.items()
          if sweep.family(run) in styles
      },
  )


def _check_modules(sweep: sweep_results.Sweep) -> None:
  """Loads what the runs name, before any work.

  Raises:
    ResultsError: If a name is unknown, for example because its module was not
      imported.
  """
  for run in sweep.learned():
    if run.is_done:
      try:
        _ = run.design, run.world.solver
      except errors.SpecError as error:
        raise errors.ResultsError(
            f'{sweep.folder}: run {run.name}: {error}; import modules of your'
            ' own with --import'
        ) from error


def _units(learned: Sequence[numbers.Figures]) -> str:
  """Returns what the intervals are over: seeds, or episodes of one seed."""
  single = {one.summary.num_seeds == 1 for one in learned}
  if single == {True}:
    return 'over the episodes of one seed'
  if True in single:
    return 'over seeds, or over episodes where there is one seed'
  return 'over seeds'


def _template() -> jinja2.Template:
  return jinja2.Environment(
      loader=jinja2.PackageLoader('realab_suite.reports'),
      autoescape=True,
      undefined=jinja2.StrictUndefined,
      trim_blocks=True,
      lstrip_blocks=True,
  ).get_template('report.html.j2')


def _title(sweep: sweep_results.Sweep) -> str:
  return f'Tampering report: {sweep.experiment.get("name", sweep.folder.name)}'


def _facts(sweep: sweep_results.Sweep) -> dict[str, str]:
  """Returns the facts at the top of the page, by their names."""
  total = sum(len(run.jobs) for run in sweep.runs.values())
  experiment = sweep.experiment
  lengths = [f'{experiment["training"]["steps"]:,} control steps per seed'] + [
      f'{run["steps"]:,} for {name}'
      for name, run in experiment['runs'].items()
      if run.get('steps')
  ]
  training = experiment['training']
  if training.get('tasks'):
    lengths.append(
        f'in {", ".join(training["tasks"])}; then'
        f' {training["adaptation"]:,} of adaptation'
    )
  return {
      'task': ', '.join(
          dict.fromkeys(
              run.get('task') or experiment['task']
              for run in experiment['runs'].values()
          )
      ),
      'training': '; '.join(lengths),
      'evaluation': f'{experiment["evaluation"]["episodes"]} episodes per seed',
      'seeds': ', '.join(map(str, sweep.seeds)),
      'jobs': f'{total - len(sweep.unfinished)} of {total} finished',
  }


def _made_with(sweep: sweep_results.Sweep) -> tables.Table:
  """Returns versions and machines, with all variants."""
  found: dict[str, dict[str, None]] = {}
  for run in sweep.runs.values():
    for row in run.rows:
      info = row.info
      dynamics = f'{info.domain}.{info.task}, version {info.dynamics_version}'
      for key, value in (
          ('dynamics', f'{dynamics}, digest {info.dynamics_digest}'),
          ('isolation', info.isolation),
          ('machine', info.platform),
          *info.versions.items(),
      ):
        found.setdefault(key, {})[value] = None
    for config in run.configs.values():
      for key, value in config.get('versions', {}).items():
        found.setdefault(key, {})[str(value)] = None
  frame = tables.frame(
      {'item': key, 'value': '; '.join(values)} for key, values in found.items()
  )
  return tables.Table('Versions and machine', '', frame, list(frame))


def _speeds(sweep: sweep_results.Sweep) -> tables.Table:
  """Returns the training time of each run."""
  records = []
  for run in sweep.runs.values():
    if lines := [points for points in run.timing.values() if points]:
      seconds = [sum(point['seconds'] for point in points) for points in lines]
      steps = sum(max(point['step'] for point in points) for points in lines)
      records.append(
          {
              'run': run.name,
              'seconds per seed': f'{np.mean(seconds):,.0f}',
              'control steps per second': (
                  f'{steps / max(sum(seconds), 1e-9):,.0f}'
              ),
          }
      )
  return tables.Table('Training time', '', tables.frame(records))
