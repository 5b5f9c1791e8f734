"""Handler of an agent's requests to a world: join, step, reset and leave.

Connections and threads are in `agent_server`.
"""

from collections.abc import Callable
from typing import final

from absl import logging
import dm_env
from dm_env_rpc.v1 import dm_env_rpc_pb2
from google.protobuf import message

from realab_suite.interop.rpc import refusals
from realab_suite.interop.rpc import tensors

WORLD = 'world'
"""Name of the world in requests; every server has exactly one world."""

_Reason = refusals.Reason
_REFUSED = refusals.RequestRefused


@final
class AgentPort:
  """Answers the requests of one agent.

  Agents may join, step, reset and leave; all other requests are refused. Every
  request gets one answer, even if its bytes are invalid. All calls must come
  from the thread that runs the world.
  """

  def __init__(
      self, env: dm_env.Environment, abandon: Callable[[], None]
  ) -> None:
    """Makes the port.

    Args:
      env: The agent's view of the world.
      abandon: Function that ends the running episode when the agent leaves.
    """
    self._env = env
    self._abandon = abandon
    self._observations = tensors.Observations(env.observation_spec())
    self._actions = tensors.Actions(env.action_spec())
    self._specs = dm_env_rpc_pb2.ActionObservationSpecs(
        actions=self._actions.specs, observations=self._observations.specs
    )
    self._is_joined = False
    self._is_mid_episode = False
    self._is_finished = False

  def answer(self, request: bytes) -> bytes:
    """Returns the serialised answer to a serialised request."""
    try:
      response = self._answer(_parse(request))
    except refusals.RequestRefused as refusal:
      logging.info('refused: %s', refusal)
      response = refusal.response()
    return response.SerializeToString(deterministic=True)

  def disconnect(self) -> None:
    """Resets the port, so that the next agent has to join."""
    self._is_joined = self._is_mid_episode = False

  def finish(self) -> None:
    """Refuses all steps that would begin an episode from now on."""
    self._is_finished = True

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
      self._abandon()
    self.disconnect()
    return dm_env_rpc_pb2.LeaveWorldResponse()

  def _step(
      self, request: dm_env_rpc_pb2.StepRequest
  ) -> dm_env_rpc_pb2.StepResponse:
    if not self._is_joined:
      raise _REFUSED(_Reason.NOT_JOINED)
    uids = self._observations.check(request.requested_observations)
    if self._is_mid_episode:
      action = self._actions.read(request.actions)
    elif self._is_finished:
      raise _REFUSED(_Reason.FINISHED)
    try:
      # A step that begins an episode ignores its action.
      time_step = (
          self._env.step(action) if self._is_mid_episode else self._env.reset()
      )
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
