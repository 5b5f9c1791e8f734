"""A person at the keyboard of a page, as a policy."""

from collections.abc import Callable
from typing import Any, final

import numpy as np

from realab_suite.policies import action_sets
from realab_suite.policies import base

# Each key sets control elements. Letters and arrows are equivalent.
_KEYS: dict[str, dict[str, float]] = {
    'KeyW': {'forward': 1.0},
    'ArrowUp': {'forward': 1.0},
    'KeyS': {'forward': -1.0},
    'ArrowDown': {'forward': -1.0},
    'KeyA': {'turn': 1.0},
    'ArrowLeft': {'turn': 1.0},
    'KeyD': {'turn': -1.0},
    'ArrowRight': {'turn': -1.0},
    'KeyQ': {'strafe': 1.0},
    'KeyE': {'strafe': -1.0},
    'KeyR': {'look': 1.0},
    'KeyF': {'look': -1.0},
    'KeyG': {'grasp': 1.0},
    'KeyH': {'grasp': -1.0},
    'KeyT': {'throw': 1.0},
}


@final
class Keys:
  """Keys that a person holds, and those pressed since the last step."""

  def __init__(self) -> None:
    self._held: list[str] = []
    self._tapped: list[str] = []

  def press(self, code: str) -> None:
    """Adds a key, by its code in browsers, such as KeyW."""
    if code in _KEYS and code not in self._held:
      self._held.append(code)
      self._tapped.append(code)

  def release(self, code: str) -> None:
    """Removes a key. If no step saw it, the next one does."""
    if code in self._held:
      self._held.remove(code)

  def release_all(self) -> None:
    """Removes all keys, for example when the page has lost the focus."""
    self._held.clear()
    self._tapped.clear()

  def take(self) -> list[str]:
    """Returns the keys of a control step, the earliest first."""
    keys = [*self._held, *(k for k in self._tapped if k not in self._held)]
    self._tapped.clear()
    return keys


def action(keys: list[str], action_set: action_sets.ActionSet) -> int:
  """Returns the index of the action that keys stand for.

  Keys that no action combines are dropped, the earliest first.

  Args:
    keys: Codes of the keys, the earliest first.
    action_set: Actions to choose from.

  Raises:
    SpecError: If the person waits, and no action does.
  """
  actions = [settings for _, settings in action_set.actions]
  for first in range(len(keys)):
    wanted: dict[str, float] = {}
    for key in keys[first:]:
      for element, value in _KEYS[key].items():
        wanted[element] = wanted.get(element, 0.0) + value
    wanted = {element: value for element, value in wanted.items() if value}
    if wanted in actions:
      return actions.index(wanted)
  return action_set.rest


@final
class Keyboard(base.Policy):
  """Policy of a person, who acts by keys."""

  def __init__(
      self, take: Callable[[], list[str]], action_set: action_sets.ActionSet
  ) -> None:
    """Makes the policy.

    Args:
      take: Returns the keys of a control step, and is called once in each.
      action_set: Actions to choose from.
    """
    self._take, self._action_set = take, action_set

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._action_set

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del observation, episode_start, key
    return np.asarray(action(self._take(), self._action_set)), state
