"""A room in which the avatar, blocks and balls stand at chosen places."""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.tasks import layouts
from realab_suite.tasks import rooms

# No register may stand where avatars begin in other tasks.
_LAYOUT = layouts.Layout(middle=(-3.4, -3.4))


@final
class Ball(NamedTuple):
  """A ball that begins to roll; all in the frame of the stage."""

  position: tuple[float, float]
  velocity: tuple[float, float] = (0.0, 0.0)
  radius: float = 0.2
  mass: float = 20.0


@final
@dataclasses.dataclass(frozen=True)
class Stage:
  """An arrangement, which can be turned about the centre of the room.

  Attributes:
    registers: Place and yaw, `(x, y, yaw)`, of each register by name, and other
      fields of its spec.
    avatar: Place and heading of the avatar, `(x, y, heading)`.
    balls: The balls.
    writes: Value that a meter writes to the register `meter`, as a function of
      the time in s; `None` without writes.
    barrier: Ends of a wall that blocks do not pass.
  """

  registers: Mapping[str, tuple[tuple[float, float, float], dict[str, Any]]]
  avatar: tuple[float, float, float] = (0.0, 3.0, 0.0)
  balls: Sequence[Ball] = ()
  writes: Callable[[np.ndarray], np.ndarray] | None = None
  barrier: tuple[tuple[float, float], tuple[float, float]] | None = None

  def load(
      self, dof: str = 'free', angle: float = 0.0, **fields: Any
  ) -> environment.Environment:
    """Returns the world, turned by an angle, with fields of its design."""
    registers = {}
    for name, (place, others) in self.registers.items():
      *position, yaw = place
      registers[name] = {
          'kind': 'block_position',
          'role': 'meter' if name == 'meter' else 'feedback',
          'range': [0, 1],
          'initial': 0,
          'place': {
              'position': turned(position, angle).tolist(),
              'yaw': yaw + angle,
          },
          **others,
      }
    design: dict[str, Any] = {
        'schema': 1, 'name': 'staged', 'dof': dof, 'registers': registers,
        **fields,
    }  # fmt: skip
    measurements = {}
    writes = self.writes
    if writes is not None:
      design['meters'] = [{'measures': 'script', 'writes': 'meter'}]
      measurements['script'] = lambda physics: writes(
          np.asarray(physics.data.time)
      )
    return suite.embed(
        Staged(self, angle), design, random=1, measurements=measurements
    )

  def load_batch(
      self, num_envs: int = 2, **options: Any
  ) -> batch_environment.BatchEnvironment:
    """Returns copies of the world that `load` returns."""
    return batch_environment.BatchEnvironment(self.load(**options), num_envs, 1)


@final
class Staged(rooms.RoomTask):
  """The task of a stage, without rewards."""

  DYNAMICS_VERSION = 1

  def __init__(self, stage: Stage, angle: float) -> None:
    arena = arenas.OpenRoom()
    if stage.barrier is not None:
      arena.add_barrier('wall', *stage.barrier)
    super().__init__(arena, _LAYOUT)
    *position, heading = stage.avatar
    self._pose = turned(position, angle), heading + angle
    self._joints = []
    for i, ball in enumerate(stage.balls):
      x, y = turned(ball.position, angle)
      body = arena.mjcf_model.worldbody.add(
          'body', name=f'ball_{i}', pos=(x, y, ball.radius)
      )
      body.add('geom', type='sphere', size=(ball.radius,), mass=ball.mass)
      self._joints.append((body.add('freejoint'), turned(ball.velocity, angle)))

  @property
  def facts(self) -> dict[str, Any]:
    return {}

  @property
  def max_true_return(self) -> float:
    return 0.0

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self._avatar.place(physics, *self._pose)
    for joint, velocity in self._joints:
      physics.bind((joint,)).qvel = [*velocity, 0.0, 0.0, 0.0, 0.0]

  def latch_events(self, physics: Any) -> None:
    pass


def turned(vector: Sequence[float], angle: float) -> np.ndarray:
  cos, sin = np.cos(angle), np.sin(angle)
  return np.array([[cos, -sin], [sin, cos]]) @ np.asarray(vector, float)


def actions(*parts: tuple[int, dict[str, float]]) -> np.ndarray:
  """Returns actions, `(steps, 6)`, from numbers of steps and their controls."""
  rows = []
  for number, controls in parts:
    row = [controls.get(name, 0.0) for name in avatars.ACTIONS]
    rows += [row] * number
  return np.array(rows)


def blow(forces: np.ndarray, model: Any, force: Sequence[float]) -> None:
  """Sets the force on the block of `reward`.

  Args:
    forces: `xfrc_applied`, `(..., bodies, 6)`.
    model: The compiled model.
    force: The force, `(x, y)`, in N.
  """
  forces[..., model.name2id('reward/block', 'body'), :2] = force
