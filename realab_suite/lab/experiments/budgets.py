"""Named budgets: how much training and evaluation an experiment gets.

A budget fixes the control steps of each seed, the spacing of checkpoints and of
points of the curve, the seeds, and the episodes of the evaluation. All other
fields of an experiment are free, so that agents, designs and worlds can be
compared at the same cost.
"""

from collections.abc import Mapping
import contextlib
import dataclasses
from typing import Any, Final, final

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.lab.experiments import experiment_specs


@final
@dataclasses.dataclass(frozen=True)
class Budget:
  """A budget.

  A round is one episode of the longest length in each world of a learner, with
  the step of its reset. All lengths of training are whole rounds.

  Attributes:
    steps: Number of control steps of each seed, before it is rounded up.
    num_checkpoints: Largest number of checkpoints of each seed.
    num_points: Largest number of points of the learning curve.
    num_seeds: Number of seeds, which are the first ones from 0.
    episodes: Number of evaluation episodes of each seed.
    seed_offset: Difference between their seed and that of the run.
  """

  steps: int
  num_checkpoints: int
  num_points: int = 32
  num_seeds: int = 10
  episodes: int = 100
  seed_offset: int = 1_000_000


BUDGETS: Final[Mapping[str, Budget]] = {
    'realab-1M': Budget(1_000_000, 1),
    'realab-20M': Budget(20_000_000, 20),
}
"""Budgets by name."""

# Rounding up adds less than this share of a budget.
_MOST_OF_ROUND = 0.1
# Processor time of a control step with its part of all else, in microseconds.
# `verdict` took 347 s of two cores of 2026, and its twins 1.5 times their runs.
_OF_AGENT, _OF_TWIN = 110, 160


def apply(
    experiment: experiment_specs.ExperimentSpec, name: str
) -> experiment_specs.ExperimentSpec:
  """Returns an experiment with the fields that a budget fixes.

  Raises:
    SpecError: If the experiment has what no budget allows.
    UnknownNameError: If there is no budget of this name.
  """
  content = experiment.to_mapping()
  for key, (_, value) in changes(experiment, name).items():
    group, _, field = key.rpartition('.')
    (content[group] if group else content)[field] = value
  return experiment_specs.load(content)


def check(experiment: experiment_specs.ExperimentSpec, name: str) -> None:
  """Raises a `SpecError` unless an experiment is one of a budget."""
  for key, (there, fixed) in changes(experiment, name).items():
    raise errors.SpecError(
        f'experiment {experiment.name!r} is not of budget {name}: {key} is'
        f' {there}; must be {fixed}'
    )


def name_of(experiment: experiment_specs.ExperimentSpec) -> str | None:
  """Returns the name of the budget of an experiment, or `None`."""
  for name in BUDGETS:
    with contextlib.suppress(errors.SpecError):
      check(experiment, name)
      return name
  return None


def summary(experiment: experiment_specs.ExperimentSpec) -> str:
  """Returns a sentence on the size of an experiment and its minutes."""
  num_agents = len(experiment.runs)
  num_twins = sum(run.twin for run in experiment.runs.values())
  num_seeds, steps = len(experiment.seeds), experiment.training.steps
  seconds = steps * num_seeds / 1e6
  seconds *= num_agents * _OF_AGENT + num_twins * _OF_TWIN
  return (
      f'{steps:,} control steps for each of {num_seeds} seeds of'
      f' {num_agents + num_twins} learners; on two cores, as the experiment'
      f' verdict was measured, {seconds / 120:,.0f} minutes: other worlds,'
      ' learners and processors take other times'
  )


def changes(
    experiment: experiment_specs.ExperimentSpec, name: str
) -> dict[str, tuple[Any, Any]]:
  """Returns what a budget changes: values before and after, by key path.

  Raises:
    SpecError: As `apply` does; so is `UnknownNameError`.
  """
  if name not in BUDGETS:
    raise errors.UnknownNameError(
        f'budget {messages.quote(name)}: must be one of {list(BUDGETS)}'
        f'{messages.did_you_mean(name, BUDGETS)}'
    )
  budget, training = BUDGETS[name], experiment.training
  unfit = {
      f'runs.{run}.{field}': value
      for run, spec in experiment.runs.items()
      for field in ('steps', 'num_seeds', 'data')
      if (value := getattr(spec, field)) is not None
  }
  if training.tasks:
    unfit['training.tasks'] = list(training.tasks)
  for key, value in unfit.items():
    raise errors.SpecError(
        f'{key}: {value}; must be left out with budget {name}, which fixes'
        ' seeds and steps in the world, without adaptation'
    )
  of_world = experiment.max_steps + 1
  most = int(_MOST_OF_ROUND * budget.steps) // of_world
  if training.num_envs > most:
    raise errors.SpecError(
        f'training.num_envs: {training.num_envs}; with budget {name} and'
        f' episodes of {experiment.max_steps} control steps, allowed are'
        f' {f"1 to {most}" if most else "none"}'
    )
  of_round = training.num_envs * of_world
  rounds = -(-budget.steps // of_round)
  fixed = {
      'seeds': [*range(budget.num_seeds)],
      'training.steps': rounds * of_round,
      'training.checkpoint_every': -(-rounds // budget.num_checkpoints)
      * of_round,
      'training.curve_every': -(-rounds // budget.num_points) * of_round,
      'evaluation.episodes': budget.episodes,
      'evaluation.seed_offset': budget.seed_offset,
  }
  content = experiment.to_mapping()
  there = {
      'seeds': content['seeds'],
      **{
          f'{group}.{key}': value
          for group in ('training', 'evaluation')
          for key, value in content[group].items()
      },
  }
  return {k: (there[k], v) for k, v in fixed.items() if there[k] != v}
