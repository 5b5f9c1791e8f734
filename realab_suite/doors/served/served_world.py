"""Served world: answers the requests of an agent, and reports its episodes.

Connections are in `agent_server`.
"""

from collections.abc import Callable
from typing import final

from absl import logging
import dm_env
from dm_env_rpc.v1 import dm_env_rpc_pb2
from google.protobuf import message

from realab_suite import errors
from realab_suite.doors.served import refusals
from realab_suite.doors.served import tensors
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import monitors
from realab_suite.evaluation import results

WORLD = 'world'
"""Name of the world in requests; every server has exactly one world."""

_Reason = refusals.Reason
_REFUSED = refusals.RequestRefused


@final
class ServedWorld:
  """World that answers an agent's requests and reports episode results.

  Agents may join, step, reset and leave; all other requests are refused. Every
  request gets one answer, even if its bytes are invalid. All calls come from
  the thread that runs the server. Requests reach a view of the world alone.
  """

  def __init__(
      self,
      env: environment.Environment,
      num_episodes: int,
      on_episode: Callable[[results.EpisodeResult], bool],
  ) -> None:
    """Makes a served world; its first episode begins with the first step.

    Args:
      env: The environment. The caller closes it.
      num_episodes: Number of episodes to serve, without those that the agent
        gives up and that are not hacked.
      on_episode: Function that is called with the result of each episode, and
        returns True if an episode that was given up is hacked.
    """
    self._env = env
    self._num_left = self._num_episodes = num_episodes
    self._num_given_up = 0
    self._on_episode = on_episode
    self._failures: list[Exception] = []
    self._monitor = monitors.Monitor(env)
    env.add_sink(self._monitor)
    self._view = agent_view.AgentView(env, self._failures)
    self._observations = tensors.Observations(self._view.observation_spec())
    self._actions = tensors.Actions(self._view.action_spec())
    self._specs = dm_env_rpc_pb2.ActionObservationSpecs(
        actions=self._actions.specs, observations=self._observations.specs
    )
    self._is_joined = False
    self._is_mid_episode = False

  def answer(self, request: bytes) -> bytes:
    """Returns the serialised answer to a serialised request."""
    try:
      response = self._answer(_parse(request))
    except refusals.RequestRefused as refusal:
      logging.info('refused: %s', refusal)
      response = refusal.response()
    return response.SerializeToString(deterministic=True)

  def disconnect(self) -> None:
    """Handles the end of a connection, by the agent or by its timeout."""
    self._is_joined = self._is_mid_episode = False
    self._env.abandon(events.End.DISCONNECT)

  def settle(self) -> bool:
    """Reports ended episodes; returns True if there are more to serve.

    Raises:
      ResultsError: If the agent gave up too many episodes.
    """
    for failure in self._failures:
      logging.error('the episode failed', exc_info=failure)
    self._failures.clear()
    for result in self._monitor.take():
      is_hacked = self._on_episode(result)
      if result.is_given_up and not is_hacked:
        self._num_given_up += 1
      else:
        self._num_left -= 1
    evaluate.check_given_up(
        self._num_given_up,
        self._num_episodes - self._num_left,
        self._num_episodes,
    )
    return self._num_left > 0

  def _answer(
      self, request: dm_env_rpc_pb2.EnvironmentRequest
  ) -> dm_env_rpc_pb2.EnvironmentResponse:
    kind = request.WhichOneof('payload')
    match kind:
      case 'step':
        return dm_env_rpc_pb2.EnvironmentResponse(step=self._step(request.step))
      case 'join_world':
        return dm_env_rpc_pb2.EnvironmentResponse(
            join_world=self._join(request.join_world)
        )
      case 'reset':
        return dm_env_rpc_pb2.EnvironmentResponse(
            reset=self._reset(request.reset)
        )
      case 'leave_world':
        return dm_env_rpc_pb2.EnvironmentResponse(leave_world=self._leave())
      case None:
        raise _REFUSED(_Reason.EMPTY)
    raise _REFUSED(_Reason.NOT_FOR_AGENTS, details=f'({kind})')

  def _join(
      self, request: dm_env_rpc_pb2.JoinWorldRequest
  ) -> dm_env_rpc_pb2.JoinWorldResponse:
    if self._is_joined:
      raise _REFUSED(_Reason.JOINED)
    if request.world_name != WORLD:
      raise _REFUSED(_Reason.WORLD)
    if request.settings:
      raise _REFUSED(_Reason.SETTINGS)
    self._is_joined = True
    return dm_env_rpc_pb2.JoinWorldResponse(specs=self._specs)

  def _reset(
      self, request: dm_env_rpc_pb2.ResetRequest
  ) -> dm_env_rpc_pb2.ResetResponse:
    """Accepts a reset between episodes; the next step begins one anyway."""
    if not self._is_joined:
      raise _REFUSED(_Reason.NOT_JOINED)
    if request.settings:
      raise _REFUSED(_Reason.SETTINGS)
    if self._is_mid_episode:
      raise _REFUSED(_Reason.MID_EPISODE)
    return dm_env_rpc_pb2.ResetResponse(specs=self._specs)

  def _leave(self) -> dm_env_rpc_pb2.LeaveWorldResponse:
    if self._is_mid_episode:
      self._env.abandon()
    self._is_joined = self._is_mid_episode = False
    return dm_env_rpc_pb2.LeaveWorldResponse()

  def _step(
      self, request: dm_env_rpc_pb2.StepRequest
  ) -> dm_env_rpc_pb2.StepResponse:
    if not self._is_joined:
      raise _REFUSED(_Reason.NOT_JOINED)
    uids = self._observations.check(request.requested_observations)
    if self._is_mid_episode:
      action = self._actions.read(request.actions)
    elif self._num_left <= 0:
      raise _REFUSED(_Reason.FINISHED)
    try:
      # A step that begins an episode ignores its action.
      time_step = (
          self._view.step(action)
          if self._is_mid_episode
          else self._view.reset()
      )
    except errors.ActionError as error:
      raise _REFUSED(_Reason.VALUE, error) from error
    except Exception as error:
      self._is_mid_episode = False
      raise _REFUSED(_Reason.FAILED) from error
    self._is_mid_episode = not time_step.last()
    return dm_env_rpc_pb2.StepResponse(
        state=_state(time_step),
        observations=self._observations.pack(time_step.observation, uids),
    )


def _parse(request: bytes) -> dm_env_rpc_pb2.EnvironmentRequest:
  try:
    return dm_env_rpc_pb2.EnvironmentRequest.FromString(request)
  except message.DecodeError as error:
    raise _REFUSED(_Reason.UNREADABLE) from error


def _state(time_step: dm_env.TimeStep) -> int:
  """Returns the state that clients convert to the time step's discount."""
  if not time_step.last():
    return dm_env_rpc_pb2.EnvironmentStateType.RUNNING
  if time_step.discount:
    return dm_env_rpc_pb2.EnvironmentStateType.INTERRUPTED
  return dm_env_rpc_pb2.EnvironmentStateType.TERMINATED
