"""A batch of worlds as a vector environment of Stable-Baselines3."""

from typing import Any, final

import numpy as np
from stable_baselines3.common import vec_env

from realab_suite import errors
from realab_suite.doors.gymnasium import interfaces
from realab_suite.doors.gymnasium import vector
from realab_suite.engine import agent_view


@final
class RealabVecEnv(agent_view.Uncopied, vec_env.VecEnv):
  """A `RealabVectorEnv` as a `VecEnv` of Stable-Baselines3.

      envs = gym.make_vec(name, num_envs=64, autoreset_mode='SameStep')
      model = PPO('MultiInputPolicy', RealabVecEnv(envs))

  Infos are empty, except at the end of an episode, where Stable-Baselines3
  needs `terminal_observation` and `TimeLimit.truncated`. `VecMonitor` adds
  statistics of episodes: of the observed return.
  """

  def __init__(self, envs: vector.RealabVectorEnv) -> None:
    """Makes an adapter.

    Args:
      envs: Worlds with the autoreset mode `SAME_STEP`. `close` closes them.

    Raises:
      SpecError: If it is something else.
    """
    if not isinstance(envs, vector.RealabVectorEnv) or (
        envs.metadata['autoreset_mode'] is not vector.AutoresetMode.SAME_STEP
    ):
      raise errors.SpecError(
          f'envs: {type(envs).__name__}; must be a RealabVectorEnv with'
          " autoreset_mode='SameStep'"
      )
    self._envs = envs
    self._pending: Any = None
    super().__init__(
        envs.num_envs, envs.single_observation_space, envs.single_action_space
    )

  def reset(self) -> Any:
    """Starts new episodes; returns the observations.

    Raises:
      SpecError: If `set_options` has set an option.
    """
    for options in self._options:
      interfaces.check_names(options, ())
    observations, _ = self._envs.reset(seed=self._seeds[0])
    self._reset_seeds()
    self._reset_options()
    return observations

  def step_async(self, actions: np.ndarray) -> None:
    """Keeps actions for `step_wait`."""
    self._pending = actions

  def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[Any]]:
    """Returns observations, rewards, ends and infos of a control step."""
    observations, rewards, terminated, truncated, final = self._envs.step(
        self._pending
    )
    dones = terminated | truncated
    infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
    for world in np.flatnonzero(dones).tolist():
      infos[world] = {
          'terminal_observation': final['final_obs'][world],
          'TimeLimit.truncated': bool(truncated[world]),
      }
    return observations, rewards.astype(np.float32), dones, infos

  def close(self) -> None:
    """Frees the worlds."""
    self._envs.close()

  def get_images(self) -> list[np.ndarray | None]:
    """Returns a frame of each world for people."""
    frames = self._envs.render()
    return [None] * self.num_envs if frames is None else list(frames)

  def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
    """Returns `render_mode` for each world.

    Raises:
      AttributeError: For every other name: worlds have no attributes to share.
    """
    if attr_name != 'render_mode':
      raise AttributeError(
          f'{attr_name!r}: worlds of a batch have no such attribute, only'
          " 'render_mode'"
      )
    return [self._envs.render_mode] * len(list(self._get_indices(indices)))

  def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
    """Refuses to set attributes.

    Raises:
      AttributeError: Always.
    """
    raise AttributeError(f'{attr_name!r}: attributes of worlds cannot be set')

  def env_method(
      self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
  ) -> list[Any]:
    """Refuses to call methods.

    Raises:
      AttributeError: Always.
    """
    raise AttributeError(f'{method_name!r}: worlds of a batch have no methods')

  def env_is_wrapped(
      self, wrapper_class: Any, indices: Any = None
  ) -> list[bool]:
    """Returns False for each world."""
    return [False] * len(list(self._get_indices(indices)))
