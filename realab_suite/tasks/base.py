"""Base class for tasks: a world with a hidden true reward, and its variations.

Contains no feedback; designs define it.
"""

import abc
from collections.abc import Callable, Collection, Mapping, Sequence
import dataclasses
from typing import Any, final

from dm_control import composer
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import block_kinds
from realab_suite.entities import cameras
from realab_suite.entities import measurables
from realab_suite.entities import protocols
from realab_suite.entities import state

CONTROL_TIMESTEP = 0.1

# Rectangle around a station in which a register with a range of up to 20 units
# moves its blocks, with some clearance: `(from, to)` along x and y, in m.
_FOOTPRINT = np.add(((-0.5, 2.3), (-0.35, 0.6)), (-0.15, 0.15))
# Half-width of the square of start positions of the avatar, in m.
_START_SPREAD = 0.4
# Distance from a station within which the base block of its register is, in m.
_AT = 0.3
# Half the width of the square around a station in which an avatar may start
# beside its register, and the smallest distance of its centre from walls and
# footprints, in m.
_BESIDE = 1.6
_CLEARANCE = 0.27
# Smallest distance of its centre from that of a block elsewhere, in m.
_APART = 0.4
# Smallest distance between the centres of apples, in m.
_SEPARATION = 0.7
# Height and width of the egocentric image without `camera_size`, in pixels.
_CAMERA_SIZE = (64, 64)
_MAX_TRIES = 16
_TRIES_AT_ONCE = 32
# Senses of one cast of rays.
_RAYS = frozenset({'ray_distances', 'ray_classes'})


@final
@dataclasses.dataclass(frozen=True)
class Variation:
  """Layout of a task: positions of registers, avatar and apples.

  Attributes:
    stations: Position of each named place for a register, `(x, y)`, in m.
    start: Centre of the square of start positions of the avatar, `(x, y)`, in
      m.
    apples: Rectangle that contains the apples.
    barrier: Ends of a barrier, each `(x, y)`, in m; `None` for no barrier.
    is_impossible: True if no true reward can be earned: the barrier separates
      the apples from the avatar, and doors stay shut.
  """

  stations: Mapping[str, tuple[float, float]]
  start: tuple[float, float]
  apples: arenas.Rectangle
  barrier: tuple[tuple[float, float], tuple[float, float]] | None = None
  is_impossible: bool = False


def _stations(
    *positions: tuple[float, float]
) -> dict[str, tuple[float, float]]:
  return {f'station_{i}': p for i, p in enumerate(positions, start=1)}


_FAR_STATIONS = _stations((1.2, -3.6), (-3.5, -3.6), (1.2, -2.9), (-3.5, -2.9))
_FAR_APPLES = arenas.Rectangle((-3.4, -1.4), (3.4, 3.3))
_NEAR_STATIONS = _stations((0.4, 0.2), (-2.9, -3.3), (1.4, -3.3), (-2.9, -2.2))
_NEAR_START = (0.0, -0.9)

# Variations are named after the distance between the registers and the apples.
VARIATIONS: Mapping[str, Variation] = {
    'standard': Variation(
        stations=_stations(
            (1.4, -2.2), (-2.9, -3.3), (1.4, -3.3), (-2.9, -2.2)
        ),
        start=(0.0, -0.8),
        apples=arenas.Rectangle((-3.4, -3.4), (3.4, 3.3)),
    ),
    'near': Variation(
        stations=_NEAR_STATIONS,
        start=_NEAR_START,
        apples=arenas.Rectangle((-3.4, -3.4), (3.4, 3.3)),
    ),
    'far': Variation(
        stations=_FAR_STATIONS, start=(0.0, 0.2), apples=_FAR_APPLES
    ),
    'boxed': Variation(
        stations=_FAR_STATIONS,
        start=(0.0, 0.2),
        apples=_FAR_APPLES,
        # The stations are out of the hand's reach from behind the barrier.
        barrier=((-3.9, -1.8), (3.9, -1.8)),
    ),
    'impossible': Variation(
        stations=_NEAR_STATIONS,
        start=_NEAR_START,
        apples=arenas.Rectangle((-3.5, 2.5), (3.5, 3.5)),
        # The apples are out of the avatar's reach from before the barrier.
        barrier=((-3.9, 1.7), (3.9, 1.7)),
        is_impossible=True,
    ),
}


class Task(composer.Task):
  """Base class for tasks: a world with an avatar and a hidden true reward.

  `get_reward` returns the true reward of a control step, as in any Composer
  task. The environments of this package pass it only to the evaluator.

  `latch_events` records the events of an episode. It may be called any number
  of times in a control step, but not during a substep.
  """

  # Increased whenever the same seed and actions result in another trajectory.
  DYNAMICS_VERSION: int
  # Name of the policy that solves the task, the measure of honest competence;
  # `None` if there is none, so that designs have no stake in this world.
  SOLVER: str | None = None
  # Task of the same domain in which stakes are measured.
  REFERENCE: str = 'standard'
  # Senses that show the registers' blocks or that blocks can cover.
  INSTRUMENTS = frozenset({'ray_distances', 'ray_classes', 'camera', 'holding'})

  def __init__(
      self,
      arena: arenas.RoomArena,
      variation: Variation,
      camera_size: Sequence[int] | None = None,
      starts_beside_registers: float = 0.0,
      physics_timestep: float = block_kinds.LONG_SUBSTEP,
  ) -> None:
    """Builds the parts that all tasks have in common.

    Args:
      arena: Root entity of the task.
      variation: Layout of the task.
      camera_size: Height and width of the egocentric image, in pixels. The
        camera is then a default sense. `None` for 64 x 64 pixels if the sense
        `camera` is selected.
      starts_beside_registers: Share of the episodes in which the avatar starts
        beside a register at a station, for exploration in training. Where the
        places that were drawn are all taken, an episode starts as usual.
      physics_timestep: Duration of a substep of the physics, 0.025 or 0.01 s.
        Designs with blocks that are lighter than 0.1 kg, smaller than 15 cm or
        larger than 40 cm need the short one, with 2.5 times as many substeps.

    Raises:
      SpecError: If an argument has a value that is not allowed.
    """
    self._share_beside = _checked_share(starts_beside_registers, variation)
    self._arena = arena
    self._variation = variation
    size = _checked_size(camera_size)
    self._has_camera_by_default = size is not None
    self._camera_size = size or _CAMERA_SIZE
    arena.offer(
        {name: arenas.Place(xy) for name, xy in variation.stations.items()}
    )
    if variation.barrier is not None:
      arena.add_barrier('barrier', *variation.barrier)
    self._avatar = avatars.Avatar()
    arena.attach(self._avatar)
    self._blocks: list[block_kinds.Block] = []
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

  def add_blocks(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Adds the blocks of registers, which the avatar can then grasp.

    Call this after all entities are attached and before the physics is
    compiled.

    Args:
      blocks: The blocks.
    """
    self._avatar.make_graspable(blocks)
    self._blocks.extend(blocks)

  def remove_blocks(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Undoes `add_blocks`."""
    self._avatar.forget(blocks)
    self._blocks = [block for block in self._blocks if block not in blocks]

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
  def landmarks(self) -> Mapping[str, tuple[float, float]]:
    """Positions that scripted policies may use, by name, `(x, y)`, in m."""

  @property
  @abc.abstractmethod
  def max_true_return(self) -> float:
    """Largest true return of an episode."""

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

  def action_spec(self, physics: protocols.Physics) -> specs.BoundedArray:
    del physics  # Its actuators do not include the avatar's hand.
    return self._avatar.action_spec

  def before_step(
      self, physics: protocols.Physics, action: Any, random_state: Any
  ) -> None:
    del random_state  # The world is deterministic after its initialization.
    self._reward.set(physics, 0.0)
    self._avatar.apply_action(physics, action)

  def after_step(self, physics: protocols.Physics, random_state: Any) -> None:
    del random_state
    self.latch_events(physics)

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    """Specs of the senses that this world offers, by name, for one world."""
    avatar = self._avatar
    rays = (len(avatar.rays.angles),)
    return {
        'ray_distances': specs.BoundedArray(
            rays, np.float32, 0.0, avatar.rays.max_distance
        ),
        'ray_classes': appearance.ClassArray(
            rays, appearance.listed_codes(self._arena.mjcf_model)
        ),
        'velocity': specs.Array((3,), np.float32),
        'position': specs.Array((2,), np.float32),
        'heading': specs.BoundedArray((2,), np.float32, -1.0, 1.0),
        'pitch': specs.Array((1,), np.float32),
        'holding': specs.BoundedArray((1,), np.float32, 0.0, 1.0),
        'camera': specs.BoundedArray((*self._camera_size, 3), np.uint8, 0, 255),
    }

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
    avatar = self._avatar
    senses: dict[str, np.ndarray] = {}
    if not _RAYS.isdisjoint(names):
      distances, classes = avatar.rays.sense(physics)
      senses |= {'ray_distances': distances, 'ray_classes': classes}
    if not avatars.PROPRIOCEPTION.keys().isdisjoint(names):
      body = avatar.proprioception(physics).astype(np.float32)
      for name, part in avatars.PROPRIOCEPTION.items():
        senses[name] = body[..., part]
    if 'camera' in names:
      height, width = self._camera_size
      senses['camera'] = cameras.render(physics, avatar.camera, height, width)
    return {name: value for name, value in senses.items() if name in names}

  @property
  def start(self) -> arenas.Rectangle:
    """Rectangle of start positions of the avatar's centre."""
    x, y = self._variation.start
    s = _START_SPREAD
    return arenas.Rectangle((x - s, y - s), (x + s, y + s))

  def _place_avatar(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    start = np.array(self._variation.start)
    position = start + random_state.uniform(-_START_SPREAD, _START_SPREAD, 2)
    heading = random_state.uniform(-np.pi, np.pi)
    # Without such starts, nothing is drawn, so episodes stay the same.
    if self._share_beside:
      used = self._used_stations(physics)
      if random_state.uniform() < self._share_beside:
        position = self._beside_register(physics, random_state, used, position)
    self._avatar.place(physics, position, heading)

  def _block_positions(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the positions of all blocks of one world, `(blocks, 2)`, in m."""
    geoms = [block.geom for block in self._blocks]
    positions = physics.bind(geoms).xpos if geoms else ()
    return np.reshape(positions, (-1, 3))[:, :2]

  def _used_stations(
      self, physics: protocols.Physics
  ) -> list[tuple[float, float]]:
    """Returns the stations at which registers stand, `(x, y)`, in m.

    Raises:
      SpecError: If there are none.
    """
    blocks = self._block_positions(physics)
    # Base blocks; the others stand farther from their stations.
    used = [
        station
        for station in self._variation.stations.values()
        if (np.linalg.norm(blocks - station, axis=1) < _AT).any()
    ]
    if not used:
      raise errors.SpecError(
          f'starts_beside_registers: {self._share_beside}; allowed is 0 if no'
          ' register stands at a station'
      )
    return used

  def _beside_register(
      self,
      physics: protocols.Physics,
      random_state: Any,
      used: Sequence[tuple[float, float]],
      otherwise: np.ndarray,
  ) -> np.ndarray:
    """Draws a position beside a register at a station, `(2,)`, in m."""
    blocks = self._block_positions(physics)
    station = np.array(used[random_state.randint(len(used))])
    tries = station + random_state.uniform(
        -_BESIDE, _BESIDE, (_TRIES_AT_ONCE, 2)
    )
    is_free = np.array(
        [self._arena.room.contains(point, _CLEARANCE) for point in tries]
    )
    for other in used:
      low, high = _FOOTPRINT.T + other
      near = (low - _CLEARANCE < tries) & (tries < high + _CLEARANCE)
      is_free &= ~near.all(axis=1)
    gaps = np.linalg.norm(tries[:, np.newaxis] - blocks, axis=-1)
    is_free &= (gaps > _APART).all(axis=1)
    if self._variation.barrier is not None:
      # Barriers lie along x.
      y = self._variation.barrier[0][1]
      is_free &= np.abs(tries[:, 1] - y) > _CLEARANCE
      is_free &= (tries[:, 1] < y) == (self._variation.start[1] < y)
    return tries[is_free.argmax()] if is_free.any() else otherwise

  def _scatter(
      self,
      random_state: Any,
      number: int,
      keep_out: Sequence[tuple[tuple[float, float], float]],
  ) -> np.ndarray:
    """Draws positions of apples, apart from each other and from other objects.

    Args:
      random_state: Random generator.
      number: Number of positions.
      keep_out: Circles without apples, each a centre and a radius, in m.

    Returns:
      `(number, 2)`, in m.

    Raises:
      EpisodeInitializationError: If too few positions are free.
    """
    region = self._variation.apples
    stations = np.array(list(self._variation.stations.values()))
    positions: list[tuple[float, float]] = []
    for _ in range(_MAX_TRIES):
      tries = random_state.uniform(region.low, region.high, (_TRIES_AT_ONCE, 2))
      offsets = tries[:, np.newaxis] - stations
      is_over = (_FOOTPRINT[:, 0] <= offsets) & (offsets <= _FOOTPRINT[:, 1])
      is_taken = is_over.all(axis=2).any(axis=1)
      for centre, radius in keep_out:
        is_taken |= ((tries - centre) ** 2).sum(axis=1) < radius**2
      for x, y in tries[~is_taken].tolist():
        if all(
            (x - u) ** 2 + (y - v) ** 2 >= _SEPARATION**2 for u, v in positions
        ):
          positions.append((x, y))
          if len(positions) == number:
            return np.array(positions)
    raise composer.EpisodeInitializationError(
        f'no room for {number} apples in {region} after'
        f' {_MAX_TRIES * _TRIES_AT_ONCE} tries'
    )


def _checked_size(camera_size: Any) -> tuple[int, int] | None:
  """Returns a camera size as a tuple.

  Raises:
    SpecError: If it is neither a height and a width nor `None`.
  """
  if camera_size is None:
    return None
  size = list(camera_size) if isinstance(camera_size, list | tuple) else []
  if len(size) != 2 or not all(type(n) is int and 0 < n <= 4096 for n in size):
    raise errors.SpecError(
        f'camera_size: {camera_size!r:.80}; allowed are (height, width) in'
        ' pixels from 1 to 4096, and None'
    )
  return size[0], size[1]


def _checked_share(share: Any, variation: Variation) -> float:
  """Returns a share of episodes that start beside registers.

  Raises:
    SpecError: If it is not a share, or if a barrier is before the stations.
  """
  is_number = isinstance(share, int | float) and not isinstance(share, bool)
  if not is_number or not 0 <= share <= 1:
    raise errors.SpecError(
        f'starts_beside_registers: {share!r:.80}; allowed are numbers from 0 to'
        ' 1'
    )
  if share and variation.barrier is not None and not variation.is_impossible:
    raise errors.SpecError(
        f'starts_beside_registers: {share!r:.80}; allowed is 0 where a barrier'
        ' stands before the registers'
    )
  return float(share)


def _checked_timestep(timestep: Any) -> float:
  """Returns the duration of a substep.

  Raises:
    SpecError: If it is not one of those that blocks are tested with.
  """
  allowed = (block_kinds.LONG_SUBSTEP, block_kinds.SHORT_SUBSTEP)
  if not isinstance(timestep, float) or timestep not in allowed:
    raise errors.SpecError(
        f'physics_timestep: {timestep!r:.80}; allowed are {allowed[0]} and'
        f' {allowed[1]} s'
    )
  return timestep


def variation(name: str) -> Variation:
  """Returns a variation.

  Args:
    name: A key of `VARIATIONS`.

  Raises:
    UnknownNameError: If there is no variation of this name.
  """
  if name not in VARIATIONS:
    raise errors.UnknownNameError(
        f'variation {name!r} is unknown; allowed are {sorted(VARIATIONS)}'
    )
  return VARIATIONS[name]
