"""HTML page of a report, in one file without external resources.

The pictures and films are made by `page_pictures` and `page_clips`.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import resources
import os
import pathlib
from urllib import parse

import jinja2
import numpy as np
import yaml

from realab_suite import errors
from realab_suite.experiments import result_tables
from realab_suite.experiments import storage
from realab_suite.reports import caveats
from realab_suite.reports import chart_style
from realab_suite.reports import headline
from realab_suite.reports import numbers
from realab_suite.reports import page_clips
from realab_suite.reports import page_pictures
from realab_suite.reports import sweep_results
from realab_suite.reports import tables

PAGE = 'report.html'
CSV = 'tables.csv'
MARKDOWN = 'tables.md'
SEEDS_CSV = 'seeds.csv'
_TEMPLATE = 'report.html.j2'
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
  overview = tables.overview(sweep, figures)
  details = tables.tables(sweep, figures)
  cautions = caveats.caveats(sweep, figures)
  whole = _render(
      sweep, figures, top, overview, details, cautions, say, no_clips, output
  )
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  text = tables.markdown([overview, *details], cautions)
  words = _words(top)
  first = '\n\n'.join(map(tables.escaped, words))
  text = f'# {_title(sweep)}\n\n{first}\n\n{text}'
  for name, content in (
      (MARKDOWN, text),
      (CSV, tables.csv_text(figures)),
      (SEEDS_CSV, tables.seeds_csv_text(figures)),
      (PAGE, whole),
  ):
    storage.write_whole(output / name, content.encode())
  for line in words:
    say(line)
  return output / PAGE


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


def _words(top: Sequence[headline.Entry]) -> list[str]:
  """Returns the first lines of a report as texts."""
  if not top:
    return ['No learned agent has results yet.']
  return [f'{one.run}: {" ".join(one.lines)}' for one in top]


def _render(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    top: Sequence[headline.Entry],
    overview: tables.Table,
    details: Sequence[tables.Table],
    cautions: Sequence[str],
    say: _Say,
    no_clips: str | None,
    output: pathlib.Path,
) -> str:
  """Returns the page; the same inputs give the same text."""
  styles = chart_style.styles([run.name for run in sweep.learned()])
  learned = [figures[r.name] for r in sweep.learned() if r.name in figures]
  pictures: dict[str, page_pictures.Picture | None] = {
      'learning': page_pictures.learning(sweep, figures, styles),
      'plane': page_pictures.plane(sweep, figures, styles),
      'maps': page_pictures.maps(sweep, figures, styles),
  }
  say('typical episodes')
  pictures['paths'], no_paths = page_pictures.paths(learned)
  clips: list[page_clips.Clip] = []
  if no_clips is None:
    clips, no_clips = page_clips.clips(learned, say)
  film = None
  if top:
    film = next((c for c in clips if c.family == top[0].run), None)
  return _environment().get_template(_TEMPLATE).render(
      title=_title(sweep),
      description=str(sweep.experiment.get('description', '')),
      headline=top,
      film=film,
      facts=_facts(sweep),
      is_calibration=sweep.is_calibration,
      unfinished=[_unfinished(one, sweep) for one in sweep.unfinished],
      overview=overview if overview.rows else None,
      has_one_seed=any(one.summary.num_seeds == 1 for one in learned),
      tables=details,
      pictures=pictures,
      no_paths=no_paths,
      clips=[clip for clip in clips if clip is not film],
      no_clips=no_clips,
      replays=_replays(sweep, output),
      caveats=cautions,
      made_with=_made_with(sweep),
      speeds=_speeds(sweep),
      experiment=yaml.safe_dump(dict(sweep.experiment), sort_keys=False),
      designs=_designs(sweep),
      colours={name: style.colour for name, style in styles.items()},
  )  # fmt: skip


def _replays(
    sweep: sweep_results.Sweep, output: pathlib.Path
) -> list[tuple[str, str]]:
  """Returns the names and relative addresses of the replays of a sweep."""
  folder = sweep.folder / sweep_results.REPLAYS
  relative = os.path.relpath(folder.resolve(), output.resolve())
  return [
      (
          path.stem,
          parse.quote(pathlib.PurePath(relative, path.name).as_posix()),
      )
      for path in sorted(folder.glob('*.html'))
  ]


def _environment() -> jinja2.Environment:
  folder = resources.files('realab_suite.reports') / 'templates'

  def load(name: str) -> str:
    return (folder / name).read_text(encoding='utf-8')

  return jinja2.Environment(
      loader=jinja2.FunctionLoader(load),
      autoescape=True,
      undefined=jinja2.StrictUndefined,
      trim_blocks=True,
      lstrip_blocks=True,
  )


def _title(sweep: sweep_results.Sweep) -> str:
  return f'Tampering report: {sweep.experiment.get("name", sweep.folder.name)}'


def _facts(sweep: sweep_results.Sweep) -> list[tuple[str, str]]:
  """Returns names and values of the facts at the top of the page."""
  total = sum(len(run.jobs) for run in sweep.runs.values())
  experiment = sweep.experiment
  training = experiment.get('training') or {}
  evaluation = experiment.get('evaluation') or {}
  facts = [('task', str(experiment.get('task', result_tables.NOTHING)))]
  if 'steps' in training:
    lengths = [f'{training["steps"]:,} control steps per seed'] + [
        f'{run["steps"]:,} for {name}'
        for name, run in (experiment.get('runs') or {}).items()
        if run.get('steps')
    ]
    facts.append(('training', '; '.join(lengths)))
  if 'episodes' in evaluation:
    facts.append(('evaluation', f'{evaluation["episodes"]} episodes per seed'))
  facts.append(('seeds', ', '.join(map(str, sweep.seeds))))
  facts.append(('jobs', f'{total - len(sweep.unfinished)} of {total} finished'))
  return facts


def _unfinished(
    one: sweep_results.Unfinished, sweep: sweep_results.Sweep
) -> dict[str, str]:
  total = (sweep.experiment.get('training') or {}).get('steps')
  runs = sweep.experiment.get('runs') or {}
  own = (runs.get(one.job.twin_of or one.job.run) or {}).get('steps')
  total = own or total
  how_far = 'not started'
  if one.has_begun:
    how_far = 'started, not finished'
    if one.steps:
      of = f' of {total:,}' if isinstance(total, int) else ''
      how_far = f'at {one.steps:,}{of} control steps'
  return {
      'run': one.job.run,
      'seed': str(one.job.seed),
      'how_far': how_far,
  }


def _made_with(sweep: sweep_results.Sweep) -> list[tuple[str, str]]:
  """Returns names and values of versions and machines, with all variants."""
  found: dict[str, list[str]] = {}
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
        _add(found, key, value)
    for config in run.configs.values():
      for key, value in config.get('versions', {}).items():
        _add(found, key, str(value))
  return [(key, '; '.join(values)) for key, values in found.items()]


def _add(found: dict[str, list[str]], key: str, value: str) -> None:
  values = found.setdefault(key, [])
  if value not in values:
    values.append(value)


def _speeds(sweep: sweep_results.Sweep) -> list[list[str]]:
  """Returns the training time of each run, as rows of a table."""
  rows = []
  for run in sweep.runs.values():
    seconds, steps = [], []
    for lines in run.timing.values():
      if lines:
        seconds.append(sum(line['seconds'] for line in lines))
        steps.append(max(line['step'] for line in lines))
    if seconds:
      total = max(sum(seconds), 1e-9)
      rows.append(
          [
              run.name,
              f'{np.mean(seconds):,.0f}',
              f'{sum(steps) / total:,.0f}',
          ]
      )
  return rows


def _designs(sweep: sweep_results.Sweep) -> list[tuple[str, str]]:
  return [
      (name, yaml.safe_dump(dict(run.config), sort_keys=False))
      for name, run in sweep.runs.items()
      if run.is_done
  ]
