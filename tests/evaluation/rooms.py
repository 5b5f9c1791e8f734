"""Worlds and policies of the tests of evaluation."""

from collections.abc import Mapping
import math
from typing import Any, final

import dm_env
import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import arenas
from realab_suite.tasks import rooms
from tests import kept
from tests.engine import helpers


@final
class EmptyRoom(rooms.RoomTask):
  """A room without apples and rewards."""

  DYNAMICS_VERSION = 1
  max_true_return = 0.0

  def __init__(self) -> None:
    super().__init__(arenas.OpenRoom())

  @property
  def facts(self) -> dict[str, Any]:
    return {}

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.place_avatar(physics, random_state)

  def latch_events(self, physics: Any) -> None:
    pass


def load(
    domain: str = 'unlock_door',
    task: str = 'near',
    design: Any = 'instantaneous_reward',
    *overrides: str,
    seed: int = 7,
    max_steps: int = 12,
) -> environment.Environment:
  """Returns a world; one that was closed is used again."""
  return kept.load(
      (domain, task, design, overrides, seed, max_steps),
      lambda: suite.load(
          domain,
          task,
          {'random': seed},
          {'max_steps': max_steps},
          design=design,
          overrides=overrides,
      ),
  )


def still(env: environment.Environment) -> Any:
  action = helpers.no_op(env)
  return lambda time_step: action


def design(
    *values: float, others: Mapping[str, Any] | None = None, **options: Any
) -> dict[str, Any]:
  """Returns a design with a register and a constant provider for each value."""
  reward = {'kind': 'two_block', 'role': 'feedback', 'range': [-2, 12]}
  more = {'bonus': [-3, 3], 'extra': [-3, 2]}
  return {
      'schema': 1,
      'name': 'golden',
      'dof': 'planar',
      'registers': {
          'reward': {**reward, 'place': [2, 2], **options},
          **{
              name: {**reward, 'place': place}
              for (name, place), _ in zip(
                  more.items(), values[1:], strict=False
              )
          },
          **(others or {}),
      },
      'providers': [
          {'kind': 'constant', 'value': value, 'writes': [name]}
          for value, name in zip(values, ('reward', *more), strict=False)
      ],
  }


class Oops(Exception):
  """An exception that a test raises on purpose."""


def raising(env: environment.Environment, step: int) -> Any:
  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    if env.mechanism.step_count(env.physics) == step:
      raise Oops
    return helpers.no_op(env)

  return act


def diverging(env: environment.Environment, episode: int, step: int) -> Any:
  """Breaks the physics in one of the episodes."""

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    here = env.mechanism.step_count(env.physics)
    if env._episode == episode and here == step:
      env.physics.data.qvel[0] = math.nan
    return helpers.no_op(env)

  return act
