"""Worlds in which something other than the agent moves blocks."""

from typing import Any, final

import numpy as np

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.entities import arenas
from realab_suite.tasks import rooms


@final
class Disturbed(rooms.RoomTask):
  """A room without apples, with a rolling ball or with wind."""

  DYNAMICS_VERSION = 1

  def __init__(self, disturbance: str) -> None:
    super().__init__(arenas.OpenRoom())
    model = self._arena.mjcf_model
    self._joint: Any = None
    self._is_impatient = disturbance == 'ball, impatient'
    if disturbance.startswith('ball'):
      body = model.worldbody.add('body', name='ball', pos=(0.2, -2.2, 0.2))
      body.add('geom', type='sphere', size=(0.2,), mass=20.0)
      self._joint = body.add('freejoint')
    elif disturbance == 'wind':
      model.option.density = 1.2
      model.option.wind = (30.0, 4.0, 0.0)

  @property
  def facts(self) -> dict[str, Any]:
    return {}

  @property
  def max_true_return(self) -> float:
    return 0.0

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.place_avatar(physics, random_state)
    if self._joint is not None:
      speed = random_state.uniform(2.0, 3.0)
      physics.bind((self._joint,)).qvel = [speed, 0.0, 0.0, 0.0, 0.0, 0.0]

  def should_terminate_episode(self, physics: Any) -> Any:
    """Ends episodes of avatars that do not turn, in one of the worlds."""
    rate = self._avatar.velocity(physics)[..., 2]
    is_late = np.asarray(physics.data.time) > 0.95
    return is_late & (np.abs(rate) < 1.0) & self._is_impatient

  def latch_events(self, physics: Any) -> None:
    pass


def load_batch(
    num_envs: int,
    disturbance: str = 'none',
    design: Any = 'instantaneous_reward',
    *overrides: str,
    seed: int = 5,
    max_steps: int = 40,
) -> batch_environment.BatchEnvironment:
  env = suite.embed(
      Disturbed(disturbance),
      design,
      random=seed,
      max_steps=max_steps,
      overrides=overrides,
  )
  return batch_environment.BatchEnvironment(env, num_envs, 1)


def five(dof: str = 'free', **learner: Any) -> dict[str, Any]:
  """Returns a design with five registers, of three kinds."""
  kinds = {
      'reward': ('two_block', [1.4, -2.2]),
      'bonus': ('block_position', [-2.9, 2.2]),
      'turn': ('block_orientation', [2.9, 2.2]),
      'extra': ('two_block', [-2.9, -2.9]),
      'more': ('two_block', [1.4, -3.3]),
  }
  # Every third step: temporary corruption lasts until then.
  return {
      'schema': 1,
      'name': 'five',
      'dof': dof,
      'registers': {
          name: {
              'kind': kind, 'role': 'feedback', 'place': place,
              'range': [0, 3],
          }
          for name, (kind, place) in kinds.items()
      },
      'providers': [
          {'kind': 'constant', 'value': 1, 'writes': [name], 'every': 3}
          for name in kinds
      ],
      **({'learner': learner} if learner else {}),
  }  # fmt: skip


def still(batch: Any) -> Any:
  spec = batch.action_spec()
  return lambda time_step: np.zeros((batch.num_envs, *spec.shape), spec.dtype)
