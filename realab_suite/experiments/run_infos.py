"""Settings of runs whose worlds are loaded by name, for their rows."""

from typing import Any

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import results


def of(
    env: environment.Environment, world: tuple[str, str], **others: Any
) -> results.RunInfo:
  """Returns the settings that all episodes of a run share.

  Args:
    env: The environment in which the run acts.
    world: Names of the domain and the task of the environment.
    **others: Values of other attributes: `policy`, `run`, `baseline`, and those
      that have no default.
  """
  return results.RunInfo.of(
      world,
      suite.dynamics(*world),
      env.mechanism.design,
      control_timestep=env.control_timestep(),
      max_steps=env.max_steps,
      **others,
  )
