"""Discrete action sets: named and versioned lists of actions.

An agent that imitates reads the index of an action off a register. The meaning
of an index is therefore part of the design and never changes in a version.
`register` adds sets; designs name them in `action_set`.
"""

from collections.abc import Mapping
import dataclasses
import re
from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry


@final
@dataclasses.dataclass(frozen=True)
class ActionSet:
  """Numbered list of actions; each sets some control elements.

  Attributes:
    name: Name of the set: a lower-case letter, then letters, digits and `_`.
    version: Version of the set, from 1.
    actions: Name and non-zero control elements of each action.
  """

  name: str
  version: int
  actions: tuple[tuple[str, Mapping[str, float]], ...]

  def __post_init__(self) -> None:
    """Checks the fields.

    Raises:
      SpecError: If a field has a value that is not allowed.
    """
    names = [name for name, _ in self.actions]
    values = [x for _, settings in self.actions for x in settings.values()]
    for is_allowed, field, value, allowed in (
        (_is_name(self.name), 'name', self.name, 'a name such as drive'),
        (
            type(self.version) is int and self.version >= 1,
            'version',
            self.version,
            'an integer from 1',
        ),
        (
            names and len(set(names)) == len(names),
            'actions',
            names,
            'one or more, with different names',
        ),
        (np.isfinite(values).all(), 'actions', values, 'finite numbers'),
    ):
      if not is_allowed:
        raise errors.SpecError(
            f'action set {messages.quote(self.name)}: {field}:'
            f' {messages.quote(value)}; must be {allowed}'
        )

  @property
  def key(self) -> str:
    """Name and version, under which the set is registered."""
    return _key(self.name, self.version)

  def __len__(self) -> int:
    return len(self.actions)

  def index(self, action: str) -> int:
    """Returns the index of the action called `action`."""
    return [name for name, _ in self.actions].index(action)

  @property
  def rest(self) -> int:
    """Index of the action that sets no control element.

    Raises:
      SpecError: If there is none.
    """
    for i, (_, settings) in enumerate(self.actions):
      if not settings:
        return i
    raise errors.SpecError(
        f'action set {self.key}: has no action without control elements'
    )

  def contains(self, other: 'ActionSet') -> bool:
    """Returns whether it has all actions of another set, by what they set."""
    own_settings = [settings for _, settings in self.actions]
    return all(settings in own_settings for _, settings in other.actions)

  def extended(self, other: 'ActionSet') -> 'ActionSet':
    """Returns this set, followed by the actions of another that it lacks."""
    own_settings = [settings for _, settings in self.actions]
    added = tuple(
        (f'{other.name}.{name}', settings)
        for name, settings in other.actions
        if settings not in own_settings
    )
    if not added:
      return self
    return ActionSet(self.name, self.version, (*self.actions, *added))

  def translation(self, other: 'ActionSet') -> np.ndarray:
    """Returns the index in another set of each action, `(actions,)` int32.

    Actions that set the same control elements are the same. One that looks up
    or down is waiting in a set that keeps the view level.

    Args:
      other: The other action set.

    Raises:
      SpecError: If the other set lacks an action.
    """
    targets = [settings for _, settings in other.actions]
    is_level = not any('look' in settings for settings in targets)
    own = [
        (name, {} if is_level and set(one) == {'look'} else one)
        for name, one in self.actions
    ]
    if missing := [name for name, one in own if one not in targets]:
      raise errors.SpecError(
          f'action set {other.name} v{other.version} lacks actions of'
          f' {self.name} v{self.version}: {missing}'
      )
    return np.array([targets.index(one) for _, one in own], np.int32)

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


ACTION_SETS: registry.Registry[ActionSet] = registry.Registry('action set')
"""Action sets by name and version, such as `dmlab_like v1`."""


def register(actions: ActionSet) -> ActionSet:
  """Registers an action set, and returns it.

  Raises:
    SpecError: If another set of this name and version exists.
  """
  if actions.key in ACTION_SETS and ACTION_SETS.get(actions.key) == actions:
    return actions
  return ACTION_SETS.add(actions.key)(actions)


def get(name: str, version: int) -> ActionSet:
  """Returns a version of the action set called `name`.

  Raises:
    UnknownNameError: If the set or the version is unknown.
  """
  return ACTION_SETS.get(_key(name, version))


def newest(name: str) -> ActionSet:
  """Returns the newest version of the action set called `name`.

  Raises:
    UnknownNameError: If the set is unknown.
  """
  versions = [ACTION_SETS.get(key) for key in ACTION_SETS]
  named = [actions for actions in versions if actions.name == name]
  if not named:
    names = sorted({actions.name for actions in versions})
    raise errors.UnknownNameError(
        f'action set {messages.quote(name)} is unknown'
        f'{messages.did_you_mean(name, names)}; known are {names}'
    )
  return max(named, key=lambda actions: actions.version)


def _key(name: str, version: int) -> str:
  return f'{name} v{version}'


def _is_name(name: object) -> bool:
  return (
      isinstance(name, str)
      and re.fullmatch('[a-z][a-z0-9_]*', name) is not None
  )


# The action set of DMLab's published agents, and actions of the hand.
DMLAB_LIKE = register(
    ActionSet(
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
)

# The same with a level view: to look up costs nothing, and the sky that is then
# in view spoils films.
DMLAB_LIKE_LEVEL = register(
    ActionSet(
        'dmlab_like',
        2,
        tuple(one for one in DMLAB_LIKE.actions if 'look' not in one[1]),
    )
)

# Walking and turning only: an agent that learns from its camera does not end up
# with the sky in view, and can push blocks but not carry them.
WALK = register(ActionSet('walk', 1, DMLAB_LIKE.actions[:9]))
