r"""Figures of the worlds in docs/worlds.md: what solvers earn, and speed.

  python -m benchmarks.suite_table              # solvers, then the page
  python -m benchmarks.suite_table --timing     # speed, on an idle machine
  python -m benchmarks.suite_table --accuracy   # every design, 20 minutes
  python -m benchmarks.suite_table --domains=gates,tidy_up

Figures of the first task of each domain, and the accuracy of clean feedback in
every task, are kept in docs/results/worlds.json, and each run writes
docs/worlds.md again. Worlds have the design that is made
for them, and `instantaneous_reward` if there is none.
"""

import argparse
from collections.abc import Callable, Sequence
import contextlib
import json
import time
from typing import Any

import numpy as np

from benchmarks import timing
from pictures import pages
from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.lab.verdicts import stakes

_GENERAL = 'instantaneous_reward'
_SEED = 1
_TWINS = 20
_NUM_ENVS, _STEPS, _ROUNDS = 256, 50, 5

Cells = dict[str, str]


def earnings(domain: str, task: str) -> Cells:
  """Returns the mean return of a world's solver, and the largest return."""
  batch = suite.load_batch(domain, task, **_options(domain), num_envs=_NUM_ENVS)
  with contextlib.closing(batch):
    most = batch.task.max_true_return
    episodes = _played(batch, batch.task.SOLVER)
  earned = np.mean([episode.true_return for episode in episodes])
  return {'solver': f'{earned:.3g} of {most:g}'}


def accuracy(domain: str, task: str) -> Cells:
  """Returns in how many episodes of a secure twin clean values saturate.

  The solver and random actions play the twin of each design that loads.
  """
  cells = {}
  for design in suite.designs_for(domain):
    options = {'design': design, 'overrides': ['channel=secure']}
    try:
      batch = suite.load_batch(
          domain, task, {'random': _SEED}, num_envs=_TWINS, **options
      )
    except errors.SpecError:  # The page says why.
      continue
    rows = []
    with contextlib.closing(batch):
      for name in (batch.task.SOLVER, stakes.RANDOM):
        rows += _played(batch, name)
        batch.rewind()
    saturation = stakes.saturation(rows)
    saturated = 0 if saturation is None else saturation.saturated
    cells[f'saturated, {design}'] = f'{saturated} of {len(rows)}'
  return cells


def speed(domain: str, task: str) -> Cells:
  """Returns the control steps per second of one world and of a batch."""
  cells = {}
  for column, load, number in (
      ('single', suite.load, {}),
      ('batch', suite.load_batch, {'num_envs': _NUM_ENVS}),
  ):
    env: Any = load(domain, task, **_options(domain), **number)
    with contextlib.closing(env):
      taken = timing.time_rounds({column: _contestant(env)}, _ROUNDS)
    rate = number.get('num_envs', 1) / np.median(taken[column])
    cells[column] = f'{rate:,.0f}'
  return cells


def _options(domain: str) -> dict[str, Any]:
  """Returns the seed and the design of a world."""
  design = domain if domain in suite.designs_for(domain) else _GENERAL
  return {'task_kwargs': {'random': _SEED}, 'design': design}


def _played(batch: Any, name: str) -> list[Any]:
  """Returns an episode of each world of a batch, played by a policy."""
  actor = batch_actors.BatchPolicyActor(policies.make(name), batch, _SEED)
  return evaluate.evaluate_batch(batch, actor)


def _contestant(env: Any) -> Callable[[], float]:
  """Returns a function that plays a while, and returns seconds per step."""
  spec = env.action_spec()
  shape = getattr(env, 'num_envs', None)
  actions = np.random.default_rng(_SEED).uniform(
      spec.minimum,
      spec.maximum,
      (_STEPS, *([] if shape is None else [shape]), *spec.shape),
  )

  def play() -> float:
    env.reset()
    began = time.perf_counter()
    for action in actions:
      env.step(action)
    return (time.perf_counter() - began) / len(actions)

  return play


def main(arguments: Sequence[str] | None = None) -> None:
  """Measures the worlds of some domains."""
  parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
  parser.add_argument('--domains', help='such as gates,tidy_up; default: all')
  parser.add_argument('--timing', action='store_true', help='speed instead')
  parser.add_argument('--accuracy', action='store_true', help='of feedback')
  flags = parser.parse_args(arguments)
  all_domains = [*suite.TASKS_BY_DOMAIN]
  domains = flags.domains.split(',') if flags.domains else all_domains
  if unknown := sorted({*domains} - {*all_domains}):
    parser.error(
        f'--domains={",".join(unknown)}; must be some of {all_domains}'
    )
  measure = speed if flags.timing else earnings
  if flags.accuracy:
    measure = accuracy
  rows = pages.figures()
  for domain in domains:
    tasks = suite.TASKS_BY_DOMAIN[domain]
    for task in tasks if flags.accuracy else tasks[:1]:
      print(domain, task, flush=True)
      rows.setdefault(f'{domain}.{task}', {}).update(measure(domain, task))
  text = json.dumps(rows, indent=1, sort_keys=True)
  pages.FIGURES.write_text(f'{text}\n', encoding='utf-8')
  pages.write()


if __name__ == '__main__':
  main()
