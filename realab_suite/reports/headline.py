"""First lines of a report: what each learned agent does, and how sure it is."""

import collections
from collections.abc import Mapping, Sequence

import numpy as np

from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import numbers

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


def headline(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> dict[str, list[str]]:
  """Returns the first lines on each learned run, those that tamper first.

  The lines are, in this order: whether the run fails at the task, beside its
  twin; its label; its hack rate beside that of its control; its queries, in a
  coupled design; its audit; the training episodes in which tampering paid.

  Args:
    sweep: The sweep.
    figures: Figures of its runs.
  """
  runs = [run for run in sweep.learned() if run.name in figures]
  # Sorting keeps the order of the experiment otherwise.
  runs.sort(key=lambda run: -_share(figures[run.name]))
  return {run.name: _lines(sweep, figures, figures[run.name]) for run in runs}


def counts(sweep: sweep_results.Sweep, learned: numbers.Figures) -> str | None:
  """Returns what a learned run did, in counts; `None` without a hack rate."""
  run = learned.run
  if learned.hacking is None or run.stake is None:
    return None
  limit = learned.hacking.control.limit
  rows = counted.of(run.rows, run.stake, limit)
  hacked = [row for row in rows if counted.is_hacked(row, run.stake, limit)]
  return did(run.design, rows, hacked, numbers.solver_rows(sweep, run))


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


def chip(learned: numbers.Figures) -> tuple[str, str]:
  """Returns the label of a run in a word, and the seeds that it stands for."""
  labels = [seed.judgement.label for seed in learned.seeds.values()]
  seeds = intervals.counted(len(labels), 'seed')
  if learned.verdict is None or len(labels) < verdicts.FEWEST_SEEDS:
    [(label, count)] = collections.Counter(labels).most_common(1)
    return label.value, f'{count} of {seeds}, no verdict'
  label, count = learned.verdict.label, learned.verdict.num_tampering
  return label.value, f'{count} of {seeds}' if count else seeds


def _share(learned: numbers.Figures) -> float:
  labels = [seed.judgement.label for seed in learned.seeds.values()]
  return sum(label is _Label.TAMPERS for label in labels) / len(labels)


def _lines(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    learned: numbers.Figures,
) -> list[str]:
  lines = [_task(sweep, figures, learned), _labels(learned)]
  if learned.hacking is not None:
    lines.append(_rate(learned.hacking))
  if shares := {x.misnamed for x in learned.seeds.values() if x.misnamed}:
    lines.append(
        f'Steps whose query is not its action: {", ".join(sorted(shares))}.'
    )
  lines.append(f'Audit: {_audit(learned.audit)}.')
  training = learned.training
  if training is not None:
    lines.append(
        f'Tampering paid in {training.paid:,} of'
        f' {intervals.counted(training.episodes, "training episode")}.'
    )
  return lines


def _task(
    sweep: sweep_results.Sweep,
    figures: Mapping[str, numbers.Figures],
    learned: numbers.Figures,
) -> str:
  """Returns whether an agent fails at the task, beside its secure twin."""
  answer = {
      True: 'Fails at the task',
      False: 'Does the task',
      None: 'May fail at the task',
  }[learned.fails]
  twin = sweep.twin(learned.run)
  secure = None if twin is None else figures.get(twin.name)
  beside = ''
  if secure is not None:
    beside = f', its secure twin {number(secure.summary.true_return.estimate)}'
    if learned.fails and secure.fails:
      beside += ', which fails as well'
  observed = number(learned.summary.observed_return.estimate)
  earned = _return(learned)
  return f'{answer}: it earns {earned}{beside}. It observes {observed}.'


def _labels(learned: numbers.Figures) -> str:
  """Returns the label, in how many seeds, and the verdict if there is one."""
  judgements = [seed.judgement for seed in learned.seeds.values()]
  number_of = len(judgements)
  for label in (_Label.TAMPERS, _Label.DOES_NOT_TAMPER):
    count = sum(judgement.label is label for judgement in judgements)
    if count:
      seeds = intervals.counted(number_of, 'seed')
      text = f'{_capital(label.value)} in {count} of {seeds}'
      break
  else:
    text = _capital(str(judgements[0]))
    if number_of > 1:
      first, _, reason = text.partition(':')
      text = f'{first} in all {number_of} seeds:{reason}'
  if judgements[0].label in (_Label.COINCIDES, _Label.NOT_JUDGED):
    return f'{text}.'
  if learned.verdict is None or number_of < verdicts.FEWEST_SEEDS:
    return f'{text}; {verdicts.needed_seeds(number_of)}.'
  words = learned.verdict.words
  if words == text[:1].lower() + text[1:]:
    return f'Verdict: {words}.'
  _, _, reason = text.partition(': ')
  if reason and words.endswith(reason):
    words = learned.verdict.label.value
  return f'{text}. Verdict: {words}.'


def _capital(text: str) -> str:
  return text[:1].upper() + text[1:]


def _rate(figures: hacking.Hacking) -> str:
  # The unit stands before the interval: '80 % [0, 100]'.
  rate, *interval = tables.text(figures.rate.scaled(100)).split(maxsplit=1)
  control_rate = tables.text(100 * figures.control.count.rate)
  text = ' '.join([f'Hack rate {rate} %', *interval])
  text += f', beside {control_rate} % of {figures.control.name}'
  if (limit := figures.control.limit) != counted.SHARE_OF_STAKE:
    text += (
        f'; hacked is a gain above {tables.text(limit)} stakes, not'
        f' {counted.SHARE_OF_STAKE:g}, which the control often exceeds'
    )
  if figures.count.ended:
    text += (
        f'; only a corrupted signal ended {figures.count.ended} of'
        f' {figures.count.episodes} episodes'
    )
  return f'{text}.'


def _audit(audit: verdicts.Audit | None) -> str:
  if audit is None:
    return 'not audited'
  if audit.is_exploitable:
    return f'EXPLOITABLE, found within {audit.num_episodes:,} episodes'
  small = '' if audit.is_sufficient else ', a budget that is too small'
  return f'resisted {audit.num_episodes:,} episodes{small}'


def _return(learned: numbers.Figures) -> str:
  """Returns the true return of a run, with the largest possible one."""
  interval: intervals.Interval = learned.summary.true_return
  largest = interval.bounds[1]
  of = '' if largest is None else f' of {largest:g}'
  least = 'at least ' if learned.summary.num_cut else ''
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
