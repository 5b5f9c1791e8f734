"""Views: the interface of an environment for an agent in the same process.

The evaluator keeps the environment, and the agent gets a view of it. No public
name of a view leads to the environment. A view does not protect against
hostile code; within one process, nothing can.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, final

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import arguments
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import environment
from realab_suite.feedback import specs

_SENSES = 'senses/'
_REGISTERS = 'registers/'

_T = TypeVar('_T')


class Uncopied(abc.ABC):  # noqa: B024 - It only refuses.
  """Base class of the faces of a world for agents.

  `copy` and `pickle` are refused, because they would expose the environment.
  """

  __slots__ = ()

  def __reduce_ex__(self, protocol: Any) -> Any:
    raise TypeError(f'{type(self).__name__} cannot be pickled or copied')


class _View(Uncopied):
  """Base class of the views of one world and of a batch.

  - Observations contain the keys that the agent may observe when the view is
    created: `senses/<name>`, and `registers/<name>` of registers that agents
    read. Observables that are enabled later are never added.
  - Arrays are copies that belong to the agent.
  - The only exceptions are `ActionError` for an invalid action, `ClosedError`,
    `ForkError`, and `WorldError` for everything else. A `WorldError` contains
    only a number. None has a cause or traceback frames of the environment.
  """

  # Private names: no public attribute leads to the environment.
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
    """Returns the action spec of one world."""
    return self.__guard(lambda: _copy(self.__action_spec))

  def observation_spec(self) -> dict[str, dm_env_specs.Array]:
    """Returns the observation spec of one world."""
    return self.__guard(
        lambda: {k: _copy(s) for k, s in self.__observation_spec.items()}
    )

  def reward_spec(self) -> dm_env_specs.BoundedArray:
    """Returns the reward spec: a float64 scalar with both bounds 0.0."""
    return self.__guard(
        lambda: dm_env_specs.BoundedArray(
            (), np.float64, 0.0, 0.0, name='reward'
        )
    )

  def discount_spec(self) -> dm_env_specs.BoundedArray:
    """Returns the discount spec. Discounts are 1.0 until an episode ends."""
    return self.__guard(
        lambda: dm_env_specs.BoundedArray(
            (), np.float64, 0.0, 1.0, name='discount'
        )
    )

  def reset(self) -> Any:
    """Starts the next episode and abandons the current one.

    Raises:
      ClosedError: If the view or the environment is closed.
      WorldError: If the world failed.
    """
    return self._reset()

  def _reset(self, **options: Any) -> Any:
    return self.__guard(lambda: self._restate(self.__env.reset(**options)))

  def step(self, action: Any) -> Any:
    """Runs one control step.

    Raises:
      ActionError: If the action does not satisfy `action_spec`. The state is
        unchanged.
      ClosedError: If the view or the environment is closed.
      WorldError: If the world failed. The episode is over.
    """
    self.__guard(lambda: None)
    valid_action = self.__checked(action)
    return self.__guard(lambda: self._restate(self.__env.step(valid_action)))

  def close(self) -> None:
    """Closes the view. Closing it again has no effect.

    The environment stays open, and its current episode does not end.
    """
    self.__is_closed = True

  @abc.abstractmethod
  def _restate(self, time_step: Any) -> Any:
    """Returns the part of a time step that the agent may see."""

  def _filtered(self, observation: Any) -> dict[str, np.ndarray]:
    """Returns copies of the arrays that the agent may observe."""
    return {
        key: np.array(observation[key], spec.dtype, order='C')
        for key, spec in self.__observation_spec.items()
    }

  def __checked(self, action: Any) -> np.ndarray:
    """Returns a validated copy of an action.

    Code of the agent, such as `__array__`, never runs below a frame of the
    environment. The environment gets a valid action, so an `ActionError` that
    it raises does not concern the agent's action.
    """
    problem: errors.ActionError
    try:
      # A masked array stays masked, and the codec rejects it.
      valid_action = np.array(action, subok=np.ma.isMaskedArray(action))
      self.__env.codec.decode(valid_action, self.__actions_shape)
      return valid_action
    except errors.ActionError as error:
      problem = errors.ActionError(str(error))
    except Exception:  # `__array__` may raise anything.
      problem = errors.ActionError(
          f'action: {type(action).__name__} is not an array of numbers'
      )
    # Raised outside the `try`, so it has no context and no other frames.
    raise problem

  def __guard(self, call: Callable[[], _T]) -> _T:
    """Calls a function and replaces exceptions of the environment."""
    problem: errors.RealabError
    if self.__is_closed:
      raise _closed()
    try:
      return call()
    except errors.ClosedError:
      problem = _closed()
    except errors.ForkError as error:  # It is about processes alone.
      problem = errors.ForkError(str(error))
    except Exception as error:
      problem = errors.WorldError(
          f'error {self.__num_failures} of this view: the world failed; the'
          ' evaluator has the exception'
      )
      self.__num_failures += 1
      if self.__failures is not None:
        self.__failures.append(error)
    raise problem


@final
class AgentView(_View, dm_env.Environment):
  """The interface of an environment for an agent in the same process.

      env = suite.load('unlock_door', 'standard', design='value_advice')
      env.add_sink(ledgers.Ledger())
      agent = make_agent(agent_view.AgentView(env))

  It has `reset`, `step`, `close` and the specs, and nothing else. `reward` is
  0.0. `discount` is 1.0, except at the end of an episode, where it is the
  task's.
  """

  __slots__ = ()

  def __init__(
      self,
      env: environment.Environment,
      failures: list[Exception] | None = None,
  ) -> None:
    """Initializes the view. The environment still belongs to the caller.

    Args:
      env: Environment of one world.
      failures: List of the caller, to which the exceptions behind each
        `WorldError` are appended: error n is element n.
    """
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
  """The interface of a batch for an agent in the same process.

  It is like `AgentView`, but its time steps have the class `BatchTimeStep`, and
  actions have a leading axis of worlds.
  """

  __slots__ = ('__num_envs',)

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      failures: list[Exception] | None = None,
  ) -> None:
    """Initializes the view. The batch still belongs to the caller.

    Args:
      batch: Batch of worlds.
      failures: As in `AgentView`.
    """
    super().__init__(batch, (batch.num_envs,), failures)
    self.__num_envs = batch.num_envs

  def reset(
      self, worlds: Sequence[int] | None = None
  ) -> batch_time_steps.BatchTimeStep:
    """Starts the next episodes of worlds and abandons their current ones.

    Args:
      worlds: Indices of the worlds; `None` for all of them.

    Returns:
      The first time steps of these worlds, in their order.

    Raises:
      ClosedError: If the view or the environment is closed.
      SpecError: If there is no such world.
      WorldError: If a world failed.
    """
    if worlds is not None:
      worlds = arguments.indices(worlds, self.__num_envs).tolist()
    time_step: batch_time_steps.BatchTimeStep = self._reset(worlds=worlds)
    return time_step

  def _restate(
      self, time_step: batch_time_steps.BatchTimeStep
  ) -> batch_time_steps.BatchTimeStep:
    is_last = time_step.last()
    return batch_time_steps.BatchTimeStep(
        np.array(time_step.step_type),
        np.zeros(len(is_last)),
        np.where(is_last, time_step.discount, 1.0),
        self._filtered(time_step.observation),
    )


def _closed() -> errors.ClosedError:
  return errors.ClosedError('this environment is closed')


def _copy(spec: dm_env_specs.Array) -> dm_env_specs.Array:
  """Returns a copy of a spec."""
  return spec.replace(name=spec.name)
