"""Discrete action sets: named and versioned lists of things to do.

An agent that imitates reads the index of an action off a register, so what an
index stands for is part of the design and never changes for a given version.
"""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np

from realab_suite import errors


@final
@dataclasses.dataclass(frozen=True)
class ActionSet:
  """A numbered list of actions, each a setting of some control elements.

  Attributes:
    name: The name of the set.
    version: Which list of that name.
    actions: For each action, its name and its non-zero control elements.
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
    """Returns every action as a control vector, `(actions, elements)`.

    Args:
      elements: The names of the control elements, in order.

    Raises:
      SpecError: If an action sets an element that there is not.
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


# After the action set that DMLab's published agents use, with a hand.
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
    UnknownNameError: If there is no such set or version.
  """
  if (name, version) not in ACTION_SETS:
    known = [f'{n} v{v}' for n, v in sorted(ACTION_SETS)]
    raise errors.UnknownNameError(
        f'action set {name!r} v{version} is unknown; known are {known}'
    )
  return ACTION_SETS[name, version]
