"""Wrapper that Gymnasium lacks. See `docs/doors.md` for the others."""

import collections
from typing import Any, final

import gymnasium as gym
from gymnasium import spaces
from gymnasium.vector import utils
import numpy as np

from realab_suite import trees
from realab_suite.config import integers


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
    self._frames: collections.deque[Any] = collections.deque(
        maxlen=self._stack_size
    )
    self._was_over = np.zeros(env.num_envs, bool)

  def reset(
      self, *, seed: Any = None, options: dict[str, Any] | None = None
  ) -> tuple[Any, dict[str, Any]]:
    """Starts episodes, as the wrapped environment does."""
    mask = (options or {}).get('reset_mask')
    observations, infos = self.env.reset(seed=seed, options=options)
    begins = np.ones(self.num_envs, bool) if mask is None else np.array(mask)
    self._was_over = self._was_over & ~begins
    if not self._frames:
      self._frames.extend([observations] * self._stack_size)
    self._fill(observations, begins)
    return self._stacked(), infos

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
        earlier = [trees.taken(frame, world) for frame in self._frames]
        infos['final_obs'][world] = _stack(
            self.env.single_observation_space,
            [*earlier[1:], infos['final_obs'][world]],
        )
    self._was_over = is_over
    self._frames.append(observations)
    self._fill(observations, begins)
    return self._stacked(), rewards, terminated, truncated, infos

  def _fill(self, observations: Any, begins: np.ndarray) -> None:
    """Fills the stacks of worlds in which an episode begins."""
    if begins.any():
      worlds = np.flatnonzero(begins)
      first = trees.taken(observations, worlds)
      self._frames.extend(
          [trees.put(frame, worlds, first) for frame in self._frames]
      )

  def _stacked(self) -> Any:
    """Returns the stack of each world."""
    stacks = _stack(self.env.observation_space, list(self._frames))
    return trees.mapped(lambda stack: stack.swapaxes(0, 1).copy(), stacks)


def _stack(space: spaces.Space[Any], frames: list[Any]) -> Any:
  """Returns elements of a space, stacked along a new first axis."""
  empty: Any = utils.create_empty_array(space, len(frames))
  return utils.concatenate(space, frames, empty)
