"""Refusals of requests, with the texts that agents receive.

Details of a refusal appear only in the evaluator's log.
"""

import enum
from typing import final

from dm_env_rpc.v1 import dm_env_rpc_pb2
from google.rpc import code_pb2

from realab_suite import errors

_INVALID = code_pb2.INVALID_ARGUMENT
_DENIED = code_pb2.PERMISSION_DENIED
_NOT_NOW = code_pb2.FAILED_PRECONDITION


@final
class Reason(enum.Enum):
  """Reasons for refusals: code and text of the error.

  Braces in a text stand for what the agent sent itself, or for the message of
  an `ActionError` about it.
  """

  UNREADABLE = _INVALID, 'the message cannot be read'
  EMPTY = _INVALID, 'the request has no payload'
  NOT_FOR_AGENTS = _DENIED, 'agents may join, step, reset and leave'
  SETTINGS = _DENIED, 'agents cannot set settings'
  WORLD = _INVALID, "the world's name is 'world'"
  NOT_JOINED = _NOT_NOW, 'join the world first'
  JOINED = _NOT_NOW, 'the world was already joined'
  MID_EPISODE = (
      _NOT_NOW,
      'an episode is running; step to its end, or leave the world',
  )
  OBSERVATION = _INVALID, 'observation {} is unknown'
  ACTION = _INVALID, 'action {} is unknown'
  NO_ACTION = _INVALID, 'action {} is missing'
  OTHER_SPEC = _INVALID, 'action {}: type or shape differs from its spec'
  VALUE = _INVALID, '{}'
  FAILED = (
      code_pb2.INTERNAL,
      'the episode has failed; the next step begins another one',
  )
  FINISHED = _NOT_NOW, 'there are no more episodes'


@final
class RequestRefused(errors.RealabError):
  """Error for a request of the agent that is refused."""

  def __init__(
      self, reason: Reason, *values: object, details: str = ''
  ) -> None:
    """Makes the error.

    Args:
      reason: Reason for the refusal.
      *values: Values for the braces in the text.
      details: Additional text for the evaluator's log.
    """
    self.code: int
    self.code, text = reason.value
    self.text = text.format(*values)
    super().__init__(f'{self.text} {details}'.rstrip())

  def response(self) -> dm_env_rpc_pb2.EnvironmentResponse:
    """Returns the message for the agent, without details."""
    response = dm_env_rpc_pb2.EnvironmentResponse()
    response.error.code = self.code
    response.error.message = self.text
    return response
