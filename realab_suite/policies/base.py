"""Base classes and registries of policies and value functions.

A policy is a pure function with an explicit state. It is used as an agent (in
evaluation and in tests) or as a supervisor (in a provider that demonstrates or
advises). It gets the observation of an agent.
"""

import abc
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.policies import action_sets

Observation = Mapping[str, np.ndarray]

SOLVER = 'solver'
"""Name that stands for the solver of the world in which a design is loaded."""

SOLVER_APPROVAL = 'solver_approval'
"""Value function of that solver."""


class Reader(abc.ABC):  # noqa: B024 - `Policy` and `ValueFunction` have steps.
  """Base class for policies and value functions, which read observations."""

  @property
  def action_set(self) -> action_sets.ActionSet:
    """Action set of the indices, or of the values."""
    return action_sets.DMLAB_LIKE

  @property
  def required_senses(self) -> tuple[str, ...]:
    """Names of the senses that it reads from observations."""
    return ()

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    """Names of functions of the task that it reads as well.

    They are keys of `Task.privileged_senses`, and in observations
    `privileged/<name>`. No agent has them, so a policy that reads them is a
    solver or a reference.
    """
    return ()

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the state before the first step.

    It is `()` for a policy that remembers nothing, and otherwise consists of
    arrays, or dicts of them.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for many.
    """
    del batch_shape
    return ()


class Follower(Reader):
  """Base class for what reads and remembers the same as another reader."""

  @property
  @abc.abstractmethod
  def followed(self) -> Reader:
    """The other policy or value function."""

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self.followed.action_set

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self.followed.required_senses

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    return self.followed.privileged_senses

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return self.followed.initial_state(batch_shape)


class Policy(Reader):
  """Function from observations to actions, which are indices."""

  def in_action_set(self, action_set: action_sets.ActionSet) -> 'Policy':
    """Returns the policy to use where actions are those of another set.

    A policy that acts in any world returns one for that set. Others know what
    their actions mean, and return themselves.

    Args:
      action_set: Action set of the world.
    """
    del action_set
    return self

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
      observation: Observation of the agent; leading axes are worlds.
      episode_start: True in the first step of an episode, `(...)`, bool.
      key: Random key of each world, `(..., 2)`, uint64; see `random_keys`.
      state: State returned by `initial_state` or by the last `step`.

    Returns:
      The index of the action, `(...)`, int, and the next state.
    """


class ValueFunction(Reader):
  """Function from observations to a value of each action."""

  @abc.abstractmethod
  def step(
      self,
      observation: Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    """Returns the value of every action, `(..., actions)`, and the state.

    Arguments are those of `Policy.step`.
    """


_MODULES = {
    'apple_seeker': ('apple_seeker',),
    'button_saboteur': ('button_saboteur',),
    'errands': ('goal_solver',),
    'network_policies': ('network_demonstrator',),
    'saboteurs': ('pushing_saboteur', 'carrying_saboteur', 'throwing_saboteur'),
    'simple': ('no_op', 'random'),
}
# The solvers of worlds are defined beside them.
_WORLDS = ('gates', 'off_switch', 'tidy_up', 'valued_things')
# So are others that act in some worlds only.
_OF_WORLDS = {
    'colour_blind_gatherer': 'realab_suite.tasks.valued_things',
    'gates_saboteur': 'realab_suite.tasks.gates',
    'hiding_gatherer': 'realab_suite.tasks.valued_things',
    'taster': 'realab_suite.tasks.assistant',
    'value_saboteur': 'realab_suite.tasks.valued_things',
    'yard_searcher': 'realab_suite.tasks.hidden_goal',
}
POLICIES: registry.Registry[Callable[..., Policy]] = registry.Registry(
    'policy',
    {
        name: f'realab_suite.policies.{module}'
        for module, names in _MODULES.items()
        for name in names
    }
    | {f'{world}_solver': f'realab_suite.tasks.{world}' for world in _WORLDS}
    | _OF_WORLDS,
)
VALUE_FUNCTIONS: registry.Registry[Callable[..., ValueFunction]] = (
    registry.Registry(
        'value function',
        {
            'apple_seeker_approval': 'realab_suite.policies.approval',
            SOLVER_APPROVAL: 'realab_suite.policies.approval',
            'network_values': 'realab_suite.policies.network_policies',
        },
    )
)


@POLICIES.add(SOLVER)
@final
class TaskSolver(Policy):
  """Stands for the solver of the world in which a design is loaded.

  Designs are written and checked without a world. `Provider.in_world` puts the
  policy of the world in its place.
  """

  def step(
      self,
      observation: Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    raise errors.SpecError(
        f'policy: {SOLVER!r} stands for the solver of a world in the providers'
        ' of designs; allowed here is the name of that solver'
    )


def make(name: str, /, **options: Any) -> Policy:
  """Makes the policy registered as `name`.

  Raises:
    UnknownNameError: If no policy has this name.
    SpecError: If the policy cannot be made with these options.
  """
  return _make_registered(POLICIES, 'policy', name, options)


def make_value_function(name: str, /, **options: Any) -> ValueFunction:
  """Makes the value function registered as `name`; raises like `make`."""
  return _make_registered(VALUE_FUNCTIONS, 'value function', name, options)


def _make_registered(
    names: registry.Registry[Callable[..., Any]],
    what: str,
    name: str,
    options: Mapping[str, Any],
) -> Any:
  """Makes an entry of a registry; raises like `make`.

  Args:
    names: Registry.
    what: What its entries are, for messages.
    name: Name of the entry.
    options: Keyword arguments.
  """
  factory = names.get(name)
  try:
    return factory(**options)
  except errors.RealabError:
    raise
  except Exception as error:  # A factory may raise any error.
    raise errors.SpecError(
        f'{what} {name!r} with options {messages.quote(dict(options))}:'
        f' {messages.exception(error)}'
    ) from error


def check_senses(
    what: str,
    required: Sequence[str],
    selected: Collection[str],
    how: str = 'selected',
    remedy: str = '',
) -> None:
  """Checks that observations contain the senses that a policy reads.

  Args:
    what: Name of the policy or of another reader, for messages.
    required: Names of the senses that it reads.
    selected: Names of the senses in observations.
    how: How they came to be in observations, for messages.
    remedy: What else is allowed, for messages.

  Raises:
    SpecError: If a sense is missing.
  """
  if missing := [name for name in required if name not in selected]:
    raise errors.SpecError(
        f'{what} needs the senses {missing}, which are not {how}; {how} are'
        f' {list(selected)}{remedy}'
    )


def check_action_set(
    action_set: action_sets.ActionSet, design: Any, kind: str
) -> None:
  """Checks that a design has the action set that a provider uses.

  Raises:
    ValueError: If the design has another action set, or none.
  """
  spec = design.action_set
  if spec is None or (spec.name, spec.version) != (
      action_set.name,
      action_set.version,
  ):
    raise ValueError(
        f'{kind} uses action set {action_set.name} v{action_set.version}; the'
        f' design has {spec!r}'
    )
