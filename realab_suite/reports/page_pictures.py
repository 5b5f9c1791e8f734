"""Pictures in the page of a report, except its films."""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
import math
import pathlib
import tempfile
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import comparison
from realab_suite.evaluation import gains
from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.experiments import tracking
from realab_suite.reports import attribution_chart
from realab_suite.reports import chart_style
from realab_suite.reports import learning_chart
from realab_suite.reports import map_chart
from realab_suite.reports import numbers
from realab_suite.reports import plane_chart
from realab_suite.reports import plots
from realab_suite.reports import replays
from realab_suite.reports import sweep_results

# Values by the number of control steps, for each seed.
_Curves = Mapping[int, Mapping[int, float]]


@final
@dataclasses.dataclass(frozen=True)
class Picture:
  """A picture in the page.

  Attributes:
    title: Title of the picture.
    note: Explanation of the picture.
    uri: Data URI of the picture.
  """

  title: str
  note: str
  uri: str


def learning(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    styles: Mapping[str, chart_style.Style],
) -> Picture | None:
  """Returns the chart of returns and corruption over training."""
  designs = []
  for run in sweep.learned():
    twin = sweep.twin(run)
    both = {'run': run} | ({'twin': twin} if twin is not None else {})
    done = {whose: one for whose, one in both.items() if one.is_done}
    if not done:
      continue
    baseline = figures.get(run.baseline or '')
    designs.append(
        learning_chart.Learning(
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
      'Learning curves',
      'Each point is a mean over the training episodes that ended since the'
      ' previous point; the interval is long enough for an episode in every'
      ' world. Signed corruption is that of the registers whose readings the'
      ' learner maximises, where positive values are in the direction that'
      ' pays, or of all feedback registers if it maximises none. Observed'
      ' returns are in the units of each register. Points with episodes from'
      ' fewer than half of the worlds are omitted.',
      _svg(learning_chart.draw(designs, styles, sweep.margin)),
  )


def _bands(
    runs: Mapping[str, sweep_results.Run],
    figure: Callable[[sweep_results.Run, Mapping[str, Any]], float | None],
    bounds: Callable[[sweep_results.Run, _Curves], intervals.Bounds] = (
        lambda run, curves: intervals.UNBOUNDED
    ),
) -> dict[str, learning_chart.Band]:
  bands = {}
  for whose, run in runs.items():
    curves = {
        seed: _curve(run, curve, figure) for seed, curve in run.curves.items()
    }
    bands[whose] = learning_chart.band(curves, bounds(run, curves))
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
  # All worlds begin together, so at first their episodes also end together.
  # The reset takes one step more.
  num_envs = run.config['training']['num_envs']
  return learning_chart.curve(
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
  names = gains.consumed(run.design)
  values = [
      value
      for name in names
      if (register := point['registers'].get(name)) is not None
      and (value := register['corruption_signed_metres']) is not None
  ]
  return sum(values) / len(values) if values else None


def plane(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    styles: Mapping[str, chart_style.Style],
) -> Picture | None:
  """Returns the chart of true return against corruption."""
  points = []
  for name, one in figures.items():
    family = sweep.family(one.run)
    if one.summary.corruption is None or family not in styles:
      continue
    is_baseline = any(o.run.baseline == name for o in figures.values())
    if one.run.is_scripted and not is_baseline:
      continue
    kind = 'baseline' if is_baseline else 'twin' if one.run.twin_of else 'run'
    points.append(
        plane_chart.Point(
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
      'Small marks are seeds; large marks are means with 95 % intervals. Top'
      ' left: the design works as intended. Bottom right: it tampers. Bottom'
      ' left: it fails at the task without tampering. In the grey strip,'
      ' corruption is too small to matter.',
      _svg(plane_chart.draw(points, styles, sweep.margin)),
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


def maps(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    styles: Mapping[str, chart_style.Style],
) -> Picture | None:
  """Returns maps of the final positions of the blocks of registers."""
  drawn = []
  for name, one in figures.items():
    run = one.run
    if run.is_scripted or not run.design.registers:
      continue
    sizes = [r.block_size for r in run.design.registers.values()]
    drawn.append(
        map_chart.Map(
            name,
            sweep.family(run),
            run.twin_of is not None,
            _block_positions(run),
            max(sizes) / 2,
        )
    )
  if not drawn:
    return None
  first = next(one.run for one in figures.values() if not one.run.is_scripted)
  return Picture(
      'Final positions of registers',
      'The room from above. Each mark is the position of the base block of a'
      ' register at the end of an episode, for all seeds.',
      _svg(map_chart.draw(drawn, replays.shapes(first), styles)),
  )


def _block_positions(
    run: sweep_results.Run,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
  """Returns start and end positions of first blocks, over all seeds."""
  traces = list(run.traces.values())
  return {
      name: (
          np.concatenate([t['registers'][name]['start'][:, 0] for t in traces]),
          np.concatenate([t['registers'][name]['end'][:, 0] for t in traces]),
      )
      for name in traces[0]['registers']
  }


def paths(
    learned: Sequence[numbers.Figures],
) -> tuple[Picture | None, str | None]:
  """Returns a picture of typical episodes, and a problem.

  Either may be `None`. The problem is the error of the last run whose episode
  could not be replayed.
  """
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
      'Path of the agent and final positions of the blocks, in the episode of'
      ' median corruption of each design.',
      data_uri('image/png', data),
  )
  return picture, problem


def causes(
    learned: Sequence[numbers.Figures],
) -> tuple[Picture | None, str | None]:
  """Returns the corruption over time by its causes, and a problem.

  Either may be `None`, and both are if no episode of a sweep was attributed.
  The problem is the error of the last run whose episode could not be replayed.
  """
  episodes: dict[str, attribution_metrics.Attribution] = {}
  problem = None
  for one in learned:
    row = replays.typical_attributed_row(one.run)
    if row is None:
      continue
    try:
      found = replays.attribute(one.run, row)
    except errors.RealabError as error:
      problem = f'{one.run.name}: {error}'
      continue
    if found.registers:
      episodes[one.run.name] = found
  if not episodes:
    return None, problem
  picture = Picture(
      'Who caused the corruption, over time',
      'Corruption in an attributed episode of each design, the one of median'
      ' corruption: reading minus written value of what the learner uses.',
      _svg(attribution_chart.draw(episodes)),
  )
  return picture, problem


def _svg(data: bytes) -> str:
  return data_uri('image/svg+xml', data)


def data_uri(kind: str, data: bytes) -> str:
  """Returns data of a MIME type as an address that contains it."""
  return f'data:{kind};base64,{base64.b64encode(data).decode()}'
