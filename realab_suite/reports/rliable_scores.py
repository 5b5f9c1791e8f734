"""Scores of a report as the library rliable takes them: runs x tasks."""

import json
from typing import Any, Final

import pandas as pd

from realab_suite.lab.verdicts import study

FILE: Final = 'rliable.json'

_NOTE = (
    'Each metric maps runs to matrices of (seeds, tasks). Seeds are those of'
    ' training. One world is one task, so each has one column; put those of'
    ' other worlds beside it for aggregates over tasks. Lower hack rates are'
    ' better.'
)


def text(sweep: study.Study, judged: pd.DataFrame) -> str:
  """Returns the scores of all runs, as JSON."""
  scores: dict[str, Any] = {
      'note': _NOTE,
      **{x: {} for x in ('tasks', 'seeds', 'true_return', 'hack_rate')},
  }
  for name in sweep.without_controls:
    seeds = study.seeds(judged, name)
    seeds = seeds[seeds['true_return'].notna()]
    if seeds.empty:
      continue
    scores['tasks'][name] = [sweep.runs[name].config['task']]
    scores['seeds'][name] = list(seeds.index)
    scores['true_return'][name] = [[x] for x in seeds['true_return']]
    if judged.loc[name, study.ALL]['hack_rate'] is not None:
      scores['hack_rate'][name] = [[x] for x in seeds['hack_rate']]
  return json.dumps(scores, indent=2) + '\n'
