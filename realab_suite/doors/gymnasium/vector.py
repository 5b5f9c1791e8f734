"""A batch of worlds with the interface of Gymnasium's vector environments."""

from collections.abc import Sequence
from typing import Any, final

import gymnasium as gym
from gymnasium.vector import utils
import numpy as np

from realab_suite import errors
from realab_suite import trees
from realab_suite.config import integers
from realab_suite.config import messages
from realab_suite.doors.gymnasium import codecs
from realab_suite.doors.gymnasium import interfaces
from realab_suite.engine import agent_view
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps

AutoresetMode = gym.vector.AutoresetMode


@final
class RealabVectorEnv(agent_view.Uncopied, gym.vector.VectorEnv):
  """A batch of worlds as a `gymnasium.vector.VectorEnv`.

  World i is bit for bit the `RealabEnv` with `environment_kwargs={'world': i}`
  and the same seed. Rewards, ends and privacy are as in `RealabEnv`.

  In the mode `SAME_STEP`, `infos` contains `final_obs` and `final_info` of the
  worlds whose episodes have ended, and otherwise nothing.
  """

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      *,
      autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
      **options: Any,
  ) -> None:
    """Makes an adapter. Prefer `gymnasium.make_vec`.

    Args:
      batch: Batch from `suite.load_batch`. `close` closes it.
      autoreset_mode: Beginning of the next episode of a world: with the next
        step (`'NextStep'`), with the same step (`'SameStep'`), or with
        `reset(options={'reset_mask': ...})` (`'Disabled'`).
      **options: Values of `interfaces.Options`, such as `reward_register`.

    Raises:
      SpecError: If an argument is invalid.
    """
    self.autoreset_mode = _checked_mode(autoreset_mode)
    self._batch = batch
    self._view = agent_view.BatchAgentView(batch)
    self._interface = interfaces.Interface(self._view, batch, options)
    self.metadata = {
        **self._interface.metadata,
        'autoreset_mode': self.autoreset_mode,
    }
    self.render_mode = self._interface.render_mode
    self.num_envs = batch.num_envs
    self.single_observation_space = self._interface.observations.space
    self.single_action_space = self._interface.actions.space
    self.observation_space = utils.batch_space(
        self.single_observation_space, self.num_envs
    )
    self.action_space = utils.batch_space(
        self.single_action_space, self.num_envs
    )
    self._has_begun = False
    self._is_over = np.zeros(self.num_envs, bool)
    # Present observations of all worlds, for a reset of single worlds.
    self._present: dict[str, np.ndarray] = {}

  def reset(
      self,
      *,
      seed: Any = None,
      options: dict[str, Any] | None = None,
  ) -> tuple[codecs.Observation, dict[str, Any]]:
    """Starts the next episodes, or the first ones of a seed.

    Args:
      seed: New seed of all worlds, or a sequence with one for each; `None`,
        alone or in a sequence, for the next episode of the present one. With
        one seed, worlds still differ, because their random streams depend on
        the index.
      options: `None`, or a dict. `reset_mask`, `(worlds,)` bool, selects the
        worlds to reset; `seed` is then `None`.

    Returns:
      The observations of all worlds and an empty dict.

    Raises:
      SpecError: If a seed, a name or the mask is invalid, or the mask is given
        with a seed.
    """
    options = options or {}
    interfaces.check_names(options, ['reset_mask'])
    mask = options.get('reset_mask')
    if mask is not None:
      self._reset_some(_checked_mask(mask, self.num_envs, seed))
      lead = (self.num_envs,)
      return self._interface.observations.encode(self._present, lead), {}
    is_one = not isinstance(seed, Sequence | np.ndarray)
    super().reset(seed=seed if is_one else None, options=options)
    if seed is not None:
      seeds = _checked_seeds([seed] if is_one else seed)
      new = seeds[0] if is_one else seeds
      interfaces.shielded(lambda: self._batch.rewind(new))
    time_step = self._view.reset()
    self._present = time_step.observation
    self._has_begun = True
    self._is_over = np.zeros(self.num_envs, bool)
    return self._encode(time_step), {}

  def step(
      self, actions: Any
  ) -> tuple[
      codecs.Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]
  ]:
    """Runs one control step of every world.

    Args:
      actions: Actions, an element of `action_space`.

    Returns:
      Observations, rewards, terminations, truncations and infos.

    Raises:
      ActionError: If an action is not in `single_action_space`.
      ResetNeeded: If the worlds were never reset, or if one has ended in the
        mode `DISABLED`.
      WorldError: If a world failed. All episodes are over.
    """
    if not self._has_begun or (
        self.autoreset_mode is AutoresetMode.DISABLED and self._is_over.any()
    ):
      raise gym.error.ResetNeeded(
          'step: a world has no episode; call reset(), or'
          " reset(options={'reset_mask': ...}) for single worlds"
      )
    decoded = self._interface.actions.decode(actions)
    try:
      time_step = self._view.step(decoded)
    except errors.WorldError:
      self._has_begun = False
      raise
    self._present = time_step.observation
    self._is_over = time_step.last()
    terminated = self._is_over & (time_step.discount == 0.0)
    truncated = self._is_over & ~terminated
    rewards = self._rewards(time_step)
    observations = self._encode(time_step)
    infos: dict[str, Any] = {}
    if self.autoreset_mode is AutoresetMode.SAME_STEP and self._is_over.any():
      worlds = np.flatnonzero(self._is_over)
      for world in worlds.tolist():
        final = {
            'final_obs': trees.taken(observations, world),
            'final_info': {},
        }
        infos = self._add_info(infos, final, world)
      first = self._encode(self._reset_some(self._is_over))
      observations = trees.put(observations, worlds, first)
    return observations, rewards, terminated, truncated, infos

  def render(self) -> tuple[np.ndarray, ...] | None:
    """Returns a frame of each world for people, or `None`.

    Raises:
      RenderingError: If no renderer is available, or if it fails.
    """
    if self.render_mode is None:
      return None
    camera, height, width = self._interface.frame
    # A batch has no free camera, and refuses its number.
    return tuple(
        interfaces.shielded(
            lambda: self._batch.render(None, str(camera), height, width)
        )
    )

  def close_extras(self, **kwargs: Any) -> None:
    """Frees the worlds."""
    del kwargs
    self._view.close()
    self._batch.close()
    # From here on, steps are refused as those of a closed world.
    self._has_begun, self._is_over = True, np.zeros(self.num_envs, bool)

  def _reset_some(self, mask: np.ndarray) -> batch_time_steps.BatchTimeStep:
    """Resets the worlds of a mask; returns their first time steps."""
    if not self._has_begun and not mask.all():
      raise gym.error.ResetNeeded(
          'reset_mask: the other worlds were never reset; call reset() first'
      )
    (worlds,) = np.nonzero(mask)
    first = self._view.reset(worlds.tolist())
    self._has_begun = True
    self._is_over = self._is_over & ~mask
    if len(worlds) == self.num_envs:
      self._present = first.observation
    else:
      self._present = trees.put(self._present, worlds, first.observation)
    return first

  def _encode(
      self, time_step: batch_time_steps.BatchTimeStep
  ) -> codecs.Observation:
    lead = (len(time_step.step_type),)
    return self._interface.observations.encode(time_step.observation, lead)

  def _rewards(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    """Returns rewards; the reading in a first step rewards no action."""
    key = self._interface.reward_key
    if key is None:
      return np.zeros(self.num_envs)
    readings = time_step.observation[key]
    return np.where(time_step.first(), 0.0, readings)


def _checked_mode(value: Any) -> AutoresetMode:
  try:
    return AutoresetMode(value)
  except ValueError:
    allowed = [mode.value for mode in AutoresetMode]
    raise errors.SpecError(
        f'autoreset_mode: {messages.quote(value)}; must be one of {allowed}'
    ) from None


def _checked_seeds(seeds: Sequence[Any] | np.ndarray) -> list[int | None]:
  """Returns seeds as integers of Python, which run no code of the agent."""
  if isinstance(seeds, np.ndarray):
    seeds = np.atleast_1d(seeds).tolist()
  return [
      None if seed is None else integers.check('seed', seed, 0, None)
      for seed in seeds
  ]


def _checked_mask(reset_mask: Any, num_envs: int, seed: Any) -> np.ndarray:
  mask = np.asarray(reset_mask)
  if mask.shape != (num_envs,) or mask.dtype != bool or not mask.any():
    raise errors.SpecError(
        f'reset_mask: {messages.quote(reset_mask)}; must be an array of'
        f' {num_envs} bools, at least one of them True'
    )
  if seed is not None:
    raise errors.SpecError(
        f'reset_mask with seed {messages.quote(seed)}; must be None, because'
        ' a seed applies to all worlds'
    )
  return mask
