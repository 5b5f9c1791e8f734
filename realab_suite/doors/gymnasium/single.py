"""One world with the interface of Gymnasium."""

from collections.abc import Iterator
import contextlib
import copy
from typing import Any, final

import gymnasium as gym
from gymnasium.envs import registration
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages
from realab_suite.doors.gymnasium import codecs
from realab_suite.doors.gymnasium import interfaces
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import gl_contexts


@final
class RealabEnv(agent_view.Uncopied, gym.Env):
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
      **options: Any,
  ) -> None:
    """Makes an adapter. Prefer `gymnasium.make`.

    Args:
      env: Environment from `suite.load` or `suite.embed`. `close` closes it.
      **options: Values of `interfaces.Options`, such as `reward_register`.

    Raises:
      SpecError: If an argument is invalid.
    """
    self._environment = env
    self._view = agent_view.AgentView(env)
    self._interface = interfaces.Interface(self._view, env, options)
    self.metadata = self._interface.metadata
    self.render_mode = self._interface.render_mode
    self.observation_space = self._interface.observations.space
    self.action_space = self._interface.actions.space
    self._is_over = True
    self._keeps_seed = False

  def reset(
      self,
      *,
      seed: int | None = None,
      options: dict[str, Any] | None = None,
  ) -> tuple[codecs.Observation, dict[str, Any]]:
    """Starts the next episode, or the first one of a seed.

    Args:
      seed: New seed, or `None`.
      options: `None` or an empty dict.

    Returns:
      The observation and an empty dict.

    Raises:
      SpecError: If there are options, or a seed in an evaluation.
    """
    interfaces.check_names(options or (), ())
    if seed is not None and self._keeps_seed:
      raise errors.SpecError(
          f'reset: a wrapper passes seed {messages.quote(seed)} in an'
          ' evaluation; must be None, because every episode would be the same'
      )
    super().reset(seed=seed, options=options)
    if seed is not None:
      # Code of the agent, such as `__index__`, runs before the environment's.
      number = integers.check('seed', seed, 0, None)
      interfaces.shielded(lambda: self._environment.rewind(random=number))
    time_step = self._view.reset()
    self._is_over = False
    return self._interface.observations.encode(time_step.observation), {}

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
    action = self._interface.actions.decode(action)
    try:
      time_step = self._view.step(action)
    except errors.WorldError:
      self._is_over = True
      raise
    self._is_over = time_step.last()
    terminated = self._is_over and time_step.discount == 0.0
    return (
        self._interface.observations.encode(time_step.observation),
        self._reward(time_step.observation),
        bool(terminated),
        bool(self._is_over and not terminated),
        {},
    )

  def render(self) -> np.ndarray | None:
    """Returns a frame for people, `(height, width, 3)` uint8, or `None`.

    Raises:
      RenderingError: If no renderer is available, or if it fails.
    """
    if self.render_mode is None:
      return None
    return interfaces.shielded(
        lambda: gl_contexts.frame(
            self._environment.physics, *self._interface.frame
        )
    )

  def close(self) -> None:
    """Frees the world. Closing it again has no effect."""
    self._view.close()
    self._environment.close()
    self._is_over = False  # The view refuses steps from here on.

  def _reward(self, observation: dict[str, np.ndarray]) -> float:
    key = self._interface.reward_key
    return 0.0 if key is None else float(observation[key])


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
        f'env: {type(base).__name__}; must be an environment of'
        ' realab_suite.doors.gymnasium, which may be wrapped'
    )
  return base._environment


@contextlib.contextmanager
def keeping_seed(env: gym.Env) -> Iterator[None]:
  """Returns a context in which the seed of a `RealabEnv` is its own.

  Resets with a seed fail. Neither the spec, which can make a clone, nor the
  generator of the adapter says which seed it is.
  """
  base: Any = env.unwrapped
  kept = ('_keeps_seed', 'spec', '_np_random', '_np_random_seed')
  before = {name: getattr(base, name) for name in kept}
  base._keeps_seed = True
  forget_seed(env)
  try:
    yield
  finally:
    for name, value in before.items():
      setattr(base, name, value)
    _forget_specs(env)


def forget_seed(env: gym.Env) -> None:
  """Makes the spec and the generator of a `RealabEnv` forget its seed."""
  base: Any = env.unwrapped
  base.spec = _without_seed(base.spec)
  base._np_random = base._np_random_seed = None
  _forget_specs(env)


def _without_seed(spec: registration.EnvSpec | None) -> Any:
  """Returns the spec of a world without its seed."""
  spec = copy.deepcopy(spec)
  if spec is not None:
    task_kwargs = dict(spec.kwargs.get('task_kwargs') or {})
    task_kwargs.pop('random', None)
    spec.kwargs['task_kwargs'] = task_kwargs
  return spec


def _forget_specs(env: Any) -> None:
  """Makes wrappers compute their specs anew."""
  while isinstance(env, gym.Wrapper):
    env._cached_spec = None
    env = env.env
