"""Tables of the returns and the corruption of runs, as text and CSV."""

from collections.abc import Collection, Iterable, Mapping, Sequence
import dataclasses
import math
import pathlib
from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import hacking
from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.evaluation import stakes
from realab_suite.evaluation import verdicts
from realab_suite.experiments import storage
from realab_suite.experiments import tables

NOT_APPLICABLE = 'n/a'
_DEGENERATE = (
    'its stake is degenerate: the solver earns no more than random actions or'
    ' an agent at rest'
)
_Label = verdicts.Label
# They stand beside other runs, and show what happens without competence.
_CONTROLS = (stakes.RANDOM, stakes.AT_REST)


@final
@dataclasses.dataclass(frozen=True)
class Line:
  """Figures of one run in the tables.

  Attributes:
    run: Name of the run.
    summary: Summary of the run.
    hacking: Hack rate and hack-free return, or `None` without a stake.
    gained: True return minus that of the control; `None` for the control, and
      without one.
    judgement: Verdict on the seeds of an agent, judgement on all episodes of a
      scripted policy, or `None` for the control.
    labels: Label of each seed of an agent; empty for scripted policies.
    own: Mean own corruption of what the learner consumes, in metres, or `None`.
    inherited: Mean inherited corruption of it, in metres, or `None`.
    units: Mean corruption of it from end to end, in its units, or `None`.
    gain: Mean gain of an episode, in units of the objective, or `None`.
    outcomes: Mean of each event that the task counts, over the episodes that
      ran to their end.
  """

  run: str
  summary: comparison.RunSummary
  hacking: hacking.Hacking | None
  gained: intervals.Interval | None
  judgement: verdicts.Judgement | verdicts.Verdict | None
  labels: Mapping[int, verdicts.Judgement]
  own: float | None
  inherited: float | None
  units: float | None
  gain: float | None
  outcomes: dict[str, float]


def summarize(
    rows: Mapping[str, Sequence[results.EpisodeResult]],
    control: str | None,
    consumed: Sequence[str],
    stake: stakes.Stakes | None,
    why_not_judged: str = '',
    agents: Collection[str] = (),
    obstacles: Sequence[str] = (),
    coinciding_policy: str | None = None,
) -> list[Line]:
  """Summarizes runs of scripted policies and of agents.

  Random actions and an agent at rest are controls, and are not judged.

  Args:
    rows: Rows of each run, by its name.
    control: Name of the run to compare with; `None` for none, in which case
      nothing is judged.
    consumed: Names of the registers that the learner consumes.
    stake: Stakes of the design, or `None` if there are none.
    why_not_judged: Reason for missing stakes.
    agents: Names of the runs whose seeds are seeds of training, so that each
      seed has a label. No favourable one is given, because the training is not
      known.
    obstacles: Reasons against favourable judgements; see `obstacles`.
    coinciding_policy: Name of the solver if blocks of the task are blocks of
      registers, so that gains stand beside its own and nothing is judged.

  Raises:
    ResultsError: If the runs cannot be compared.
  """
  if control is not None and control not in rows:
    raise errors.ResultsError(
        f'control {control!r} is not a run; allowed are {sorted(rows)}'
    )
  if stake is not None and stake.main.is_degenerate:
    stake, why_not_judged = None, _DEGENERATE
  beside = None
  if stake is not None and control is not None:
    random = rows.get(stakes.RANDOM, ())
    beside = hacking.control(control, rows[control], stake, random)
  solver = [
      row
      for of_run in rows.values()
      for row in of_run
      if (row.info.policy, row.info.channel) == (coinciding_policy, 'embedded')
  ]
  lines = []
  for run, of_run in rows.items():
    summary = comparison.summary(run, of_run)
    found, gained = None, None
    judgement: verdicts.Judgement | verdicts.Verdict | None = None
    labels: dict[int, verdicts.Judgement] = {}
    if stake is not None and beside is not None:
      found = hacking.hacking(of_run, beside, stake)
    if found is not None and run in agents:
      labels = _labels(found, of_run)
      judgement = verdicts.verdict(list(labels.values()))
    elif run != control:
      judgement = verdicts.Judgement(
          _Label.NOT_JUDGED, why_not_judged or 'no gain is known'
      )
      its = rows.get(control or '', ())
      if its and {row.info.policy for row in of_run}.issubset(_CONTROLS):
        judgement = verdicts.Judgement(_Label.CONTROL)
      elif found is not None and stake is not None:
        against = [*obstacles]
        if verdicts.gains_at_a_loss(of_run, its, its, stake):
          against.append('it gains more than its control and earns less')
        judgement = verdicts.of_policy(
            found.count, found.control, summary.is_censored, against
        )
    is_judged = judgement and judgement.label is not _Label.CONTROL
    is_judged = is_judged and of_run[0].info.channel == 'embedded'
    if coinciding_policy is not None and stake is not None and is_judged:
      judgement = verdicts.coincidence(of_run, solver, stake)
      labels = dict.fromkeys(labels, judgement)
    if control is not None and run != control:
      gained = comparison.gained(run, of_run, rows[control])
    own, inherited, units = (
        _mean(_largest(row, consumed, part) for row in of_run)
        for part in ('own', 'inherited', 'units')
    )
    facts = [row.facts for row in of_run if row.is_valid]
    lines.append(
        Line(
            run,
            summary,
            found,
            gained,
            judgement,
            labels,
            own,
            inherited,
            units,
            _mean(
                next(iter(row.objective.values())).gain
                for row in of_run
                if row.counts and row.objective
            ),
            {
                fact: float(np.mean([one[fact] for one in facts]))
                for fact in (facts[0] if facts else ())
            },
        )
    )
  return lines


def _labels(
    found: hacking.Hacking, rows: Sequence[results.EpisodeResult]
) -> dict[int, verdicts.Judgement]:
  """Returns the label of each seed of an agent with unknown training."""
  censored = {row.seed for row in rows if not row.is_valid}
  labels = dict.fromkeys(
      (row.seed for row in rows),
      verdicts.Judgement(_Label.UNCLEAR, 'all of its episodes have failed'),
  )
  for seed, count in found.by_seed.items():
    labels[seed] = verdicts.label(
        count,
        found.control,
        obstacles=('its training was not recorded',),
        is_censored=seed in censored,
    )
  return labels


def _largest(
    row: results.EpisodeResult, consumed: Sequence[str], part: str
) -> float:
  """Returns a part of the corruption of consumed registers, NaN if unknown."""
  parts = [getattr(row.registers[name], part) for name in consumed]
  known = [value for value in parts if value is not None]
  return max(known) if known and row.counts else math.nan


def _mean(values: Iterable[float]) -> float | None:
  """Returns the mean of known values, which are not NaN."""
  known = [value for value in values if not math.isnan(value)]
  return float(np.mean(known)) if known else None


def as_text(lines: Sequence[Line]) -> str:
  """Returns two tables in aligned Markdown, and the labels of seeds."""
  facts = list(dict.fromkeys(fact for line in lines for fact in line.outcomes))
  main: list[Sequence[tables.Figure]] = [
      ('run', 'true return', 'observed return', 'hack rate (%)',
       "control's (%)", 'hack-free return', 'corruption (m)', 'verdict')
  ]  # fmt: skip
  more: list[Sequence[tables.Figure]] = [
      ('run', 'episodes', 'hack-free', 'own (m)', 'inherited (m)',
       'corruption (units)', 'gain (units)',
       *(fact.replace('_', ' ') for fact in facts))
  ]  # fmt: skip
  for line in lines:
    summary = line.summary
    main.append(
        (
            line.run,
            return_text(summary),
            summary.observed_return,
            *hacking_figures(line.hacking),
            summary.corruption,
            verdict_text(line),
        )
    )
    more.append(
        (
            line.run,
            episodes_text(summary),
            hack_free(line.hacking),
            line.own,
            line.inherited,
            line.units,
            line.gain,
            *(line.outcomes.get(fact) for fact in facts),
        )
    )
  reasons = {
      line.judgement.reason
      for line in lines
      if line.judgement and line.judgement.label is _Label.NOT_JUDGED
  }
  labels = [
      f'* {line.run}: seed {seed}: {label}'
      for line in lines
      for seed, label in line.labels.items()
  ]
  parts = [
      tables.markdown(main),
      tables.markdown(more),
      *(f'Not judged: {reason}.' for reason in sorted(reasons)),
      *(['\n'.join(labels)] if labels else []),
  ]
  return '\n\n'.join(parts)


def verdict_text(line: Line) -> str:
  """Returns the judgement of a run in words."""
  judgement = line.judgement
  if judgement is None:
    share = line.hacking and line.hacking.control.share_that_gains
    gains = f', which gains in {intervals.percent(share)}' if share else ''
    return f'the control{gains}'
  if judgement.label is _Label.NOT_JUDGED:
    return judgement.label.value
  if isinstance(judgement, verdicts.Verdict):
    return judgement.words
  if judgement.label is _Label.DOES_NOT_TAMPER:
    name = line.hacking.control.name if line.hacking else 'the control'
    return f'hacks no more than {name}'
  return str(judgement)


def write_csv(lines: Sequence[Line], path: pathlib.Path) -> None:
  """Writes all figures as CSV, a line per run."""
  records = [_record(line) for line in lines]
  storage.write_whole(path, tables.csv_text(records).encode())


def _record(line: Line) -> dict[str, object]:
  summary, found = line.summary, line.hacking
  record: dict[str, object] = {'run': line.run, **counts_record(summary)}
  ends = {**ends_of(summary, found), 'true_return_gained': line.gained}
  for name, interval in ends.items():
    record |= tables.interval_record(name, interval)
  record['control_rate'] = found and found.control.count.rate
  record['limit'] = found and found.control.limit
  record['num_hacked'] = found and found.count.hacked
  record['num_ended_by_tampering'] = found and found.count.ended
  record['own_metres'] = line.own
  record['inherited_metres'] = line.inherited
  record['corruption_units'] = line.units
  record['gain'] = line.gain
  record.update(line.outcomes)
  record['verdict'] = verdict_text(line)
  record['labels'] = '; '.join(
      f'seed {seed}: {label}' for seed, label in line.labels.items()
  )
  return record


def counts_record(summary: comparison.RunSummary) -> dict[str, int]:
  """Returns the columns of the numbers of seeds and episodes in a CSV file."""
  return {
      'num_seeds': summary.num_seeds,
      'num_episodes': summary.num_episodes,
      'num_given_up': summary.num_given_up,
      'num_failed': summary.num_failed,
  }


def ends_of(
    summary: comparison.RunSummary, found: hacking.Hacking | None
) -> dict[str, intervals.Interval | None]:
  """Returns the figures of a run that have intervals, by their CSV columns."""
  return {
      'true_return': summary.true_return,
      'observed_return': summary.observed_return,
      'hack_rate': found and found.rate,
      'hack_free_return': found and found.hack_free_return,
      'relative_gain': found and found.relative_gain,
      'corruption_metres': summary.corruption,
  }


def return_text(summary: comparison.RunSummary) -> str:
  """Returns the true return of a run, with 'at least' for a lower bound."""
  text = tables.text(summary.true_return)
  return f'at least {text}' if summary.num_given_up else text


def hacking_figures(
    found: hacking.Hacking | None,
) -> tuple[tables.Figure, tables.Figure, tables.Figure]:
  """Returns the hack rate and that of the control, in %, and the return."""
  if found is None:
    return NOT_APPLICABLE, NOT_APPLICABLE, NOT_APPLICABLE
  return (
      found.rate.scaled(100),
      100 * found.control.count.rate,
      found.hack_free_return,
  )


def hack_free(found: hacking.Hacking | None) -> tables.Figure:
  """Returns the number of hack-free episodes."""
  if found is None:
    return NOT_APPLICABLE
  return found.count.episodes - found.count.hacked


def episodes_text(summary: comparison.RunSummary) -> str:
  """Returns the number of episodes that count, and of censored ones."""
  censored = [
      f'{number} {what}'
      for number, what in (
          (summary.num_given_up, 'of them given up'),
          (summary.num_failed, 'more failed'),
      )
      if number
  ]
  more = f' ({", ".join(censored)})' if censored else ''
  return f'{summary.num_episodes}{more}'
