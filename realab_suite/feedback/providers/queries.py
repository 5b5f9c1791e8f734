"""Helpers for questions: queried actions and their values, clips, signs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from realab_suite.config import messages


def index(reading: np.ndarray, num_actions: int) -> np.ndarray:
  """Returns the index of the action nearest to a reading, `(...)` int.

  Args:
    reading: Readings of a query register, `(...)`.
    num_actions: Number of actions.
  """
  return np.clip(np.rint(reading), 0, num_actions - 1).astype(int)


def pick(values: np.ndarray, action: np.ndarray) -> np.ndarray:
  """Returns the value of one action in each world, `(...)`.

  Args:
    values: Value of each action, `(..., actions)`.
    action: Index of the action, `(...)` int.
  """
  picked = np.take_along_axis(values, np.asarray(action)[..., np.newaxis], -1)
  return picked[..., 0]


def check_clip(design: Any, register: str, clip: int) -> None:
  """Checks that a learner of comparisons counts the same clips.

  Args:
    design: The `specs.DesignSpec`.
    register: Name of the register with comparisons.
    clip: Length of each clip, in steps.

  Raises:
    ValueError: If the learner of this register counts others.
  """
  learner = (design.learner and design.learner.model_extra) or {}
  defence = learner.get('defence')
  if learner.get('reward') != register or not isinstance(defence, Mapping):
    return
  if (learner_clip := defence.get('clip', clip)) != clip:
    raise ValueError(
        f'learner.defence.clip: {messages.quote(learner_clip)}; must be that of'
        f' the comparisons, {clip}'
    )


def place_of(step: Any, clip: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the place of a step in a pair of clips, and whether it ends it.

  Places count from 0, steps from 1; the first pair begins with the episode.
  """
  place = np.asarray((step - 1) % (2 * clip))
  return place, np.asarray(place == 2 * clip - 1)


def sign(difference: np.ndarray, tolerance: float) -> np.ndarray:
  """Returns 1, -1, or 0 where a difference is within a tolerance, `(...)`."""
  is_clear = np.abs(difference) > tolerance
  return np.where(is_clear, np.sign(difference), 0.0)
