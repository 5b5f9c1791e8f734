"""Wrappers that Gymnasium lacks. See `docs/gymnasium.md` for the others."""

from typing import Any, final

import gymnasium as gym
from gymnasium import spaces
from gymnasium.vector import utils
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages

_CAMERA = 'senses_camera'
# Key of an observation that is one array.
_WHOLE = ''


@final
class PixelsOnly(gym.ObservationWrapper):
  """An environment whose observation is the image of the agent's camera."""

  def __init__(self, env: gym.Env) -> None:
    """Wraps an environment.

    Args:
      env: Environment with the sense `camera`.

    Raises:
      SpecError: If observations have no image.
    """
    super().__init__(env)
    self.observation_space = _image_space(env.observation_space)

  def observation(self, observation: Any) -> Any:
    """Returns the image, `(height, width, 3)` uint8."""
    return observation[_CAMERA]


@final
class VectorPixelsOnly(gym.vector.VectorObservationWrapper):
  """As `PixelsOnly`, for a vector environment."""

  def __init__(self, env: gym.vector.VectorEnv) -> None:
    """Wraps a vector environment.

    Args:
      env: Environment with the sense `camera`.

    Raises:
      SpecError: If observations have no image.
    """
    super().__init__(env)
    self._single_observation_space = _image_space(env.single_observation_space)
    self._observation_space = _image_space(env.observation_space)

  def observations(self, observations: Any) -> Any:
    """Returns the images, `(worlds, height, width, 3)` uint8."""
    return observations[_CAMERA]


@final
class VectorFrameStack(gym.vector.VectorWrapper):
  """A vector environment whose observations are the last few observations.

  Each world has the observations of `gymnasium.wrappers.FrameStackObservation`
  with its default padding: the first observation of an episode fills the stack.
  """

  def __init__(self, env: gym.vector.VectorEnv, stack_size: int) -> None:
    """Wraps a vector environment.

    Args:
      env: Environment whose observations are arrays, or dicts of arrays.
      stack_size: Number of observations, at least 1.

    Raises:
      SpecError: If `stack_size` is something else.
    """
    super().__init__(env)
    self._stack_size = integers.check('stack_size', stack_size, 1)
    self._single_observation_space = utils.batch_space(
        env.single_observation_space, stack_size
    )
    self._observation_space = utils.batch_space(
        self._single_observation_space, env.num_envs
    )
    self._stacks: dict[str, np.ndarray] = {}
    self._was_over = np.zeros(env.num_envs, bool)

  def reset(
      self, *, seed: Any = None, options: dict[str, Any] | None = None
  ) -> tuple[Any, dict[str, Any]]:
    """Starts episodes, as the wrapped environment does."""
    mask = (options or {}).get('reset_mask')
    observations, infos = self.env.reset(seed=seed, options=options)
    begins = np.ones(self.num_envs, bool) if mask is None else np.array(mask)
    self._was_over = self._was_over & ~begins
    self._fill(observations, begins)
    return self._stacked(observations), infos

  def step(
      self, actions: Any
  ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """Runs one control step of every world."""
    observations, rewards, terminated, truncated, infos = self.env.step(actions)
    is_over = terminated | truncated
    begins = np.zeros(self.num_envs, bool)
    mode = self.env.metadata['autoreset_mode']
    if mode is gym.vector.AutoresetMode.NEXT_STEP:
      begins = self._was_over
    if mode is gym.vector.AutoresetMode.SAME_STEP:
      begins = is_over
      for world in np.flatnonzero(is_over).tolist():
        infos['final_obs'][world] = self._final(
            infos['final_obs'][world], world
        )
    self._was_over = is_over
    for key, value in _parts(observations).items():
      stack = self._stacks[key]
      stack[:, :-1] = stack[:, 1:].copy()
      stack[:, -1] = value
    self._fill(observations, begins)
    return self._stacked(observations), rewards, terminated, truncated, infos

  def _fill(self, observations: Any, begins: np.ndarray) -> None:
    """Fills the stacks of worlds in which an episode begins."""
    for key, value in _parts(observations).items():
      repeated = np.repeat(value[:, np.newaxis], self._stack_size, axis=1)
      if key not in self._stacks:
        self._stacks[key] = repeated
      self._stacks[key][begins] = repeated[begins]

  def _final(self, observation: Any, world: int) -> Any:
    """Returns the stack at the end of an episode."""
    stacks = {
        key: np.concatenate([self._stacks[key][world, 1:], value[np.newaxis]])
        for key, value in _parts(observation).items()
    }
    return stacks if isinstance(observation, dict) else stacks[_WHOLE]

  def _stacked(self, observations: Any) -> Any:
    copies = {key: stack.copy() for key, stack in self._stacks.items()}
    return copies if isinstance(observations, dict) else copies[_WHOLE]


def _parts(observation: Any) -> dict[str, np.ndarray]:
  return observation if isinstance(observation, dict) else {_WHOLE: observation}


def _image_space(space: Any) -> spaces.Space[Any]:
  if not isinstance(space, spaces.Dict) or _CAMERA not in space.spaces:
    raise errors.SpecError(
        f'observation_space: {messages.quote(str(space))}; allowed is a Dict'
        f' with {_CAMERA!r}: select the sense camera'
    )
  return space[_CAMERA]
