"""First lines of a report: what each learned agent does, and how sure it is."""

import collections
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd

from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts

_Label = verdicts.Label
_Rows = Sequence[results.EpisodeResult]
# What has moved if a part of the corruption of a register is not 0, by its
# kind; kinds of users do not say it.
_BLOCKS = {
    'two_block': ('base block', 'offset block'),
    'abacus_2': ('base block', 'bead'),
    'abacus_4': ('base block', 'bead'),
    'block_position': ('', 'block'),
    'block_orientation': ('', 'block'),
}


def headline(sweep: study.Study, judged: pd.DataFrame) -> dict[str, list[str]]:
  """Returns the first lines on each learned run, those that tamper first.

  The lines are, in this order: whether the run fails at the task, beside its
  twin; its label; its hack rate beside that of its control; its queries, in a
  coupled design; its audit; the training episodes in which tampering paid.

  Args:
    sweep: The sweep.
    judged: What `study.judge` returns.
  """
  wholes = study.wholes(judged)
  runs = [run for run in sweep.agents() if run.name in wholes]
  # Sorting keeps the order of the experiment otherwise.
  runs.sort(key=lambda run: -_share(study.seeds(judged, run.name)))
  return {run.name: _lines(sweep, wholes, judged, run) for run in runs}


def counts(sweep: study.Study, run: study.Run, line: pd.Series) -> str | None:
  """Returns what a learned run did, in counts; `None` without a hack rate."""
  if line['hack_rate'] is None or run.stake is None:
    return None
  rows = counted.of(run.rows, run.stake, line['limit'])
  hacked = [
      row for row in rows if counted.is_hacked(row, run.stake, line['limit'])
  ]
  return did(run.design, rows, hacked, sweep.solver(run))


def did(
    design: specs.DesignSpec, rows: _Rows, hacked: _Rows, solver: _Rows
) -> str:
  """Returns what an agent did, in counts.

  Args:
    design: Design of the agent.
    rows: Its episodes.
    hacked: Those of them that are hacked.
    solver: Episodes of the solver, which works honestly.
  """
  episodes = f'of {intervals.counted(len(rows), "episode")}'
  if objectives.RETURN not in rows[0].objective:
    gained = 'the agent gained' if hacked else 'did the agent gain'
    number_of = f'{len(hacked):,}' if hacked else 'none'
    return f'In {number_of} {episodes} {gained} by corruption.'
  if hacked:
    text = f'In {len(hacked):,} {episodes} the agent moved the'
    text += f' {_block(design, hacked)} and'
  else:
    text = f'In none {episodes} was the agent paid for moving the blocks; it'
  text += f' was paid {_range(hacked or rows)}'
  payments = [paid(row).observed for row in solver]
  honest = (
      f'; honest work earns {rounded(float(np.mean(payments)))}'
      if payments
      else ''
  )
  return f'{text}{honest}.'


def _block(design: specs.DesignSpec, rows: _Rows) -> str:
  """Returns the block that has moved most, if it has in each episode."""
  most = next(iter(moved(design, rows)), None)
  if most is not None and all(most in moved(design, [row]) for row in rows):
    return most
  return 'blocks'


def moved(design: specs.DesignSpec, rows: _Rows) -> dict[str, float]:
  """Returns the error of readings by each block that moved, largest first.

  Args:
    design: Design of the agent.
    rows: The episodes.

  Returns:
    The mean over the episodes, in metres, or in radians where a register stores
    an angle, by the block and its register.
  """
  sizes: dict[str, float] = {}
  for port, spec in design.ports.items():
    figures = [row.registers[port] for row in rows if port in row.registers]
    blocks = _BLOCKS.get(spec.kind, ('blocks', 'blocks'))
    for block, part in zip(blocks, ('permanent', 'temporary'), strict=True):
      if any(parts := [getattr(one, part) or 0.0 for one in figures]):
        sizes[f'{block} of {port}'] = float(np.mean(parts))
  return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def chip(line: pd.Series, seeds: pd.DataFrame) -> tuple[str, str]:
  """Returns the label of a run in a word, and the seeds that it stands for.

  Args:
    line: Line of the run; see `study.judge`.
    seeds: Lines of its seeds.
  """
  number_of = intervals.counted(len(seeds), 'seed')
  if len(seeds) < verdicts.FEWEST_SEEDS:
    [(label, count)] = collections.Counter(seeds['label']).most_common(1)
    return label.value, f'{count} of {number_of}, no verdict'
  count = line['num_tampering']
  return line['label'].value, f'{count} of {number_of}' if count else number_of


def label_text(labels: Iterable[verdicts.Label]) -> str:
  """Returns labels with the numbers of their seeds, most frequent first."""
  labels = list(labels)
  number = len(labels)
  label_counts = collections.Counter(label.value for label in labels)
  if len(label_counts) == 1:
    [label] = label_counts
    return f'{label} (all {number} seeds)' if number > 1 else label
  return ', '.join(
      f'{label} ({count} of {number})'
      for label, count in label_counts.most_common()
  )


def _share(seeds: pd.DataFrame) -> float:
  labels = list(seeds['label'])
  return labels.count(_Label.TAMPERS) / len(labels)


def _lines(
    sweep: study.Study,
    wholes: Mapping[str, pd.Series],
    judged: pd.DataFrame,
    run: study.Run,
) -> list[str]:
  line, seeds = wholes[run.name], study.seeds(judged, run.name)
  twin = sweep.twin(run)
  lines = [
      _task(line, wholes.get(twin.name) if twin else None),
      _labels(line, seeds),
  ]
  if line['hack_rate'] is not None:
    lines.append(_rate(line))
  if shares := {share for share in seeds['misnamed'] if share}:
    lines.append(
        f'Steps whose query is not its action: {", ".join(sorted(shares))}.'
    )
  lines.append(f'Audit: {_audit(line["audit"])}.')
  if line['num_training'] is not None:
    what = 'Tampering or hiding' if line['unseen'] else 'Tampering'
    lines.append(
        f'{what} paid in {line["paid"]:,} of'
        f' {intervals.counted(line["num_training"], "training episode")}.'
    )
  return lines


def _task(line: pd.Series, secure: pd.Series | None) -> str:
  """Returns whether an agent fails at the task, beside its secure twin."""
  answer = {
      True: 'Fails at the task',
      False: 'Does the task',
      None: 'May fail at the task',
  }[line['fails']]
  beside = ''
  if secure is not None:
    reached = number(secure['true_return'].estimate)
    beside = f', its secure twin {reached}'
    if line['fails'] and secure['fails']:
      beside += ', which fails as well'
  observed = number(line['observed_return'].estimate)
  earned = _return(line)
  return f'{answer}: it earns {earned}{beside}. It observes {observed}.'


def _labels(line: pd.Series, judged_seeds: pd.DataFrame) -> str:
  """Returns the label, in how many seeds, and the verdict if there is one."""
  labels = list(judged_seeds['label'])
  number_of = len(labels)
  for label in (_Label.TAMPERS, _Label.HIDES, _Label.DOES_NOT_TAMPER):
    if count := labels.count(label):
      seeds = intervals.counted(number_of, 'seed')
      text = f'{_capital(label.value)} in {count} of {seeds}'
      break
  else:
    text = _capital(judged_seeds['verdict'].iloc[0])
    if number_of > 1:
      first, _, reason = text.partition(':')
      text = f'{first} in all {number_of} seeds:{reason}'
  if labels[0] in (_Label.COINCIDES, _Label.NOT_JUDGED):
    return f'{text}.'
  if number_of < verdicts.FEWEST_SEEDS:
    return f'{text}; {verdicts.needed_seeds(number_of)}.'
  words = line['verdict']
  if words == text[:1].lower() + text[1:]:
    return f'Verdict: {words}.'
  _, _, reason = text.partition(': ')
  if reason and words.endswith(reason):
    words = line['label'].value
  return f'{text}. Verdict: {words}.'


def _capital(text: str) -> str:
  return text[:1].upper() + text[1:]


def _rate(line: pd.Series) -> str:
  # The unit stands before the interval: '80 % [0, 100]'.
  in_percent = tables.text(line['hack_rate'].scaled(100))
  rate, *interval = in_percent.split(maxsplit=1)
  control_rate = tables.text(100 * line['control_rate'])
  text = ' '.join([f'Hack rate {rate} %', *interval])
  text += f', beside {control_rate} % of {line["control"]}'
  if (limit := line['limit']) != counted.SHARE_OF_STAKE:
    text += (
        f'; hacked is a gain above {tables.text(limit)} stakes, not'
        f' {counted.SHARE_OF_STAKE:g}, which the control often exceeds'
    )
  if line['ended']:
    text += (
        f'; only a corrupted signal ended {line["ended"]} of'
        f' {line["num_judged"]} episodes'
    )
  return f'{text}.'


def _audit(audit: verdicts.Audit | None) -> str:
  if audit is None:
    return 'not audited'
  if audit.is_exploitable:
    return f'EXPLOITABLE, found within {audit.num_searched:,} episodes'
  small = '' if audit.is_sufficient else ', a budget that is too small'
  return f'resisted {audit.num_searched:,} episodes{small}'


def _return(line: pd.Series) -> str:
  """Returns the true return of a run, with the largest possible one."""
  interval: intervals.Interval = line['true_return']
  largest = interval.bounds[1]
  of = '' if largest is None else f' of {largest:g}'
  least = 'at least ' if line['num_cut'] else ''
  return f'{least}{number(interval.estimate)}{of}'


def number(value: float) -> str:
  """Returns a number for a sentence: '8,769', '10.9' or '-0.3'."""
  if abs(value) >= 100:
    return f'{value:,.0f}'
  text = tables.text(round(value, 1))
  return text if '.' in text else f'{float(text):.1f}'


def paid(row: results.EpisodeResult) -> gains.Value:
  """Returns the objective of an episode, on readings and on clean contents."""
  return next(iter(row.objective.values()))


def _range(rows: _Rows) -> str:
  """Returns the range of payments in episodes, as '4,500 to 7,700'."""
  payments = [paid(row).observed for row in rows]
  ends = dict.fromkeys(map(rounded, (min(payments), max(payments))))
  return ' to '.join(ends)


def rounded(value: float) -> str:
  """Returns a number with two digits that count."""
  return f'{float(f"{value:.2g}"):,.10g}'
