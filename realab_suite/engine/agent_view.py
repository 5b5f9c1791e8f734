"""What an agent in the same process is handed: a data channel, nothing behind.

The evaluator holds the environment, the agent a view of it. To a learner that
uses Python's public names, nothing leads from one to the other. It is no wall
against hostile code, for which there is none within one process.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeVar, final

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.feedback import specs

_SENSES = 'senses/'
_REGISTERS = 'registers/'

_T = TypeVar('_T')


class _View(abc.ABC):
  """What the views of one world and of many have in common.

  - Observations have the keys that an agent may have when the view is made:
    `senses/<name>`, and `registers/<name>` of registers that agents read. No
    other key ever passes, whatever anybody enables later.
  - Arrays are the agent's own.
  - Exceptions are `ActionError`, about the agent's own action, `ClosedError`,
    and `WorldError` for all else: its message is a number, and it carries
    neither a cause nor frames of the environment.
  """

  # By private names, so that no public one leads to the environment.
  __slots__ = (
      '__action_spec',
      '__actions_shape',
      '__env',
      '__failures',
      '__is_closed',
      '__num_failures',
      '__observation_spec',
  )

  def __init__(
      self, env: Any, actions_shape: tuple[int, ...], failures: Any
  ) -> None:
    design = env.mechanism.design
    readable = {
        _REGISTERS + name for name in design.names(*specs.READ_BY_AGENTS)
    }
    self.__env = env
    self.__actions_shape = actions_shape
    self.__failures = failures
    self.__num_failures = 0
    self.__is_closed = False
    self.__action_spec = env.action_spec()
    self.__observation_spec = {
        key: spec
        for key, spec in env.observation_spec().items()
        if key.startswith(_SENSES) or key in readable
    }

  def action_spec(self) -> dm_env_specs.Array:
    """Returns the spec of an action, in one world."""
    return self.__guard(lambda: _copy(self.__action_spec))

  def observation_spec(self) -> dict[str, dm_env_specs.Array]:
    """Returns the spec of an observation, in one world."""
    return self.__guard(
        lambda: {k: _copy(s) for k, s in self.__observation_spec.items()}
    )

  def reward_spec(self) -> dm_env_specs.BoundedArray:
    """Returns the spec of a reward that is 0.0."""
    return self.__guard(
        lambda: dm_env_specs.BoundedArray(
            (), np.float64, 0.0, 0.0, name='reward'
        )
    )

  def discount_spec(self) -> dm_env_specs.BoundedArray:
    """Returns the spec of a discount; it is 1.0 until an episode ends."""
    return self.__guard(
        lambda: dm_env_specs.BoundedArray(
            (), np.float64, 0.0, 1.0, name='discount'
        )
    )

  def reset(self) -> Any:
    """Starts the next episode; the one under way is abandoned."""
    return self.__guard(lambda: self._restate(self.__env.reset()))

  def step(self, action: Any) -> Any:
    """Runs one control step.

    Raises:
      ActionError: If the action does not fit. Nothing has moved.
      ClosedError: If the agent or the evaluator has closed its end.
      WorldError: If the world failed. The episode is over.
    """
    self.__guard(lambda: None)
    given = self.__checked(action)
    return self.__guard(lambda: self._restate(self.__env.step(given)))

  def close(self) -> None:
    """Ends the agent's use of the view; closing twice does nothing.

    The environment is the evaluator's, and stays as it is: an episode that is
    under way goes on to be under way.
    """
    self.__is_closed = True

  def __reduce_ex__(self, protocol: Any) -> Any:
    """Refuses `copy` and `pickle`, which would hand over the environment."""
    raise TypeError('views cannot be pickled or copied')

  def __reduce__(self) -> Any:
    return self.__reduce_ex__(0)

  def __getstate__(self) -> Any:
    return self.__reduce_ex__(0)

  @abc.abstractmethod
  def _restate(self, time_step: Any) -> Any:
    """Returns the part of a time step that the agent may see."""

  def _filtered(self, observation: Any) -> dict[str, np.ndarray]:
    """Returns the agent's own copies of what it may observe."""
    return {
        key: np.array(observation[key], spec.dtype, order='C')
        for key, spec in self.__observation_spec.items()
    }

  def __checked(self, action: Any) -> np.ndarray:
    """Returns a copy of an action that fits.

    No code of the agent's, as in an `__array__`, runs below a frame of the
    environment. And what raises `ActionError` down there is not about the
    action, for that has been checked here.
    """
    problem: errors.ActionError
    try:
      # A masked array stays one, and is refused for it.
      given = np.array(action, subok=np.ma.isMaskedArray(action))
      self.__env.codec.decode(given, self.__actions_shape)
      return given
    except errors.ActionError as error:
      problem = errors.ActionError(str(error))
    except Exception:  # An object may raise what it likes.
      problem = errors.ActionError(
          f'action: {type(action).__name__} is no array of numbers'
      )
    # Out here an exception has no context, and no frames but the view's.
    raise problem

  def __guard(self, call: Callable[[], _T]) -> _T:
    """Calls a function, and lets no exception of the environment through."""
    problem: errors.RealabError
    if self.__is_closed:
      raise _closed()
    try:
      return call()
    except errors.ClosedError:
      problem = _closed()
    except Exception as error:
      problem = errors.WorldError(
          f'error {self.__num_failures} of this view: the world failed; the'
          ' evaluator knows how'
      )
      self.__num_failures += 1
      if self.__failures is not None:
        self.__failures.append(error)
    raise problem


@final
class AgentView(_View, dm_env.Environment):
  """An environment, as an agent in the same process gets it.

      env = suite.load('unlock_door', 'standard', design='value_advice')
      env.add_sink(ledger.Ledger())
      agent = make_agent(agent_view.AgentView(env))

  `reset`, `step`, `close` and the specs, and nothing else. `reward` is 0.0;
  `discount` is 1.0 but for the end of an episode, where it is the task's.
  """

  __slots__ = ()

  def __init__(
      self,
      env: environment.Environment,
      failures: list[Exception] | None = None,
  ) -> None:
    """Makes a view; the environment stays the caller's.

    Args:
      env: What is viewed.
      failures: A list of the caller's own, which gets the exceptions that the
        agent is not told of: error n is the n-th.

    Raises:
      SpecError: If `env` is something else.
    """
    _check_kind(env, environment.Environment)
    super().__init__(env, (), failures)

  def _restate(self, time_step: dm_env.TimeStep) -> dm_env.TimeStep:
    observation = self._filtered(time_step.observation)
    if time_step.first():
      return dm_env.restart(observation)
    if time_step.mid():
      return dm_env.transition(0.0, observation)
    return dm_env.TimeStep(
        dm_env.StepType.LAST, 0.0, float(time_step.discount), observation
    )


@final
class BatchAgentView(_View):
  """Many worlds, as an agent in the same process gets them; see `AgentView`.

  Time steps are `BatchTimeStep`s, actions have a leading axis of worlds.
  """

  __slots__ = ()

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      failures: list[Exception] | None = None,
  ) -> None:
    """Makes a view; the batch stays the caller's.

    Args:
      batch: What is viewed.
      failures: As in `AgentView`.

    Raises:
      SpecError: If `batch` is something else.
    """
    _check_kind(batch, batch_environment.BatchEnvironment)
    super().__init__(batch, (batch.num_envs,), failures)

  def _restate(
      self, time_step: batch_environment.BatchTimeStep
  ) -> batch_environment.BatchTimeStep:
    is_last = time_step.step_type == int(dm_env.StepType.LAST)
    return batch_environment.BatchTimeStep(
        np.array(time_step.step_type),
        np.zeros(len(is_last)),
        np.where(is_last, time_step.discount, 1.0),
        self._filtered(time_step.observation),
    )


def _check_kind(env: Any, kind: type) -> None:
  if not isinstance(env, kind):
    raise errors.SpecError(
        f'env: {type(env).__name__}; allowed is a {kind.__name__}'
    )


def _closed() -> errors.ClosedError:
  return errors.ClosedError('this environment is closed')


def _copy(spec: dm_env_specs.Array) -> dm_env_specs.Array:
  """Returns a spec of the caller's own."""
  return spec.replace(name=spec.name)
