"""Base class for tasks: a world with an avatar and a hidden true reward.

Contains no feedback; designs define it. `rooms` has the base class for worlds
in a room with places for registers.
"""

import abc
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from dm_control import composer
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import block_kinds
from realab_suite.entities import measurables
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import base as registers_base
from realab_suite.policies import action_sets

CONTROL_TIMESTEP = 0.1

# Height and width of the egocentric image without `camera_size`, in pixels.
_CAMERA_SIZE = (64, 64)


class Task(composer.Task):
  """Base class for tasks: a world with an avatar and a hidden true reward.

  `get_reward` returns the true reward of a control step, as in any Composer
  task. The environments of this package pass it only to the evaluator.

  `latch_events` records the events of an episode. It may be called any number
  of times in a control step, but not during a substep. Everything that an
  episode changes is in the state of the physics; `state.Slot` adds numbers to
  it. The hooks `initialize_episode_mjcf`, `before_substep` and `after_substep`
  are refused, because a world is compiled once and runs no Python in substeps.

  Attributes:
    training_step: Number of control steps of all worlds that training has taken
      so far. Training sets it, and only starts of episodes depend on it.
  """

  # Increased whenever the same seed and actions result in another trajectory.
  DYNAMICS_VERSION: int
  # Name of the policy that solves the task, the measure of honest competence;
  # `None` if there is none, so that designs have no stake in this world.
  SOLVER: str | None = None
  # Names of policies that move the registers' blocks, the most general first.
  SABOTEURS: tuple[str, ...] = (
      'carrying_saboteur',
      'throwing_saboteur',
      'pushing_saboteur',
  )
  # Task of the same domain in which stakes are measured.
  REFERENCE: str = 'standard'
  # Senses that show the registers' blocks or that blocks can cover.
  INSTRUMENTS = frozenset({'ray_distances', 'ray_classes', 'camera', 'holding'})
  # Actions of people, and of policies that act in any world.
  ACTION_SET = action_sets.DMLAB_LIKE

  def __init__(
      self,
      arena: arenas.RoomArena,
      camera_size: Sequence[int] | None = None,
      physics_timestep: float = block_kinds.LONG_SUBSTEP,
  ) -> None:
    """Builds the parts that all tasks have in common.

    Args:
      arena: Root entity of the task.
      camera_size: Height and width of the egocentric image, in pixels. The
        camera is then a default sense. `None` for 64 x 64 pixels if the sense
        `camera` is selected.
      physics_timestep: Duration of a substep of the physics, 0.025 or 0.01 s.
        Designs with blocks that are lighter than 0.1 kg, smaller than 15 cm or
        larger than 40 cm need the short one, with 2.5 times as many substeps.

    Raises:
      SpecError: If an argument or an attribute of the class has a value that is
        not allowed, or the class has no version of its dynamics.
    """
    _check_class(type(self))
    self.training_step = 0
    self._arena = arena
    size = _checked_size(camera_size)
    self._has_camera_by_default = size is not None
    self._camera_size = size or _CAMERA_SIZE
    self._avatar = avatars.Avatar()
    arena.attach(self._avatar)
    self._score = state.Slot(arena.mjcf_model, 'score')
    self._reward = state.Slot(arena.mjcf_model, 'reward')
    self.set_timesteps(CONTROL_TIMESTEP, _checked_timestep(physics_timestep))

  @property
  def root_entity(self) -> arenas.RoomArena:
    return self._arena

  @property
  def avatar(self) -> avatars.Avatar:
    """Avatar of the agent."""
    return self._avatar

  @property
  @abc.abstractmethod
  def start(self) -> arenas.Rectangle:
    """Rectangle of start positions of the avatar's centre."""

  def add_registers(self, registers: Sequence[registers_base.Register]) -> None:
    """Adds the registers of a design, whose blocks the avatar can then grasp.

    Call this after all entities are attached and before the physics is
    compiled.

    Args:
      registers: The registers.

    Raises:
      SpecError: If an argument of the task does not allow these registers.
    """
    self._avatar.make_graspable(_blocks_of(registers))

  def remove_registers(
      self, registers: Sequence[registers_base.Register]
  ) -> None:
    """Undoes `add_registers`."""
    self._avatar.forget(_blocks_of(registers))

  @property
  def camera_size(self) -> tuple[int, int]:
    """Height and width of the egocentric image, in pixels."""
    return self._camera_size

  @property
  def measurements(self) -> Mapping[str, Callable[[Any], np.ndarray]]:
    """Functions of the physics that meters can measure, by name (section 3.1).

    Each returns values of shape `(...)`.
    """
    return {'score': self.score}

  @property
  def measured_ranges(self) -> Mapping[str, tuple[float, float]]:
    """Lowest and highest value of measurements, by name.

    No policy leaves these ranges, in any state of an episode. A design that
    states a narrower range for the register of a meter is refused, and ranges
    that it leaves open are resolved to these; measurements without a range are
    not checked.
    """
    return {}

  @property
  def measurables(self) -> Mapping[str, measurables.Measurable]:
    """Parts of the world that meters can measure, by name.

    They are those that the entities of the task declare. A subclass can add
    others, such as a body of its own.
    """
    return measurables.in_world(self._arena)

  @property
  @abc.abstractmethod
  def facts(self) -> Mapping[str, Callable[[Any], np.ndarray]]:
    """Functions of the physics to record at the end of an episode, by name.

    Each returns values of shape `(...)`. Only the evaluator records them.
    """

  @property
  @abc.abstractmethod
  def max_true_return(self) -> float:
    """Largest true return of an episode."""

  @property
  def best_mean_return(self) -> float:
    """Mean true return of episodes that are played as well as possible.

    It is less than `max_true_return` where more can be earned in some episodes
    than in others.
    """
    return self.max_true_return

  @abc.abstractmethod
  def latch_events(self, physics: protocols.Physics) -> None:
    """Records the events since the last call."""

  def score(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true return of the episode so far, `(...)`."""
    return self._score.copy(physics)

  def get_reward(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true reward of the current control step, `(...)`."""
    return self._reward.copy(physics)

  def earn(self, physics: protocols.Physics, reward: np.ndarray) -> None:
    """Adds to the true reward of the current control step and to the score.

    Args:
      physics: One world or a batch of worlds.
      reward: Reward to add, `(...)`.
    """
    if not np.any(reward):
      return
    self._reward.set(physics, self._reward.get(physics) + reward)
    self._score.set(physics, self._score.get(physics) + reward)

  def start_ahead(
      self,
      physics: protocols.Physics,
      random_state: np.random.RandomState,
      distance: float,
  ) -> None:
    """Begins an episode with part of the task done, for training alone.

    A world without such starts does not override it; see `starts.Schedule`.

    Args:
      physics: Physics of one world, in which an ordinary episode begins.
      random_state: Random generator of the episode.
      distance: What is left to do, from 0 to 1 for all of it.
    """

  def action_spec(self, physics: protocols.Physics) -> specs.BoundedArray:
    del physics  # Its actuators do not include the avatar's hand.
    return self._avatar.action_spec

  def before_step(
      self,
      physics: protocols.Physics,
      action: Any,
      random_state: np.random.RandomState,
  ) -> None:
    del random_state  # The world is deterministic after its initialization.
    self._reward.set(physics, 0.0)
    self._avatar.apply_action(physics, action)

  def after_step(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    del random_state
    self.latch_events(physics)

  @property
  def privileged_senses(self) -> Mapping[str, Callable[[Any], np.ndarray]]:
    """Functions of the physics that the solver may sense, by name.

    Each returns numbers, `(..., *shape)`. They are never part of observations:
    only policies that declare them get them, which are no agents, and providers
    with senses of their own. One that something can be in the way of is a
    `meters.Instrument`, with what would be sensed otherwise.
    """
    return {}

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    """Specs of the senses that this world offers, by name, for one world."""
    codes = appearance.listed_codes(self._arena.mjcf_model)
    return self._avatar.sense_spec(codes, self._camera_size)

  @property
  def default_senses(self) -> tuple[str, ...]:
    """Names of the senses of an agent for which none are selected."""
    return tuple(
        name
        for name in self.sense_spec
        if name != 'camera' or self._has_camera_by_default
    )

  def senses(
      self, physics: protocols.Physics, names: Collection[str]
  ) -> dict[str, np.ndarray]:
    """Returns the selected senses, by name. No other senses are computed.

    Args:
      physics: One world or a batch of worlds.
      names: Names of the selected senses, keys of `sense_spec`.

    Returns:
      New arrays that match `sense_spec`, with leading axes `(...)`.
    """
    return self._avatar.senses(physics, names, self._camera_size)


def _blocks_of(
    registers: Sequence[registers_base.Register],
) -> list[block_kinds.Block]:
  return [block for register in registers for block in register.own_blocks]


def _check_class(task_class: type[Task]) -> None:
  """Checks the class attributes of a task.

  Raises:
    SpecError: If one has a wrong type. Snapshots and results are compared by
      the version of the dynamics, so each class needs one.
  """
  version = getattr(task_class, 'DYNAMICS_VERSION', None)
  solver, saboteurs = task_class.SOLVER, task_class.SABOTEURS
  actions = task_class.ACTION_SET
  attribute = value = allowed = None
  if type(version) is not int or version < 1:
    attribute, value = 'DYNAMICS_VERSION', version
    allowed = (
        'an integer from 1, increased with each change of the trajectories'
    )
  elif not isinstance(solver, str | None):
    attribute, value = 'SOLVER', solver
    allowed = 'the name of a registered policy, or None'
  elif not isinstance(saboteurs, tuple) or not all(
      isinstance(name, str) for name in saboteurs
  ):
    attribute, value = 'SABOTEURS', saboteurs
    allowed = 'a tuple of names of registered policies'
  elif not isinstance(actions, action_sets.ActionSet):
    attribute, value = 'ACTION_SET', actions
    allowed = 'an action_sets.ActionSet'
  if attribute:
    raise errors.SpecError(
        f'{task_class.__name__}.{attribute}: {value!r:.80}; must be'
        f' {allowed}'
    )


def _checked_size(camera_size: Any) -> tuple[int, int] | None:
  """Returns a camera size as a tuple.

  Raises:
    SpecError: If it is neither a height and a width nor `None`.
  """
  if camera_size is None:
    return None
  size = list(camera_size) if loading.is_list(camera_size) else []
  if len(size) != 2 or not all(type(n) is int and 0 < n <= 4096 for n in size):
    raise errors.SpecError(
        f'camera_size: {camera_size!r:.80}; must be (height, width) in'
        ' pixels from 1 to 4096, or None'
    )
  return size[0], size[1]


def _checked_timestep(timestep: Any) -> float:
  """Returns the duration of a substep.

  Raises:
    SpecError: If it is not one of those that blocks are tested with.
  """
  allowed = (block_kinds.LONG_SUBSTEP, block_kinds.SHORT_SUBSTEP)
  if not isinstance(timestep, float) or timestep not in allowed:
    raise errors.SpecError(
        f'physics_timestep: {timestep!r:.80}; must be {allowed[0]} or'
        f' {allowed[1]} s'
    )
  return timestep
