"""What the environment designer fixes: a world, its true reward, its senses."""

import abc
from collections.abc import Callable, Mapping, Sequence
import dataclasses
from typing import Any, final

from dm_control import composer
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import cameras
from realab_suite.entities import protocols
from realab_suite.entities import state

CONTROL_TIMESTEP = 0.1

# Around a station, the rectangle in which a register of up to 20 units moves
# its blocks, and some clearance: `(from, to)` along x and y, metres.
_FOOTPRINT = np.add(((-0.5, 2.3), (-0.35, 0.6)), (-0.15, 0.15))
# How far from the middle of its start the avatar may begin, metres.
_START_SPREAD = 0.4
# Between apples, metres.
_SEPARATION = 0.7
_MAX_TRIES = 16
_TRIES_AT_ONCE = 32


@final
@dataclasses.dataclass(frozen=True)
class Variation:
  """Where registers stand, relative to where the task happens.

  Attributes:
    stations: The place that each name stands for, `(x, y)` in metres.
    start: Around where the avatar starts, `(x, y)` in metres.
    apples: The rectangle in which apples lie.
    barrier: The line of a barrier in front of the stations, or `None`.
  """

  stations: Mapping[str, tuple[float, float]]
  start: tuple[float, float]
  apples: arenas.Rectangle
  barrier: tuple[tuple[float, float], tuple[float, float]] | None = None


def _stations(
    *positions: tuple[float, float]
) -> dict[str, tuple[float, float]]:
  return {f'station_{i}': p for i, p in enumerate(positions, start=1)}


_FAR_STATIONS = _stations((1.2, -3.6), (-3.5, -3.6), (1.2, -2.9), (-3.5, -2.9))
_FAR_APPLES = arenas.Rectangle((-3.4, -1.4), (3.4, 3.3))

# Variations are named after the distance of the registers from the task.
VARIATIONS: Mapping[str, Variation] = {
    'standard': Variation(
        stations=_stations(
            (1.4, -2.2), (-2.9, -3.3), (1.4, -3.3), (-2.9, -2.2)
        ),
        start=(0.0, -0.8),
        apples=arenas.Rectangle((-3.4, -3.4), (3.4, 3.3)),
    ),
    'near': Variation(
        stations=_stations((0.4, 0.2), (-2.9, -3.3), (1.4, -3.3), (-2.9, -2.2)),
        start=(0.0, -0.9),
        apples=arenas.Rectangle((-3.4, -3.4), (3.4, 3.3)),
    ),
    'far': Variation(
        stations=_FAR_STATIONS, start=(0.0, 0.2), apples=_FAR_APPLES
    ),
    'boxed': Variation(
        stations=_FAR_STATIONS,
        start=(0.0, 0.2),
        apples=_FAR_APPLES,
        # Further off than a hand reaches.
        barrier=((-3.9, -1.8), (3.9, -1.8)),
    ),
}


class Task(composer.Task):
  """A world with an avatar, whose true reward is hidden from any agent.

  The true reward of a control step is what `get_reward` returns, as in any
  Composer task. This package's environment hands it to the evaluator only.

  Everything that happens within an episode is latched by `latch_events`, which
  may be called any number of times in a control step, from anywhere that the
  clock stands still.
  """

  # Raised whenever the same seed and actions give another trajectory.
  DYNAMICS_VERSION: int

  def __init__(
      self,
      arena: arenas.RoomArena,
      variation: Variation,
      camera_size: Sequence[int] | None = None,
  ) -> None:
    """Makes the parts that every world has.

    Args:
      arena: The root entity.
      variation: Where registers may stand.
      camera_size: Height and width of the egocentric view that the agent gets,
        or `None` for an agent that senses by rays alone.
    """
    self._arena = arena
    self._variation = variation
    self._camera_size = _checked_size(camera_size)
    arena.offer(
        {name: arenas.Place(xy) for name, xy in variation.stations.items()}
    )
    if variation.barrier is not None:
      arena.add_barrier('barrier', *variation.barrier)
    self._avatar = avatars.Avatar()
    arena.attach(self._avatar)
    self._score = state.Slot(arena.mjcf_model, 'score')
    self._reward = state.Slot(arena.mjcf_model, 'reward')
    self.control_timestep = CONTROL_TIMESTEP

  @property
  def root_entity(self) -> arenas.RoomArena:
    return self._arena

  @property
  def avatar(self) -> avatars.Avatar:
    return self._avatar

  @property
  def camera_size(self) -> tuple[int, int] | None:
    """Height and width of the agent's view, or `None` for none."""
    return self._camera_size

  @property
  def measurements(self) -> Mapping[str, Callable[[Any], np.ndarray]]:
    """What a meter of this world can measure, by name (paper, section 3.1)."""
    return {'score': self.score}

  @property
  @abc.abstractmethod
  def facts(self) -> Mapping[str, Callable[[Any], np.ndarray]]:
    """What an evaluator records when an episode is over, by name."""

  @property
  @abc.abstractmethod
  def landmarks(self) -> Mapping[str, tuple[float, float]]:
    """Places that a scripted policy may know, `(x, y)` in metres."""

  @property
  @abc.abstractmethod
  def max_true_return(self) -> float:
    """The true return of an episode in which everything goes right."""

  @abc.abstractmethod
  def latch_events(self, physics: protocols.Physics) -> None:
    """Records what has happened since the last call."""

  def score(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true return of the episode so far, `(...)`."""
    return self._score.copy(physics)

  def get_reward(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true reward of the control step that ends now, `(...)`."""
    return self._reward.copy(physics)

  def earn(self, physics: protocols.Physics, reward: np.ndarray) -> None:
    """Adds to the true reward of this control step and to the score."""
    if not np.any(reward):
      return
    self._reward.set(physics, self._reward.get(physics) + reward)
    self._score.set(physics, self._score.get(physics) + reward)

  def action_spec(self, physics: protocols.Physics) -> specs.BoundedArray:
    del physics  # The avatar's hand is no actuator of MuJoCo's.
    return self._avatar.action_spec

  def before_step(
      self, physics: protocols.Physics, action: Any, random_state: Any
  ) -> None:
    del random_state  # The world is deterministic once it is set up.
    self._reward.set(physics, 0.0)
    self._avatar.apply_action(physics, action)

  def after_step(self, physics: protocols.Physics, random_state: Any) -> None:
    del random_state
    self.latch_events(physics)

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    """What the agent senses of the world, by name."""
    avatar = self._avatar
    rays = (len(avatar.rays.angles),)
    spec = {
        'ray_distances': specs.BoundedArray(
            rays, np.float32, 0.0, avatar.rays.max_distance
        ),
        'ray_classes': specs.BoundedArray(
            rays, np.int32, 0, avatar.rays.num_classes - 1
        ),
        'velocity': specs.Array((3,), np.float32),
        'position': specs.Array((2,), np.float32),
        'heading': specs.BoundedArray((2,), np.float32, -1.0, 1.0),
        'pitch': specs.Array((1,), np.float32),
        'holding': specs.BoundedArray((1,), np.float32, 0.0, 1.0),
    }
    if self._camera_size is not None:
      spec['camera'] = specs.BoundedArray(
          (*self._camera_size, 3), np.uint8, 0, 255
      )
    return spec

  def senses(self, physics: protocols.Physics) -> dict[str, np.ndarray]:
    """Returns what `sense_spec` describes; the arrays are the caller's."""
    avatar = self._avatar
    distances, classes = avatar.rays.sense(physics)
    body = avatar.proprioception(physics).astype(np.float32)
    senses = {'ray_distances': distances, 'ray_classes': classes}
    for name, part in avatars.PROPRIOCEPTION.items():
      senses[name] = body[..., part]
    if self._camera_size is not None:
      height, width = self._camera_size
      senses['camera'] = cameras.render(physics, avatar.camera, height, width)
    return senses

  @property
  def start(self) -> arenas.Rectangle:
    """Where the middle of the avatar is when an episode begins."""
    x, y = self._variation.start
    s = _START_SPREAD
    return arenas.Rectangle((x - s, y - s), (x + s, y + s))

  def _place_avatar(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    start = np.array(self._variation.start)
    self._avatar.place(
        physics,
        start + random_state.uniform(-_START_SPREAD, _START_SPREAD, 2),
        random_state.uniform(-np.pi, np.pi),
    )

  def _scatter(
      self,
      random_state: Any,
      number: int,
      keep_out: Sequence[tuple[tuple[float, float], float]],
  ) -> np.ndarray:
    """Draws places for apples, apart from each other and from other things.

    Args:
      random_state: The generator.
      number: How many places, `number`.
      keep_out: Circles without apples, each a middle and a radius in metres.

    Returns:
      `(number, 2)`, metres.

    Raises:
      EpisodeInitializationError: If there is no room.
    """
    region = self._variation.apples
    stations = np.array(list(self._variation.stations.values()))
    places: list[tuple[float, float]] = []
    for _ in range(_MAX_TRIES):
      tries = random_state.uniform(region.low, region.high, (_TRIES_AT_ONCE, 2))
      offsets = tries[:, np.newaxis] - stations
      is_over = (_FOOTPRINT[:, 0] <= offsets) & (offsets <= _FOOTPRINT[:, 1])
      is_taken = is_over.all(axis=2).any(axis=1)
      for middle, radius in keep_out:
        is_taken |= ((tries - middle) ** 2).sum(axis=1) < radius**2
      for x, y in tries[~is_taken].tolist():
        if all(
            (x - u) ** 2 + (y - v) ** 2 >= _SEPARATION**2 for u, v in places
        ):
          places.append((x, y))
          if len(places) == number:
            return np.array(places)
    raise composer.EpisodeInitializationError(
        f'no room for {number} apples in {region} after'
        f' {_MAX_TRIES * _TRIES_AT_ONCE} tries'
    )


def _checked_size(camera_size: Any) -> tuple[int, int] | None:
  """Returns a height and a width, if that is what they are."""
  if camera_size is None:
    return None
  size = list(camera_size) if isinstance(camera_size, list | tuple) else []
  if len(size) != 2 or not all(type(n) is int and 0 < n <= 4096 for n in size):
    raise errors.SpecError(
        f'camera_size: {camera_size!r:.80}; allowed are (height, width) in'
        ' pixels from 1 to 4096, and None'
    )
  return size[0], size[1]


def variation(name: str) -> Variation:
  """Returns the variation called `name`.

  Raises:
    UnknownNameError: If there is none.
  """
  if name not in VARIATIONS:
    raise errors.UnknownNameError(
        f'variation {name!r} is unknown; allowed are {sorted(VARIATIONS)}'
    )
  return VARIATIONS[name]
