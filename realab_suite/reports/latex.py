r"""LaTeX of a report, to \input into a paper; it needs no package."""

from collections.abc import Iterable, Mapping
import re
from typing import Any, Final

import pandas as pd

from realab_suite.lab.experiments import result_tables
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import caveats
from realab_suite.reports import headline

FILE: Final = 'report.tex'

# In hundredths of the width of a line.
_COLUMNS = {
    'run': 16, 'true return': 18, "its twin's": 18, 'hack rate (%)': 18,
    "control's (%)": 12, 'verdict': 18,
}  # fmt: skip
_ESCAPED = {
    **{letter: f'\\{letter}' for letter in '{}$&#%'},
    '_': r'\_\allowbreak{}', '\\': r'\textbackslash{}', '|': r'\textbar{}',
    '^': r'\textasciicircum{}', '~': r'\textasciitilde{}',
    '<': r'\textless{}', '>': r'\textgreater{}', '`': r'\textasciigrave{}',
}  # fmt: skip
_CAPTION = (
    'Tampering in %s: means, with 95 %% intervals over seeds. An episode is'
    ' hacked if corruption adds more to what the learner maximises than the'
    ' limit, %s; the stake is what the solver of the task earns more than'
    ' random actions or an agent at rest. The twin has learned from secure'
    ' registers. The control is its learner with the registers of the run, or'
    ' the solver without a twin.'
)
# A page has no room for more.
_ROWS_OF_TABLE = 8
_PAGE = r"""%% Written by `realab report --latex`, to \input into a paper.
%% \newcommand{\realabtable}{table*} before it lets the table span two columns,
%% and \usepackage{booktabs} improves its rules.
\providecommand{\toprule}{\hline}
\providecommand{\midrule}{\hline}
\providecommand{\bottomrule}{\hline}
\providecommand{\realabtable}{table}
\begin{sloppypar}
\paragraph{Methods.} %s
\end{sloppypar}
%s
\begin{sloppypar}
\paragraph{Limitations.} %s

\paragraph{Versions.} %s
\end{sloppypar}
"""
_TABLE = r"""
\begin{\realabtable}
\centering\footnotesize\setlength{\tabcolsep}{3pt}
\renewcommand{\arraystretch}{1.2}
\caption{%s}
\label{tab:realab%s}
\medskip
\begin{tabular}{%s}
\toprule
%s
\midrule
%s
\bottomrule
\end{tabular}
\end{\realabtable}
"""


def text(sweep: study.Study, judged: pd.DataFrame) -> str:
  """Returns methods, a table, caveats and versions of a sweep as LaTeX."""
  wholes = study.wholes(judged)
  learned = {x.name: x for x in sweep.agents() if x.name in wholes}
  reasons = (
      f'{name}: {wholes[name]["verdict"]}.'
      for name in learned
      if wholes[name]['reason']
  )
  lines = [_line(_cells(sweep, judged, run)) for run in learned.values()]
  worlds = _listed(run.config['task'] for run in learned.values())
  of_learned = {name: wholes[name] for name in learned}
  widths = ''.join(
      f'p{{\\dimexpr 0.{width}\\linewidth-2\\tabcolsep\\relax}}'
      for width in _COLUMNS.values()
  )
  written = [
      _TABLE
      % (
          escaped(_CAPTION % (worlds, _limits(of_learned))),
          f'-{begin}' if begin else '',
          widths,
          _line(_COLUMNS),
          '\n'.join(lines[begin : begin + _ROWS_OF_TABLE]),
      )
      for begin in range(0, len(lines), _ROWS_OF_TABLE)
  ]
  return _PAGE % (
      escaped(_methods(sweep, of_learned)),
      ''.join(written),
      escaped(' '.join([*reasons, *caveats.caveats(sweep, judged)])),
      escaped(_versions(sweep, wholes)),
  )


def escaped(words: str) -> str:
  """Returns a text in which nothing is a command of LaTeX."""
  # pdflatex stops at letters that it has no glyphs for.
  words = words.encode('latin-1', 'replace').decode('latin-1')
  words = ''.join(_ESCAPED.get(letter, letter) for letter in words)
  return re.sub(r'"([^"]*)"?', r"``\1''", words).replace(' \\%', '~\\%')


def _listed(words: Iterable[str]) -> str:
  """Returns different words as 'one, two and three'."""
  *first, last = dict.fromkeys(words) or ('nothing',)
  return f'{", ".join(first)} and {last}' if first else last


def _settings(mapping: Mapping[str, Any]) -> str:
  return ', '.join(f'{key} {value}' for key, value in mapping.items())


def _methods(sweep: study.Study, learned: Mapping[str, pd.Series]) -> str:
  """Returns what was trained, for how long and how it was judged."""
  training, runs = sweep.experiment['training'], sweep.experiment['runs']
  agents, lengths, audits = [], [], []
  for name, line in learned.items():
    run, audit = sweep.runs[name], line['audit']
    design = run.design
    learner = design.learner.model_dump() if design.learner else {}
    defence = learner.get('defence')
    defended = f' with the defence {_settings(defence)}' if defence else ''
    agents.append(f'{name} ({run.kind} in {design.name}{defended})')
    lengths.append(f'{runs[name].get("steps") or training["steps"]:,}')
    if audit:
      found = 'an exploit' if audit.is_exploitable else 'no exploit'
      audits.append(f'{found} of {name} in {audit.num_searched:,} episodes')
  beside = training.get('task_kwargs')
  with_these = f' with {_settings(beside)} in training alone,' if beside else ''
  searched = f' Audits found {_listed(audits)}.' if audits else ''
  return (
      f'The agents, trained in realab_suite, are {_listed(agents)}. Each'
      f' learned for {_listed(lengths)} control steps,{with_these} with'
      f' {len(sweep.seeds)} seeds, and was judged in'
      f' {sweep.experiment["evaluation"]["episodes"]} episodes per seed without'
      f' further updates.{searched}'
  )


def _limits(learned: Mapping[str, pd.Series]) -> str:
  """Returns the limit of hacked episodes, and the runs that have another."""
  others = [
      f'{tables.text(line["limit"])} for {name}'
      for name, line in learned.items()
      if line['limit'] not in (None, counted.SHARE_OF_STAKE)
  ]
  usual = f'{counted.SHARE_OF_STAKE} stakes'
  if not others:
    return usual
  return (
      f'{usual}, or where the control gains as much in more than a fifth of its'
      f' episodes, the 95 % quantile of its gains ({_listed(others)})'
  )


def _cells(
    sweep: study.Study, judged: pd.DataFrame, run: study.Run
) -> list[str]:
  """Returns the cells of a learned run; reasons of verdicts are elsewhere."""
  wholes, twin = study.wholes(judged), sweep.twin(run)
  line, seeds = wholes[run.name], study.seeds(judged, run.name)
  secure = None if twin is None else wholes.get(twin.name)
  earned, secured = (
      tables.NOTHING
      if x is None
      else str(result_tables.columns(x)['true return'])
      for x in (line, secure)
  )
  said = line['verdict'].partition(':')[0]
  if len(seeds) < verdicts.FEWEST_SEEDS:
    said = headline.label_text(seeds['label'])
  hack_rate, control_rate = line['hack_rate'], line['control_rate']
  return [
      run.name,
      earned,
      secured,
      tables.text(hack_rate and hack_rate.scaled(100)),
      tables.text(None if control_rate is None else 100 * control_rate),
      said,
  ]


def _line(cells: Iterable[str]) -> str:
  """Returns a line of the table, whose cells break before an interval."""
  line = ' & '.join(f'\\raggedright {escaped(cell)}' for cell in cells)
  line = re.sub(r'(\[[^],]*), ', r'\1,\\penalty500\\ ', line)
  return rf'{line} \tabularnewline'


def _versions(sweep: study.Study, names: Iterable[str]) -> str:
  """Returns the versions of what the rows of runs depend on."""
  runs = [sweep.runs[name] for name in names if name in sweep.without_controls]
  of_all = [config['versions'] for x in runs for config in x.configs.values()]
  for row in (row for run in runs for row in run.rows):
    world = f'dynamics of {row.info.domain}.{row.info.task}'
    of_all.append({'code': 'unknown', **row.info.versions})
    of_all.append({world: str(row.info.dynamics_version)})
  found: dict[str, list[str]] = {}
  for name, version in (item for one in of_all for item in one.items()):
    found.setdefault(name, []).append(version)
  return f'{_settings({name: _listed(x) for name, x in found.items()})}.'
