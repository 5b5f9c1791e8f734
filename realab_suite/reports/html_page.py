"""The page of a report: everything that a sweep shows, in one file."""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
import contextlib
import dataclasses
from importlib import resources
import math
import pathlib
import tempfile
from typing import Any, final

import jinja2
import numpy as np
import yaml

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.evaluation import signed_corruption
from realab_suite.experiments import result_tables
from realab_suite.experiments import storage
from realab_suite.experiments import tracking
from realab_suite.reports import caveats
from realab_suite.reports import charts
from realab_suite.reports import numbers
from realab_suite.reports import plots
from realab_suite.reports import replays
from realab_suite.reports import sweep_results
from realab_suite.reports import tables

PAGE = 'report.html'
CSV = 'tables.csv'
MARKDOWN = 'tables.md'
_TEMPLATE = 'report.html.j2'

_Say = Callable[[str], None]
# Of each seed, a figure by the number of control steps.
_Curves = Mapping[int, Mapping[int, float]]


@final
@dataclasses.dataclass(frozen=True)
class Picture:
  """A picture in the page.

  Attributes:
    title: What it shows.
    note: How to read it.
    uri: The picture itself.
  """

  title: str
  note: str
  uri: str


@final
@dataclasses.dataclass(frozen=True)
class Clip:
  """A film in the page.

  Attributes:
    family: The design that it belongs to.
    title: What it shows.
    note: The figures of the episode.
    uri: The film itself.
    poster: Its last frame, for paper.
  """

  family: str
  title: str
  note: str
  uri: str
  poster: str


def write(
    folder: pathlib.Path,
    output: pathlib.Path,
    say: _Say,
    no_clips: str | None = None,
) -> pathlib.Path:
  """Writes the report of a sweep.

  Args:
    folder: The folder of the sweep.
    output: The folder to write into.
    say: Called with what a person wants to read.
    no_clips: Why there are to be no clips, or `None` if there are.

  Returns:
    The page.

  Raises:
    ResultsError: If the folder is none of a sweep, a file in it is damaged, or
      nothing can be written.
  """
  sweep = sweep_results.load(folder)
  figures = numbers.compute(sweep, say)
  incentive = {}
  for name, one in figures.items():
    if not one.run.is_scripted:
      say(f'{name}: incentive to tamper')
      incentive[name] = numbers.incentives_of(one.run)
  overview = tables.overview(sweep, figures)
  details = tables.tables(sweep, figures, incentive)
  cautions = caveats.caveats(sweep, figures)
  whole = _render(sweep, figures, overview, details, cautions, say, no_clips)
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  text = tables.markdown([overview, *details], cautions)
  text = f'# {_title(sweep)}\n\n{text}'
  storage.write_whole(output / MARKDOWN, text.encode())
  csv = tables.csv_text(figures, incentive)
  storage.write_whole(output / CSV, csv.encode())
  storage.write_whole(output / PAGE, whole.encode())
  return output / PAGE


def _render(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    overview: tables.Table,
    details: Sequence[tables.Table],
    cautions: Sequence[str],
    say: _Say,
    no_clips: str | None,
) -> str:
  """Returns the page; the same inputs give the same text."""
  looks = charts.styles([run.name for run in sweep.learned()])
  learned = [figures[r.name] for r in sweep.learned() if r.name in figures]
  pictures: dict[str, Picture | None] = {
      'learning': _learning(sweep, figures, looks),
      'plane': _plane(sweep, figures, looks),
      'maps': _maps(sweep, figures, looks),
  }
  say('typical episodes')
  pictures['paths'], no_paths = _paths(learned)
  clips: list[Clip] = []
  if no_clips is None:
    clips, no_clips = _clips(learned, say)
  return _environment().get_template(_TEMPLATE).render(
      title=_title(sweep),
      description=str(sweep.experiment.get('description', '')),
      facts=_facts(sweep),
      is_calibration=sweep.is_calibration,
      unfinished=[_unfinished(one, sweep) for one in sweep.unfinished],
      overview=overview if overview.rows else None,
      has_one_seed=any(one.summary.num_seeds == 1 for one in learned),
      tables=details,
      pictures=pictures,
      no_paths=no_paths,
      clips=clips,
      no_clips=no_clips,
      caveats=cautions,
      made_with=_made_with(sweep),
      speeds=_speeds(sweep),
      experiment=yaml.safe_dump(dict(sweep.experiment), sort_keys=False),
      designs=_designs(sweep),
      colours={name: look.colour for name, look in looks.items()},
  )  # fmt: skip


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
  return f'Who tampers: {sweep.experiment.get("name", sweep.folder.name)}'


def _facts(sweep: sweep_results.Sweep) -> list[tuple[str, str]]:
  """Returns what the top of the page says of the experiment."""
  total = sum(len(run.jobs) for run in sweep.runs.values())
  experiment = sweep.experiment
  training = experiment.get('training') or {}
  evaluation = experiment.get('evaluation') or {}
  facts = [('world', str(experiment.get('task', result_tables.NOTHING)))]
  if 'steps' in training:
    lengths = [f'{training["steps"]:,} control steps per seed'] + [
        f'{run["steps"]:,} of {name}'
        for name, run in (experiment.get('runs') or {}).items()
        if run.get('steps')
    ]
    facts.append(('training', '; '.join(lengths)))
  if 'episodes' in evaluation:
    facts.append(('judged by', f'{evaluation["episodes"]} episodes per seed'))
  facts.append(('seeds', ', '.join(map(str, sweep.seeds))))
  facts.append(('jobs', f'{total - len(sweep.unfinished)} of {total} are over'))
  return facts


def _unfinished(
    one: sweep_results.Unfinished, sweep: sweep_results.Sweep
) -> dict[str, str]:
  total = (sweep.experiment.get('training') or {}).get('steps')
  runs = sweep.experiment.get('runs') or {}
  own = (runs.get(one.job.twin_of or one.job.run) or {}).get('steps')
  total = own or total
  how_far = 'not begun'
  if one.has_begun:
    how_far = 'begun, and not over'
    if one.steps:
      of = f' of {total:,}' if isinstance(total, int) else ''
      how_far = f'at {one.steps:,}{of} control steps'
  return {
      'run': one.job.run,
      'seed': str(one.job.seed),
      'how_far': how_far,
  }


# ---- Pictures ----------------------------------------------------------------


def _learning(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    looks: Mapping[str, charts.Style],
) -> Picture | None:
  designs = []
  for run in sweep.learned():
    twin = sweep.twin(run)
    both = {'run': run} | ({'twin': twin} if twin is not None else {})
    done = {whose: one for whose, one in both.items() if one.is_done}
    if not done:
      continue
    baseline = figures.get(run.baseline or '')
    designs.append(
        charts.Learning(
            run.name,
            _bands(done, lambda run, point: point['true_return'], _returns),
            _bands(done, lambda run, point: point['observed_return']),
            _bands(done, _signed_metres),
            baseline and baseline.summary.true_return.estimate,
        )
    )
  if not designs:
    return None
  return Picture(
      'While they learned',
      'Means over the episodes of training that ended since the last point;'
      ' between two points every world had time for an episode.'
      ' Signed corruption is that of the registers whose reading the learner'
      ' maximises, where above zero is the direction that pays, or of all its'
      ' feedback registers if it maximises none. Observed returns are in each'
      " register's own units. Steps in which less than half of the worlds"
      ' ended an episode are left out.',
      _svg(charts.draw_learning(designs, looks, sweep.margin)),
  )


def _bands(
    runs: Mapping[str, sweep_results.Run],
    figure: Callable[[sweep_results.Run, Mapping[str, Any]], float | None],
    bounds: Callable[[sweep_results.Run, _Curves], intervals.Bounds] = (
        lambda run, curves: intervals.UNBOUNDED
    ),
) -> dict[str, charts.Band]:
  bands = {}
  for whose, run in runs.items():
    curves = {
        seed: _curve(run, curve, figure) for seed, curve in run.curves.items()
    }
    bands[whose] = charts.band(curves, bounds(run, curves))
  return bands


def _returns(run: sweep_results.Run, curves: _Curves) -> intervals.Bounds:
  """Returns the possible true returns of a run."""
  means = [value for curve in curves.values() for value in curve.values()]
  return comparison.return_bounds(run.rows, means)


def _curve(
    run: sweep_results.Run,
    points: Sequence[Mapping[str, Any]],
    figure: Callable[[sweep_results.Run, Mapping[str, Any]], float | None],
) -> dict[int, float]:
  """Returns a figure by the number of control steps."""
  # All worlds begin at once, so for a while their episodes end at once, too. A
  # step goes by before the next ones begin.
  num_envs = run.config['training']['num_envs']
  return charts.curve(
      [
          (p['step'], p['num_episodes'] - p['num_invalid'], figure(run, p))
          for p in points
      ],
      width=num_envs * (run.config['max_steps'] + 1),
      fewest=-(-num_envs // 2),
  )


def _signed_metres(
    run: sweep_results.Run, point: Mapping[str, Any]
) -> float | None:
  names = signed_corruption.paying_registers(run.design)
  names = names or tuple(run.design.names('feedback'))
  values = [
      value
      for name in names
      if (register := point['registers'].get(name)) is not None
      and (value := register['corruption_signed_metres']) is not None
  ]
  return sum(values) / len(values) if values else None


def _plane(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    looks: Mapping[str, charts.Style],
) -> Picture | None:
  points = []
  for name, one in figures.items():
    family = sweep.family(one.run)
    if one.summary.corruption is None or family not in looks:
      continue
    is_baseline = any(o.run.baseline == name for o in figures.values())
    if one.run.is_scripted and not is_baseline:
      continue
    kind = 'baseline' if is_baseline else 'twin' if one.run.twin_of else 'run'
    points.append(
        charts.Point(
            name,
            family,
            kind,
            _by_seed(one.run.rows),
            one.summary.corruption,
            one.summary.true_return,
        )
    )
  if not points:
    return None
  return Picture(
      'True return against corruption',
      'Small marks are seeds, large ones means with 95 % intervals. To the'
      ' right and low: it tampers. To the left and low: it is less able.'
      ' To the left and high is where a design should be. In the grey strip,'
      ' corruption is too small to matter.',
      _svg(charts.draw_plane(points, looks, sweep.margin)),
  )


def _by_seed(
    rows: Iterable[results.EpisodeRow],
) -> list[tuple[float, float]]:
  seeds: dict[int, list[tuple[float, float]]] = {}
  for row in rows:
    if row.counts and not math.isnan(row.corruption):
      pair = (row.corruption, row.true_return)
      seeds.setdefault(row.seed, []).append(pair)
  means = [np.mean(pairs, axis=0) for pairs in seeds.values()]
  return [(float(x), float(y)) for x, y in means]


def _maps(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    looks: Mapping[str, charts.Style],
) -> Picture | None:
  maps = []
  for name, one in figures.items():
    run = one.run
    if run.is_scripted or not run.design.registers:
      continue
    sizes = [r.block_size for r in run.design.registers.values()]
    maps.append(
        charts.Map(
            name,
            sweep.family(run),
            run.twin_of is not None,
            _ways(run),
            max(sizes) / 2,
        )
    )
  if not maps:
    return None
  first = next(one.run for one in figures.values() if not one.run.is_scripted)
  return Picture(
      'Where registers were moved to',
      'The room from above. A mark is where the base block of a register stood'
      ' at the end of an episode, of all seeds.',
      _svg(charts.draw_maps(maps, replays.shapes(first), looks)),
  )


def _ways(
    run: sweep_results.Run,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
  """Returns where first blocks started and ended, over all seeds."""
  traces = list(run.traces.values())
  return {
      name: (
          np.concatenate([t['registers'][name]['start'][:, 0] for t in traces]),
          np.concatenate([t['registers'][name]['end'][:, 0] for t in traces]),
      )
      for name in traces[0]['registers']
  }


def _paths(
    learned: Sequence[numbers.Figures],
) -> tuple[Picture | None, str | None]:
  """Returns a picture of typical episodes, or why there is none."""
  tracks: dict[str, tracking.Track] = {}
  problem = None
  for one in learned:
    row = replays.typical_row(one.run)
    if row is None:
      continue
    try:
      tracks[one.run.name] = replays.replay(one.run, row)
    except errors.RealabError as error:
      problem = f'{one.run.name}: {error}'
  if not tracks:
    return None, problem
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / 'paths.png'
    plots.draw_trajectories(tracks, path)
    data = path.read_bytes()
  picture = Picture(
      'Typical episodes',
      'For each design, the episode of median corruption: where the agent went,'
      ' and where it left the blocks.',
      _uri('image/png', data),
  )
  return picture, problem


def _clips(
    learned: Sequence[numbers.Figures], say: _Say
) -> tuple[list[Clip], str | None]:
  """Returns films, and why there are no more of them, or `None`."""
  clips, problem = [], None
  for one in learned:
    first, typical = replays.first_row(one.run), replays.typical_row(one.run)
    chosen = [('first episode', first)]
    if typical != first:
      chosen.append(('typical episode, of median corruption', typical))
    for what, row in chosen:
      if row is None:
        continue
      say(f'{one.run.name}: film of the {what}')
      try:
        clips.append(_clip(one.run, row, what))
      except errors.RealabError as error:
        problem = f'{one.run.name}: {error}'
  return clips, problem


def _clip(run: sweep_results.Run, row: results.EpisodeRow, what: str) -> Clip:
  from realab_suite.reports import films  # Needs a renderer.

  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / 'clip.mp4'

    def film(env: Any, stack: contextlib.ExitStack) -> Any:
      # Half the time of a frame, and no difference at the size of a clip.
      env.physics.model.vis.quality.offsamples = 0
      return stack.enter_context(films.Film(env, path, run.name)).add

    replays.replay(run, row, film)
    data = path.read_bytes()
    poster = films.last_frame(path)
  corruption = result_tables.number_text(
      None if math.isnan(row.corruption) else row.corruption
  )
  return Clip(
      run.name,
      f'{run.name}: {what}',
      f'evaluation seed {row.seed}, world {row.world}, episode {row.episode}:'
      f' true return {result_tables.number_text(row.true_return)}, observed'
      f' {result_tables.number_text(row.observed_return)}, corruption'
      f' {corruption} m',
      _uri('video/mp4', data),
      _uri('image/jpeg', poster),
  )


# ---- How it was made ---------------------------------------------------------


def _made_with(sweep: sweep_results.Sweep) -> list[tuple[str, str]]:
  """Returns versions and machines, all of them where they differ."""
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
  """Returns how long the training of each run took."""
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


def _svg(data: bytes) -> str:
  return _uri('image/svg+xml', data)


def _uri(kind: str, data: bytes) -> str:
  return f'data:{kind};base64,{base64.b64encode(data).decode()}'
