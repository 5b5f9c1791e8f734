"""Discrete action sets: named and versioned lists of actions.

An agent that imitates reads the index of an action off a register. The meaning
of an index is therefore part of the design and never changes in a version.
"""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np

from realab_suite import errors


@final
@dataclasses.dataclass(frozen=True)
class ActionSet:
  """Numbered list of actions; each sets some control elements.

  Attributes:
    name: Name of the set.
    version: Version of the set.
    actions: Name and non-zero control elements of each action.
  """

  name: str
  version: int
  actions: tuple[tuple[str, Mapping[str, float]], ...]

  def __len__(self) -> int:
    return len(self.actions)

  def index(self, action: str) -> int:
    """Returns the index of the action called `action`."""
    return [name for name, _ in self.actions].index(action)

  def table(self, elements: tuple[str, ...]) -> np.ndarray:
    """Returns the control vectors of all actions, `(actions, elements)`.

    Args:
      elements: Names of the control elements, in order.

    Raises:
      SpecError: If an action sets an element that is not in `elements`.
    """
    table = np.zeros((len(self.actions), len(elements)))
    for i, (name, settings) in enumerate(self.actions):
      for element, value in settings.items():
        if element not in elements:
          raise errors.SpecError(
              f'action set {self.name} v{self.version}: action {name!r} sets'
              f' {element!r}; this world has {list(elements)}'
          )
        table[i, elements.index(element)] = value
    return table


# The action set of DMLab's published agents, and actions of the hand.
DMLAB_LIKE = ActionSet(
    'dmlab_like',
    1,
    (
        ('wait', {}),
        ('forward', {'forward': 1.0}),
        ('backward', {'forward': -1.0}),
        ('strafe_left', {'strafe': 1.0}),
        ('strafe_right', {'strafe': -1.0}),
        ('turn_left', {'turn': 1.0}),
        ('turn_right', {'turn': -1.0}),
        ('forward_turn_left', {'forward': 1.0, 'turn': 1.0}),
        ('forward_turn_right', {'forward': 1.0, 'turn': -1.0}),
        ('look_up', {'look': 1.0}),
        ('look_down', {'look': -1.0}),
        ('grasp', {'grasp': 1.0}),
        ('let_go', {'grasp': -1.0}),
        ('throw', {'throw': 1.0}),
    ),
)

ACTION_SETS: Mapping[tuple[str, int], ActionSet] = {
    (actions.name, actions.version): actions for actions in (DMLAB_LIKE,)
}


def get(name: str, version: int) -> ActionSet:
  """Returns a version of the action set called `name`.

  Raises:
    UnknownNameError: If the set or the version is unknown.
  """
  if (name, version) not in ACTION_SETS:
    known = [f'{n} v{v}' for n, v in sorted(ACTION_SETS)]
    raise errors.UnknownNameError(
        f'action set {name!r} v{version} is unknown; known are {known}'
    )
  return ACTION_SETS[name, version]
