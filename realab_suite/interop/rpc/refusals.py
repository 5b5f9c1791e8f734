"""What an agent is told when a request is refused: fixed texts, nothing else.

What went wrong in detail is for the evaluator's log.
"""

import enum
from typing import final

from dm_env_rpc.v1 import dm_env_rpc_pb2
from google.rpc import code_pb2

from realab_suite import errors


@final
class Reason(enum.Enum):
  """Why a request is refused: the error's id, its code and its text.

  A number in braces is one that the agent itself has sent, or the place of one.
  """

  UNREADABLE = (
      'R01', code_pb2.INVALID_ARGUMENT, 'the message cannot be read'
  )  # fmt: skip
  EMPTY = 'R02', code_pb2.INVALID_ARGUMENT, 'the message asks for nothing'
  NOT_FOR_AGENTS = (
      'R03',
      code_pb2.PERMISSION_DENIED,
      'agents may join, step, reset and leave',
  )
  SETTINGS = 'R04', code_pb2.PERMISSION_DENIED, 'agents choose no settings'
  WORLD = 'R05', code_pb2.INVALID_ARGUMENT, "the world's name is 'world'"
  NOT_JOINED = 'R06', code_pb2.FAILED_PRECONDITION, 'join the world first'
  JOINED = 'R07', code_pb2.FAILED_PRECONDITION, 'the world is joined already'
  MID_EPISODE = (
      'R08',
      code_pb2.FAILED_PRECONDITION,
      'an episode is under way; it ends by steps, or by leaving the world',
  )
  OBSERVATION = (
      'R09', code_pb2.INVALID_ARGUMENT, 'observation {} is unknown'
  )  # fmt: skip
  ACTION = 'R10', code_pb2.INVALID_ARGUMENT, 'action {} is unknown'
  NO_ACTION = 'R11', code_pb2.INVALID_ARGUMENT, 'action {} is missing'
  TYPE = (
      'R12', code_pb2.INVALID_ARGUMENT, 'action {}: not of the type of its spec'
  )  # fmt: skip
  SHAPE = (
      'R13',
      code_pb2.INVALID_ARGUMENT,
      'action {}: shape or number of elements differ from its spec',
  )
  VALUE = (
      'R14',
      code_pb2.INVALID_ARGUMENT,
      'action {}: element {} is no number that its spec allows',
  )
  FAILED = (
      'R15',
      code_pb2.INTERNAL,
      'the episode has failed; the next step begins another one',
  )
  FINISHED = (
      'R16', code_pb2.FAILED_PRECONDITION, 'there are no more episodes'
  )  # fmt: skip


@final
class RequestRefused(errors.RealabError):
  """A request of the agent's was refused; the world has not moved."""

  def __init__(self, reason: Reason, *numbers: int, details: str = '') -> None:
    """Makes the error.

    Args:
      reason: Why.
      *numbers: What the text has in braces.
      details: What the evaluator's log says besides.
    """
    self.code: int
    self.id, self.code, text = reason.value
    self.text = f'{self.id}: {text.format(*numbers)}'
    super().__init__(f'{self.text} {details}'.rstrip())

  def response(self) -> dm_env_rpc_pb2.EnvironmentResponse:
    """Returns what the agent is told."""
    response = dm_env_rpc_pb2.EnvironmentResponse()
    response.error.code = self.code
    response.error.message = self.text
    return response
