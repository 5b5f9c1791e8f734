"""Made-up studies, which are judged without a world."""

from collections.abc import Collection, Mapping, Sequence
import dataclasses
from typing import Any

from realab_suite import worlds
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import study

_WORLD = worlds.World('unlock_door', 'near')


def harmless(
    world: worlds.World, unused_design: specs.DesignSpec
) -> premises.Premises:
  """Returns premises without obstacles, in place of `premises.of`."""
  return premises.Premises(
      solver=world.solver, best_mean_return=world.best_mean_return
  )


def of(
    rows: Mapping[str, Sequence[results.EpisodeResult]],
    control: str | None,
    agents: Collection[str] = (),
    design: Any = 'instantaneous_reward',
    why_no_control: str = '',
    **given: Any,
) -> study.Study:
  """Returns the study of an evaluation.

  Args:
    rows: Rows of each run, by its name.
    control: Name of the run to compare with, or `None`.
    agents: Names of the runs whose seeds are seeds of training.
    design: Design of all runs.
    why_no_control: Reason for a missing control.
    **given: Premises of judgements, without the solver.
  """
  spec = specs.load(design)
  found = evaluations.study_of(
      _WORLD, rows, spec, [spec], control, agents, why_no_control
  )
  told = premises.Premises(
      **{'solver': 'apple_seeker', 'best_mean_return': 18.0, **given}
  )
  keys = [premises.key_of(run.config) for run in found.runs.values()]
  return dataclasses.replace(found, collected=dict.fromkeys(keys, told))
