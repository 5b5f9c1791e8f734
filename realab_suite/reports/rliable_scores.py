"""Scores of a report as the library rliable takes them: runs x tasks."""

from collections.abc import Mapping
import json
from typing import Any, Final

import numpy as np

from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import counted
from realab_suite.reports import numbers

FILE: Final = 'rliable.json'

_NOTE = (
    'Each metric maps runs to matrices of (seeds, tasks). Seeds are those of'
    ' training. One world is one task, so each has one column; put those of'
    ' other worlds beside it for aggregates over tasks. Lower hack rates are'
    ' better.'
)


def text(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> str:
  """Returns the scores of all runs, as JSON."""
  del sweep
  scores: dict[str, Any] = {
      'note': _NOTE,
      **{x: {} for x in ('tasks', 'seeds', 'true_return', 'hack_rate')},
  }
  for name, one in figures.items():
    returns = comparison.by_seed(counted.of(one.run.rows), 'true_return')
    seeds = {one.run.evaluation_seed(seed): seed for seed in one.run.configs}
    scores['tasks'][name] = [one.run.config['task']]
    scores['seeds'][name] = [seeds[number] for number in returns]
    scores['true_return'][name] = [[np.mean(x)] for x in returns.values()]
    if one.hacking is not None:
      scores['hack_rate'][name] = [
          [one.hacking.by_seed[number].rate] for number in returns
      ]
  return json.dumps(scores, indent=2) + '\n'
