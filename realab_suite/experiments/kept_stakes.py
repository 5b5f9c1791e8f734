"""Stakes in the folder of an experiment, which are measured only once."""

import os
import pathlib
from typing import Final

from realab_suite import worlds
from realab_suite.config import validation
from realab_suite.evaluation import stakes
from realab_suite.experiments import storage
from realab_suite.feedback import specs

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
    The stakes, or `None`; see `worlds.stakes_of`.

  Raises:
    ResultsError: If a file is not JSON or cannot be read or written.
    SpecError: If it is damaged otherwise.
  """
  key = worlds.key_of_stakes(world, design)
  if key is None:
    return None
  path = folder / FOLDER / f'{key}.json'
  if path.exists():
    content = storage.read_json(path)
    kept = validation.validate(stakes.Stakes, content, str(path))
    if kept.key == key:
      return kept
  found = worlds.stakes_of(world, design)
  if found is not None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Jobs that start together measure the same stakes at the same time.
    partial = path.with_suffix(f'.{os.getpid()}')
    storage.write_json(partial, found.model_dump())
    with storage.explained(path):
      os.replace(partial, path)
  return found
