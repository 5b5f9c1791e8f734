"""Refusals of requests, with the fixed texts that agents receive.

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
  """Reasons for refusals: id, code and text of the error.

  Braces in a text stand for numbers that the agent sent itself, or for the
  position of an element in its message.
  """

  UNREADABLE = 'R01', _INVALID, 'the message cannot be read'
  EMPTY = 'R02', _INVALID, 'the request has no payload'
  NOT_FOR_AGENTS = 'R03', _DENIED, 'agents may join, step, reset and leave'
  SETTINGS = 'R04', _DENIED, 'agents cannot set settings'
  WORLD = 'R05', _INVALID, "the world's name is 'world'"
  NOT_JOINED = 'R06', _NOT_NOW, 'join the world first'
  JOINED = 'R07', _NOT_NOW, 'the world was already joined'
  MID_EPISODE = (
      'R08', _NOT_NOW, 'an episode is running; step to its end, or leave the'
      ' world',
  )  # fmt: skip
  OBSERVATION = 'R09', _INVALID, 'observation {} is unknown'
  ACTION = 'R10', _INVALID, 'action {} is unknown'
  NO_ACTION = 'R11', _INVALID, 'action {} is missing'
  TYPE = 'R12', _INVALID, 'action {}: type differs from its spec'
  SHAPE = (
      'R13', _INVALID, 'action {}: shape or number of elements differs from its'
      ' spec',
  )  # fmt: skip
  VALUE = (
      'R14', _INVALID, 'action {}: element {} is not a number within the bounds'
      ' of its spec',
  )  # fmt: skip
  FAILED = (
      'R15', code_pb2.INTERNAL, 'the episode has failed; the next step begins'
      ' another one',
  )  # fmt: skip
  FINISHED = 'R16', _NOT_NOW, 'there are no more episodes'


@final
class RequestRefused(errors.RealabError):
  """Error for a request of the agent that is refused."""

  def __init__(self, reason: Reason, *numbers: int, details: str = '') -> None:
    """Makes the error.

    Args:
      reason: Reason for the refusal.
      *numbers: Numbers for the braces in the text.
      details: Additional text for the evaluator's log.
    """
    self.code: int
    self.id, self.code, text = reason.value
    self.text = f'{self.id}: {text.format(*numbers)}'
    super().__init__(f'{self.text} {details}'.rstrip())

  def response(self) -> dm_env_rpc_pb2.EnvironmentResponse:
    """Returns the message for the agent, without details."""
    response = dm_env_rpc_pb2.EnvironmentResponse()
    response.error.code = self.code
    response.error.message = self.text
    return response
