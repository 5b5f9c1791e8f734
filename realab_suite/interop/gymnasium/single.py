"""One world with the interface of Gymnasium."""

from typing import Any, final

import gymnasium as gym
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.engine import agent_view
from realab_suite.engine import arguments
from realab_suite.engine import environment
from realab_suite.interop.gymnasium import codecs

RENDER_MODES = ('rgb_array',)
"""Modes in which people can watch a world."""

FRAMES_PER_SECOND = 10
"""One frame per control step of the shipped worlds."""


@final
class RealabEnv(gym.Env):
  """A world of this package as a `gymnasium.Env`.

  `info` is always empty. The reward is 0.0, or the reading of a register: the
  observed reward, which can be tampered with. An episode that its time limit
  or a failure of the physics ends is truncated; every other end with discount
  0 is a termination.

  The environment itself is private: no public attribute leads to the true
  reward, to ledgers or to the physics.
  """

  def __init__(
      self,
      env: environment.Environment,
      *,
      reward_register: str | None = None,
      dtype: codecs.DType = 'float32',
      flat: bool = False,
      render_mode: str | None = None,
      camera_name: str = 'top_down',
      height: int = 240,
      width: int = 320,
      failures: list[Exception] | None = None,
  ) -> None:
    """Makes an adapter. Prefer `gymnasium.make`.

    Args:
      env: Environment from `suite.load` or `suite.embed`. `close` closes it.
      reward_register: Name of the register whose reading is the reward, or
        `None` for a reward of 0.0.
      dtype: Type of floats in observations and actions.
      flat: True for observations that are one vector.
      render_mode: `'rgb_array'`, or `None`. Frames are for people.
      camera_name: Camera of the frames.
      height: Height of a frame, in pixels.
      width: Width of a frame, in pixels.
      failures: List of the caller, to which exceptions of the world are
        appended; see `agent_view.AgentView`.

    Raises:
      SpecError: If an argument is invalid.
    """
    self.metadata = {
        'render_modes': list(RENDER_MODES),
        'render_fps': FRAMES_PER_SECOND,
    }
    self._view = agent_view.AgentView(env, failures)
    self._environment = env
    spec = self._view.observation_spec()
    self._reward_key = codecs.reward_key(reward_register, spec)
    self._observations = codecs.ObservationCodec(spec, dtype, flat)
    self._actions = codecs.ActionCodec(self._view.action_spec(), dtype)
    self.observation_space = self._observations.space
    self.action_space = self._actions.space
    self.render_mode = checked_render_mode(render_mode)
    self._frame = (
        arguments.camera(camera_name, env.task.root_entity.mjcf_model),
        height,
        width,
    )
    self._is_over = True

  def reset(
      self,
      *,
      seed: int | None = None,
      options: dict[str, Any] | None = None,
  ) -> tuple[codecs.Observation, dict[str, Any]]:
    """Starts the next episode, or the first one of a seed.

    Args:
      seed: New seed, or `None`.
      options: Ignored.

    Returns:
      The observation and an empty dict.
    """
    super().reset(seed=seed, options=options)
    if seed is not None:
      self._environment.rewind(random=seed)
    time_step = self._view.reset()
    self._is_over = False
    return self._observations.encode(time_step.observation), {}

  def step(
      self, action: Any
  ) -> tuple[codecs.Observation, float, bool, bool, dict[str, Any]]:
    """Runs one control step.

    Returns:
      Observation, reward, terminated, truncated, and an empty dict.

    Raises:
      ActionError: If the action is not in `action_space`.
      ResetNeeded: If no episode is running.
      WorldError: If the world failed. The episode is over.
    """
    if self._is_over:
      raise gym.error.ResetNeeded(
          'step: no episode is running; call reset() first'
      )
    action = self._actions.decode(action)
    try:
      time_step = self._view.step(action)
    except errors.WorldError:
      self._is_over = True
      raise
    self._is_over = time_step.last()
    terminated = self._is_over and time_step.discount == 0.0
    return (
        self._observations.encode(time_step.observation),
        self._reward(time_step.observation),
        bool(terminated),
        bool(self._is_over and not terminated),
        {},
    )

  def render(self) -> np.ndarray | None:
    """Returns a frame for people, `(height, width, 3)` uint8, or `None`."""
    if self.render_mode is None:
      return None
    camera, height, width = self._frame
    frame: np.ndarray = self._environment.physics.render(
        height, width, camera_id=camera
    )
    return frame

  def close(self) -> None:
    """Frees the world. Closing it again has no effect."""
    self._view.close()
    self._environment.close()

  def _reward(self, observation: dict[str, np.ndarray]) -> float:
    if self._reward_key is None:
      return 0.0
    return float(observation[self._reward_key])


def checked_render_mode(given: Any) -> str | None:
  """Returns a render mode.

  Raises:
    SpecError: If there is no such mode.
  """
  if given is not None and given not in RENDER_MODES:
    raise errors.SpecError(
        f'render_mode: {messages.quote(given)}; allowed are None and'
        f' {list(RENDER_MODES)}'
    )
  return None if given is None else str(given)


def environment_of(env: gym.Env) -> environment.Environment:
  """Returns the environment behind an adapter, for the evaluator's side.

  Args:
    env: A `RealabEnv`, which may be wrapped.

  Raises:
    ResultsError: If it is another environment.
  """
  base = env.unwrapped
  if not isinstance(base, RealabEnv):
    raise errors.ResultsError(
        f'env: {type(base).__name__}; allowed is an environment of'
        ' realab_suite.interop.gymnasium, which may be wrapped'
    )
  return base._environment
