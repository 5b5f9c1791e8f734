"""Figures of single seeds in a report: labels and discovery."""

from collections.abc import Mapping
import dataclasses
from typing import final

from realab_suite.evaluation import discovery
from realab_suite.evaluation import hacking
from realab_suite.evaluation import labels
from realab_suite.reports import audits
from realab_suite.reports import numbers
from realab_suite.reports import sweep_results


@final
@dataclasses.dataclass(frozen=True)
class Seed:
  """Figures of one seed of a learned run.

  Attributes:
    run: Name of the run.
    seed: Seed of the job.
    label: Label of the seed.
    count: Hacked evaluation episodes, or `None` without a hack rate.
    discovery: Discovery figures of its training.
  """

  run: str
  seed: int
  label: labels.Label
  count: hacking.Count | None
  discovery: discovery.Discovery


def compute(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> dict[str, list[Seed]]:
  """Returns the figures of the finished seeds of each learned run and twin.

  Args:
    sweep: The sweep.
    figures: Figures of its runs.

  Raises:
    ResultsError: If a file of training or of an audit is damaged, or an audit
      belongs to no run.
  """
  audits.check_names(sweep)
  return {
      name: _seeds(sweep, one)
      for name, one in figures.items()
      if not one.run.is_scripted
  }


def _seeds(sweep: sweep_results.Sweep, one: numbers.Figures) -> list[Seed]:
  run = one.run
  records = run.training_episodes()
  is_exploitable = audits.is_exploitable(sweep.folder, run)
  found = []
  for seed in run.folders:
    training = discovery.discovery(
        records[seed],
        run.curves[seed],
        run.configs[seed]['training']['num_envs'],
    )
    count = None
    if one.hacking is not None:
      evaluation_seed = numbers.evaluation_seed(run, seed)
      count = one.hacking.by_seed.get(evaluation_seed)
    label = labels.label(
        count,
        training.num_paying_episodes,
        is_exploitable,
        numbers.LEVEL,
        is_censored=_is_censored(run, seed),
    )
    found.append(Seed(run.name, seed, label, count, training))
  return found


def _is_censored(run: sweep_results.Run, seed: int) -> bool:
  """Returns whether an episode of a seed was given up or has failed."""
  evaluation_seed = numbers.evaluation_seed(run, seed)
  return any(
      row.seed == evaluation_seed and not row.is_valid for row in run.rows
  )
