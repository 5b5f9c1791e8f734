"""Stakes in the folder of an experiment, which are measured only once."""

import contextlib
import fcntl
import pathlib
from typing import Final

from realab_suite import worlds
from realab_suite.config import validation
from realab_suite.feedback import specs
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import stakes

FOLDER: Final = 'stakes'
"""Folder of the stakes in the folder of an experiment."""


def stakes_of(
    world: worlds.World, design: specs.DesignSpec, folder: pathlib.Path
) -> stakes.Stakes | None:
  """Returns the stakes of a design, and measures and keeps those that are new.

  Args:
    world: The world.
    design: The design.
    folder: Folder of the experiment.

  Returns:
    The stakes, or `None`; see `judging.stakes_of`.

  Raises:
    ResultsError: If a file is not JSON or cannot be read or written.
    SpecError: If it is damaged otherwise.
  """
  key = judging.key_of_stakes(world, design)
  if key is None:
    return None
  path = folder / FOLDER / f'{key}.json'
  with contextlib.ExitStack() as stack:
    with storage.explained(path):
      path.parent.mkdir(parents=True, exist_ok=True)
      lock = stack.enter_context(path.with_suffix('.lock').open('w'))
      # A job that needs the same stakes waits here until another has them.
      fcntl.flock(lock, fcntl.LOCK_EX)
    if path.exists():
      content = storage.read_json(path)
      kept = validation.validate(stakes.Stakes, content, str(path))
      if kept.key == key:
        return kept
    stake = judging.stakes_of(world, design)
    if stake is not None:
      storage.write_json(path, stake.model_dump())
    return stake
