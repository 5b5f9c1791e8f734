"""What a policy is here: a pure function with an explicit state.

A policy stands for an agent (in evaluation and in tests) or for a supervisor
(inside a provider that demonstrates or advises). It sees what an agent sees.
"""

import abc
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.policies import action_sets

Observation = Mapping[str, np.ndarray]


class Policy(abc.ABC):
  """Chooses actions, by index into an action set."""

  @property
  def action_set(self) -> action_sets.ActionSet:
    """What the indices stand for."""
    return action_sets.DMLAB_LIKE

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the memory before the first step: arrays, or dicts of them.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for many.
    """
    del batch_shape
    return ()

  @abc.abstractmethod
  def step(
      self,
      observation: Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    """Chooses an action.

    Args:
      observation: What the agent sees; leading axes are worlds.
      episode_start: Whether the episode begins here, `(...)`, bool.
      key: A random key per world, `(..., 2)`, uint64; see `random_keys`.
      state: What `initial_state` or the last `step` returned.

    Returns:
      The index of the action, `(...)`, int, and the next memory.
    """


class ValueFunction(abc.ABC):
  """Says how good each action of an action set is."""

  @property
  def action_set(self) -> action_sets.ActionSet:
    """What the values are values of."""
    return action_sets.DMLAB_LIKE

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the memory before the first step."""
    del batch_shape
    return ()

  @abc.abstractmethod
  def step(
      self,
      observation: Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    """Returns the value of every action, `(..., actions)`, and the memory."""


POLICIES: registry.Registry[Callable[..., Policy]] = registry.Registry('policy')
VALUE_FUNCTIONS: registry.Registry[Callable[..., ValueFunction]] = (
    registry.Registry('value function')
)


def make(name: str, /, **options: Any) -> Policy:
  """Makes the policy registered as `name`.

  Raises:
    UnknownNameError: If there is none.
    SpecError: If it does not take these options.
  """
  return _make(POLICIES, 'policy', name, options)


def make_value_function(name: str, /, **options: Any) -> ValueFunction:
  """Makes the value function registered as `name`; raises like `make`."""
  return _make(VALUE_FUNCTIONS, 'value function', name, options)


def _make(
    names: registry.Registry[Callable[..., Any]],
    what: str,
    name: str,
    options: Mapping[str, Any],
) -> Any:
  factory = names.get(name)
  try:
    return factory(**options)
  except errors.RealabError:
    raise
  except Exception as error:  # It may be of any class.
    raise errors.SpecError(
        f'{what} {name!r} with options {messages.quote(dict(options))}:'
        f' {type(error).__name__}: {error}'
    ) from error


def check_action_set(
    action_set: action_sets.ActionSet, design: Any, kind: str
) -> None:
  """Checks that a design's actions are those that a provider speaks of.

  Raises:
    ValueError: If the design has another action set, or none.
  """
  given = design.action_set
  if given is None or (given.name, given.version) != (
      action_set.name,
      action_set.version,
  ):
    raise ValueError(
        f'{kind} speaks of action set {action_set.name} v{action_set.version};'
        f' the design has {given!r}'
    )
