"""Budgets with which the commands of the docs take seconds.

Command lines stay as they are in the text; programs do less with them.
"""

import argparse
from collections.abc import Callable
import dataclasses
import os
from typing import Any

from realab_suite.lab.audit import audits
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.verdicts import stakes
from realab_suite.launchers import flags
from realab_suite.reports import films

_MAX_STEPS = 40
_NUM_EPISODES = 2
_NUM_SEEDS = 2
_NUM_RUNS = 2
_BUDGET = 20
# An update of the learners of shipped experiments, whose minibatches are as
# large.
_STEPS = 1024
_TRAINING = {
    'num_envs': 16,
    'steps': _STEPS,
    'checkpoint_every': _STEPS,
    'curve_every': _STEPS,
}


def install() -> None:
  """Makes budgets small in this process, and in those that it forks."""
  stakes.NUM_EPISODES = 6
  films.HEIGHT, films.WIDTHS = 96, {'top_down': 96, 'first_person': 128}
  _replace(flags, 'world', _short)
  _replace(flags, 'num_episodes', lambda number: min(number, _NUM_EPISODES))
  _replace(flags, 'seeds', lambda seeds: seeds[:_NUM_SEEDS])
  _replace(experiment_specs, 'load', _small)
  _replace(audits, 'Settings', _searching_less)
  _replace(argparse.ArgumentParser, 'parse_args', _with_few_steps)


def _replace(owner: Any, name: str, change: Callable[[Any], Any]) -> None:
  """Lets a function return a changed result."""
  function = getattr(owner, name)
  setattr(owner, name, lambda *args, **kw: change(function(*args, **kw)))


def _short(world: Any) -> Any:
  if 'WHOLE_EPISODES' in os.environ:
    return world
  return dataclasses.replace(world, max_steps=min(world.max_steps, _MAX_STEPS))


def _searching_less(settings: audits.Settings) -> audits.Settings:
  return dataclasses.replace(settings, budget=_BUDGET)


def _with_few_steps(chosen: argparse.Namespace) -> argparse.Namespace:
  if 'steps' in chosen:
    chosen.steps = min(chosen.steps, 2 * _STEPS)
  return chosen


def _small(
    experiment: experiment_specs.ExperimentSpec,
) -> experiment_specs.ExperimentSpec:
  """Returns an experiment with short training."""
  content = experiment.to_mapping()
  content['max_steps'] = min(content['max_steps'], _MAX_STEPS)
  content['seeds'] = content['seeds'][:1]
  content['evaluation']['episodes'] = _NUM_EPISODES
  content['training'] |= _TRAINING
  if content['training']['adaptation'] is not None:
    content['training']['adaptation'] = _STEPS
  content['runs'] = dict(list(content['runs'].items())[:_NUM_RUNS])
  for run in content['runs'].values():
    run['steps'] = run['num_seeds'] = None
    run['learner'] = _fitted_soon(run['learner'])
  return experiment_specs.ExperimentSpec.model_validate(content)


def _fitted_soon(options: Any) -> Any:
  """Returns options of a learner whose lengths fit into short training."""
  if not isinstance(options, dict):
    return options
  return {
      name: min(value, _STEPS)
      if name in ('fit_steps', 'clone_steps', 'exploration_steps')
      else _fitted_soon(value)
      for name, value in options.items()
  }
