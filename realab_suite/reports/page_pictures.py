"""Pictures in the page of a report, except its films."""

import base64
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import pathlib
import tempfile
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import hacking
from realab_suite.evaluation import intervals
from realab_suite.experiments import tracking
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
            _bands(done, _relative_gain),
            baseline and baseline.summary.true_return.estimate,
        )
    )
  if not designs:
    return None
  return Picture(
      'Learning curves',
      'Each point is a mean over the training episodes that ended since the'
      ' previous point; the interval is long enough for an episode in every'
      " world. The relative gain is what corruption adds to the learner's"
      ' objective, in units of the stake; episodes above'
      f' {hacking.SHARE_OF_STAKE:g} may be hacked. Observed returns are in the'
      ' units of each register. Points with episodes from fewer than half of'
      ' the worlds are omitted.',
      _svg(learning_chart.draw(designs, styles, hacking.SHARE_OF_STAKE)),
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


def _relative_gain(
    run: sweep_results.Run, point: Mapping[str, Any]
) -> float | None:
  gain, stake = point['gain'], run.stake
  if gain is None or stake is None or stake.main.is_degenerate:
    return None
  return float(gain) / stake.main.estimate


def plane(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    styles: Mapping[str, chart_style.Style],
) -> Picture | None:
  """Returns the chart of true return against hack rate."""
  points = []
  for name, one in figures.items():
    family, found = sweep.family(one.run), one.hacking
    if found is None or family not in styles:
      continue
    is_baseline = any(o.run.baseline == name for o in figures.values())
    if one.run.is_scripted and not is_baseline:
      continue
    kind = 'baseline' if is_baseline else 'twin' if one.run.twin_of else 'run'
    returns = comparison.by_seed(
        [row for row in one.run.rows if row.counts], 'true_return'
    )
    points.append(
        plane_chart.Point(
            name,
            family,
            kind,
            [
                (100 * count.rate, float(np.mean(returns[seed])))
                for seed, count in found.by_seed.items()
            ],
            found.rate.scaled(100),
            one.summary.true_return,
        )
    )
  if not points:
    return None
  return Picture(
      'True return against hack rate',
      'Small marks are seeds; large marks are means with 95 % intervals. Top'
      ' left: the design works as intended. Bottom right: it tampers. Bottom'
      ' left: it fails at the task without tampering.',
      _svg(plane_chart.draw(points, styles)),
  )


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


def _svg(data: bytes) -> str:
  return data_uri('image/svg+xml', data)


def data_uri(kind: str, data: bytes) -> str:
  """Returns data of a MIME type as an address that contains it."""
  return f'data:{kind};base64,{base64.b64encode(data).decode()}'
