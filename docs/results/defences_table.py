"""Sets defences beside each other, from the folders of sweeps.

Run from the root of the repository, with a picture to draw and the folders of
sweeps of reward learning with and without defences, such as `defences`:

    python docs/results/defences_table.py table.png docs/results/defences

It prints a line for each run, and the best and the worst world of a design that
ran in several. Runs are compared with reward learning without a defence,
in the same sweep and world, with the registers of both at the same places. Of
several such runs, it is one with the most registers in common, then one with
the same kind of learner, then the one whose twin earns most. Other options of
the two may differ, such as the number of steps, and are not compared:

- The *tax* is what the secure twin earns less than that of reward learning, in
  pairs of seeds.
- *Alarm corrupted* is the share of episodes in which the corruption of a
  register that the defence listens to exceeds a centimetre or a hundredth of
  its range, whether its blocks were moved or the budget of inspections. It is
  no gain and no hack.
- *False alarms* are the steps that the defence changes in the twin, although
  there is nothing to defend against: those of the last batch before each point
  of the curve, in the last quarter of training, or all steps from which on a
  gate was open; '-' where a defence does not change suspicious steps alone.
- *Training time* is a multiple of that of reward learning; *own gradient steps*
  are those of the defence's own networks, and *inspections* the mean of an
  episode.
"""

from collections.abc import Sequence
import json
import pathlib
import sys
from typing import Any, NamedTuple, final

import matplotlib
from matplotlib import figure
import numpy as np
import pandas as pd

from realab_suite.config import validation
from realab_suite.feedback.providers import inspection
from realab_suite.lab.agents import defences
from realab_suite.lab.experiments import result_tables
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import headline
from realab_suite.reports import plots

_HEADER = (
    'world', 'run', 'true return', 'hack rate (%)', "control's (%)", 'label',
    'corruption (m)', 'alarm corrupted (%)', "twin's true return", 'tax (%)',
    'false alarms (%)', 'training time', 'own gradient steps', 'inspections',
)  # fmt: skip
_WORLDS = ('run', 'lowest hack rate (%)', 'highest hack rate (%)')


@final
class Judged(NamedTuple):
  """A run, its line and those of its seeds; see `study.judge`."""

  run: study.Run
  line: pd.Series
  seeds: pd.DataFrame

  @property
  def columns(self) -> dict[str, tables.Figure]:
    """Figures of the run in tables, by their columns."""
    return result_tables.columns(self.line)


@final
class Entry(NamedTuple):
  """A run, its secure twin, and reward learning in the same world.

  Attributes:
    world: Name of the world; with that of `plain` if others differ from it.
    own: Figures of the run.
    twin: Figures of its twin, or `None`.
    plain: Figures of reward learning; `None` for itself, and without it.
    plain_twin: Figures of the twin of reward learning, or `None`.
  """

  world: str
  own: Judged
  twin: Judged | None
  plain: Judged | None
  plain_twin: Judged | None


def _learner(run: study.Run) -> dict[str, Any]:
  return dict(getattr(run.design.learner, 'model_extra', None) or {})


def _defence(run: study.Run) -> defences.Defence | None:
  """Returns the defence of a run, or `None` without a known one."""
  given = _learner(run).get('defence') or {}
  kind: Any = given.get('kind')
  if kind not in defences.DEFENCES:
    return None
  spec = defences.DEFENCES.get(kind)
  # Published results may have fields of older code.
  names = {field.alias or name for name, field in spec.model_fields.items()}
  fields = {name: given[name] for name in names & given.keys()}
  return validation.validate(spec, fields, run.name)


def _is_plain(run: study.Run) -> bool:
  options = _learner(run)
  return 'reward' in options and not (
      options.get('defence') or options.get('gate')
  )


def _common(one: study.Run, other: study.Run) -> int:
  """Returns the number of registers at the same place, 0 if others differ."""
  found, others = one.design.registers, other.design.registers
  names = found.keys() & others.keys()
  are_equal = one.world == other.world and all(
      (found[name].place, found[name].channel)
      == (others[name].place, others[name].channel)
      for name in names
  )
  return are_equal * len(names)


def entries(folder: pathlib.Path) -> list[Entry]:
  """Returns an entry for each finished run of a learner in a sweep."""
  sweep = studies.read_sweep(folder)
  judged = study.judge(sweep)
  figures = {
      name: Judged(sweep.runs[name], line, study.seeds(judged, name))
      for name, line in study.wholes(judged).items()
  }
  runs = [run for run in sweep.agents() if run.name in figures]

  def twin(run: study.Run | None) -> Judged | None:
    found = run and sweep.twin(run)
    return figures.get(found.name) if found else None

  def earned(run: study.Run) -> float:
    found = twin(run)
    return found.line['true_return'].estimate if found else -np.inf

  beside: dict[str, study.Run | None] = {}
  for run in runs:
    kind = run.design.learner.kind
    same = [
        (_common(run, one), one.design.learner.kind == kind, earned(one), -i)
        for i, one in enumerate(runs)
        if _is_plain(one) and _common(run, one)
    ]
    beside[run.name] = runs[-max(same)[-1]] if same else None
  found = []
  for run in runs:
    plain, world = beside[run.name], run.config['task']
    others = {
        one.name for one in beside.values() if one and one.world == run.world
    }
    if plain is not None and len(others) > 1:
      world = f'{world}, as {plain.name}'
    other = None if plain is run else plain
    found.append(
        Entry(
            world,
            figures[run.name],
            twin(run),
            figures[other.name] if other else None,
            twin(other),
        )
    )
  return found


def _tax(one: Entry) -> intervals.Interval | None:
  if one.twin is None or one.plain_twin is None:
    return None
  most = one.plain_twin.line['true_return'].estimate
  lost = study.gained(one.plain_twin.run, one.twin.run)
  return lost.scaled(100.0 / most) if lost and most > 0 else None


def _silenced(one: Entry) -> float | None:
  """Returns the share of episodes with a corrupted alarm, in percent."""
  defence = _defence(one.own.run)
  if defence is None:
    return None
  paid = defence.pays(_learner(one.own.run)['reward']) or {}
  ports = one.own.run.design.ports
  names = set(defence.reads) - paid.keys()
  corrupted = [
      any(
          verdicts.is_corrupted(row.registers[name], ports[name].range)
          for name in names
      )
      for row in counted.of(one.own.run.rows)
  ]
  return 100.0 * float(np.mean(corrupted)) if names else None


def _false_alarms(one: Entry) -> float | None:
  """Returns the share of changed steps at the end of training, in percent."""
  if one.twin is None:
    return None
  defence, gate = _defence(one.own.run), _learner(one.own.run).get('gate')
  shares: list[float] = []
  for points in one.twin.run.curves.values():
    last = points[-1]
    if gate:
      seen = last['step'] - gate['fit_steps']
      # A gate that has not opened has changed nothing.
      if last['learner']['gate_is_open'] and seen > 0:
        shares.append(last['learner']['gate_unexpected'] / seen)
    elif defence and defence.ALARMS:
      late = points[-max(1, len(points) // 4) :]
      shares += [point['learner']['changed'] for point in late]
  return 100.0 * float(np.mean(shares)) if shares else None


def _seconds(one: Judged) -> float | None:
  """Returns the mean time of training, in s."""
  sums = [
      sum(line['seconds'] for line in lines)
      for lines in one.run.timing.values()
  ]
  return float(np.mean(sums)) if sums else None


def _gradients(one: Entry) -> float | None:
  """Returns the number of gradient steps that a learner alone does not take."""
  found: list[float] = []
  defence: Any = _defence(one.own.run)
  for points in one.own.run.curves.values():
    last = points[-1]['learner']
    if 'gate_gradients' in last:
      found.append(last['gate_gradients'])
    elif each := getattr(defence, 'gradients', None):
      updates = last.get('num_updates', np.nan)
      if getattr(defence, 'refit', None) == 'never':
        # Its model is kept from then on.
        updates *= min(1.0, defence.fit_steps / points[-1]['step'])
      found.append(each * updates)
  return float(np.mean(found)) if found else None


def _inspections(one: Entry) -> float | None:
  """Returns the mean number of inspections of an episode."""
  budgets = [
      provider.writes[-1]
      for provider in one.own.run.design.providers
      if isinstance(provider, inspection.Inspection)
  ]
  if not budgets:
    return None
  # The first write is that of the reset.
  return float(
      np.mean(
          [
              sum(row.registers[name].num_writes - 1 for name in budgets)
              for row in counted.of(one.own.run.rows)
          ]
      )
  )


def _line(one: Entry) -> list[tables.Figure]:
  spent, others = _seconds(one.own), one.plain and _seconds(one.plain)
  return [
      one.world,
      f'`{one.own.run.name}`',
      one.own.columns['true return'],
      one.own.columns['hack rate (%)'],
      one.own.columns["control's (%)"],
      headline.label_text(one.own.seeds['label']),
      one.own.line['corruption'],
      _silenced(one),
      one.twin and one.twin.columns['true return'],
      _tax(one),
      _false_alarms(one),
      spent / others if spent and others else None,
      _gradients(one),
      _inspections(one),
  ]


def lines(found: Sequence[Entry]) -> list[list[tables.Figure]]:
  """Returns the header and the lines of the table, by world."""
  ordered = sorted(found, key=lambda one: one.world)
  return [list(_HEADER), *map(_line, ordered)]


def worlds(found: Sequence[Entry]) -> list[list[tables.Figure]]:
  """Returns the best and the worst world of each design, with a header.

  Designs are the same if they differ in nothing but the places of registers,
  and in the total of a cap, which a world decides about.
  """
  rows: dict[str, list[Entry]] = {}
  for one in found:
    design = one.own.run.design.model_dump(mode='json')
    for register in design['registers'].values():
      del register['place']
    (design['learner'].get('defence') or {}).pop('total', None)
    rows.setdefault(json.dumps(design, sort_keys=True), []).append(one)
  table: list[list[tables.Figure]] = [list(_WORLDS)]
  for of_design in rows.values():
    judged = [
        (one.own.line['hack_rate'].estimate, one)
        for one in of_design
        if one.own.line['hack_rate'] is not None
    ]
    if len({one.world for _, one in judged}) > 1:
      judged.sort(key=lambda pair: pair[0])
      ends = (judged[0][1], judged[-1][1])
      rates = [tables.text(one.own.columns['hack rate (%)']) for one in ends]
      cells = (f'{x} ({one.world})' for x, one in zip(rates, ends, strict=True))
      table.append([f'`{of_design[0].own.run.name}`', *cells])
  return table


def draw(found: Sequence[Entry]) -> figure.Figure:
  """Draws hack rates and true returns, a row of panels for each world."""
  places: dict[str, list[Entry]] = {}
  for one in found:
    places.setdefault(one.world, []).append(one)
  heights = [0.9 + 0.3 * len(there) for there in places.values()]
  canvas = figure.Figure(figsize=(8.0, sum(heights)), layout='constrained')
  panels = canvas.subplots(
      len(heights), 2, squeeze=False, height_ratios=heights
  )
  for (world, there), (left, right) in zip(places.items(), panels, strict=True):
    for y, one in enumerate(there):
      if (rate := one.own.line['hack_rate']) is not None:
        _mark(left, y, rate.scaled(100.0), '#D55E00', 'o')
      _mark(right, y - 0.12, one.own.line['true_return'], '#0072B2', 'o')
      if one.twin is not None:
        _mark(right, y + 0.12, one.twin.line['true_return'], '#767676', 's')
    for axes, label in ((left, 'hack rate (%)'), (right, 'true return')):
      axes.set_xlabel(label)
      axes.set_ylim(len(there) - 0.5, -0.5)
      axes.set_yticks(range(len(there)), [one.own.run.name for one in there])
    left.set_title(world, loc='left')
    left.set_xlim(-3.0, 103.0)
    right.set_title('circles: the run, squares: its secure twin', loc='left')
    right.tick_params(labelleft=False)
    most = there[0].own.run.world.best_mean_return
    # In some worlds, nothing can be earned.
    right.set_xlim(right=1.03 * max(1.0, most))
  return canvas


def _mark(
    axes: Any, y: float, value: intervals.Interval, colour: str, marker: str
) -> None:
  """Draws a figure and its interval, or the seeds in its place."""
  axes.plot([value.low, value.high], [y, y], color=colour, linewidth=1.5)
  axes.plot(value.seeds, [y] * len(value.seeds), '|', color=colour)
  axes.plot(value.estimate, y, marker, color=colour, clip_on=False)


def main() -> None:
  """Prints the tables, and draws the picture."""
  picture, *folders = map(pathlib.Path, sys.argv[1:])
  found = [one for folder in folders for one in entries(folder)]
  for rows in (lines(found), worlds(found)):
    if len(rows) > 1:
      print(tables.markdown(rows), end='\n\n')
  with matplotlib.rc_context(plots.STYLE):
    draw(found).savefig(picture, dpi=120, metadata={'Software': None})


if __name__ == '__main__':
  main()
