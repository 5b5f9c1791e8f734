r"""LaTeX of a report, to \input into a paper; it needs no package."""

from collections.abc import Iterable, Mapping
import re
from typing import Any, Final

from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import caveats
from realab_suite.reports import numbers

FILE: Final = 'report.tex'

_Figures = Mapping[str, numbers.Figures]
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


def text(sweep: sweep_results.Sweep, figures: _Figures) -> str:
  """Returns methods, a table, caveats and versions of a sweep as LaTeX."""
  learned = [figures[x.name] for x in sweep.learned() if x.name in figures]
  reasons = (
      f'{one.run.name}: {one.verdict.words}.'
      for one in learned
      if one.verdict and one.verdict.reason
  )
  lines = [_line(_cells(sweep, figures, one)) for one in learned]
  worlds = _listed(one.run.config['task'] for one in learned)
  widths = ''.join(
      f'p{{\\dimexpr 0.{width}\\linewidth-2\\tabcolsep\\relax}}'
      for width in _COLUMNS.values()
  )
  written = [
      _TABLE
      % (
          escaped(_CAPTION % (worlds, _limits(learned))),
          f'-{begin}' if begin else '',
          widths,
          _line(_COLUMNS),
          '\n'.join(lines[begin : begin + _ROWS_OF_TABLE]),
      )
      for begin in range(0, len(lines), _ROWS_OF_TABLE)
  ]
  return _PAGE % (
      escaped(_methods(sweep, learned)),
      ''.join(written),
      escaped(' '.join([*reasons, *caveats.caveats(sweep, figures)])),
      escaped(_versions(figures)),
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


def _methods(
    sweep: sweep_results.Sweep, learned: Iterable[numbers.Figures]
) -> str:
  """Returns what was trained, for how long and how it was judged."""
  training, runs = sweep.experiment['training'], sweep.experiment['runs']
  agents, lengths, audits = [], [], []
  for one in learned:
    name, design = one.run.name, one.run.design
    learner = design.learner.model_dump() if design.learner else {}
    defence = learner.get('defence')
    defended = f' with the defence {_settings(defence)}' if defence else ''
    agents.append(f'{name} ({one.run.jobs[0].kind} in {design.name}{defended})')
    lengths.append(f'{runs[name].get("steps") or training["steps"]:,}')
    if one.audit:
      found = 'an exploit' if one.audit.is_exploitable else 'no exploit'
      audits.append(f'{found} of {name} in {one.audit.num_episodes:,} episodes')
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


def _limits(learned: Iterable[numbers.Figures]) -> str:
  """Returns the limit of hacked episodes, and the runs that have another."""
  others = [
      f'{tables.text(one.hacking.control.limit)} for {one.run.name}'
      for one in learned
      if one.hacking and one.hacking.control.limit != counted.SHARE_OF_STAKE
  ]
  usual = f'{counted.SHARE_OF_STAKE} stakes'
  if not others:
    return usual
  return (
      f'{usual}, or where the control gains as much in more than a fifth of its'
      f' episodes, the 95 % quantile of its gains ({_listed(others)})'
  )


def _cells(
    sweep: sweep_results.Sweep, figures: _Figures, one: numbers.Figures
) -> list[str]:
  """Returns the cells of a learned run; reasons of verdicts are elsewhere."""
  twin = sweep.twin(one.run)
  secure = None if twin is None else figures.get(twin.name)
  if one.verdict is None or len(one.seeds) < verdicts.FEWEST_SEEDS:
    said = one.label
  else:
    said = one.verdict.words.partition(':')[0]
  hacked = one.hacking
  return [
      one.run.name,
      str(one.columns['true return']),
      str(secure.columns['true return']) if secure else tables.NOTHING,
      tables.text(hacked and hacked.rate.scaled(100)),
      tables.text(hacked and 100 * hacked.control.count.rate),
      said,
  ]


def _line(cells: Iterable[str]) -> str:
  """Returns a line of the table, whose cells break before an interval."""
  line = ' & '.join(f'\\raggedright {escaped(cell)}' for cell in cells)
  line = re.sub(r'(\[[^],]*), ', r'\1,\\penalty500\\ ', line)
  return rf'{line} \tabularnewline'


def _versions(figures: _Figures) -> str:
  """Returns the versions of what the rows depend on."""
  runs = [one.run for one in figures.values()]
  of_all = [config['versions'] for x in runs for config in x.configs.values()]
  for row in (row for run in runs for row in run.rows):
    world = f'dynamics of {row.info.domain}.{row.info.task}'
    of_all.append({'code': 'unknown', **row.info.versions})
    of_all.append({world: str(row.info.dynamics_version)})
  found: dict[str, list[str]] = {}
  for name, version in (item for one in of_all for item in one.items()):
    found.setdefault(name, []).append(version)
  return f'{_settings({name: _listed(x) for name, x in found.items()})}.'
