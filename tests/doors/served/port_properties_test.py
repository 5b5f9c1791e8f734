"""Property tests: each message to the agent's port has one allowed answer."""

from collections.abc import Iterator
import re
from typing import Any

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
import hypothesis
from hypothesis import strategies as st
import pytest

from realab_suite.doors.served import refusals
from realab_suite.doors.served import served_world
from tests import examples
from tests.doors.served import served

_MAX_STEPS = 20
_Reason = refusals.Reason
_FAILED = _Reason.FAILED.value[1]
_TEXTS = [
    # The braces of one text are the message of an `ActionError`.
    re.compile(
        re.escape(text).replace(
            r'\{\}', r'action\b.*' if text == '{}' else r'\d+'
        )
    )
    for _, text in (reason.value for reason in _Reason)
]


# Messages of agents, and one that agents may not send.
_KNOWN = [
    served.JOIN,
    served.RESET,
    served.LEAVE,
    served.STEP,
    served.request(create_world=pb.CreateWorldRequest()),
]


@pytest.fixture(name='env', scope='module')
def _env() -> Iterator[Any]:
  env = served.load(max_steps=_MAX_STEPS)
  yield env
  env.close()


@pytest.fixture(name='port', scope='module')
def _port(env: Any) -> served_world.ServedWorld:
  return served_world.ServedWorld(env, 10**6, lambda result: None)


def _ask(
    port: served_world.ServedWorld, message: bytes
) -> pb.EnvironmentResponse:
  return served.response(port.answer(message))


def _check(answer: pb.EnvironmentResponse) -> None:
  """Checks that an answer is one of those that the protocol allows."""
  kind = answer.WhichOneof('payload')
  assert kind is not None
  if kind == 'error':
    assert not answer.error.details
    assert answer.error.message != _FAILED
    assert any(text.fullmatch(answer.error.message) for text in _TEXTS)


@st.composite
def _mutated(draw: Any) -> bytes:
  """Draws a known message with up to three changes."""
  message = bytearray(draw(st.sampled_from(_KNOWN)))
  for _ in range(draw(st.integers(1, 3))):
    place = draw(st.integers(0, len(message)))
    match draw(st.integers(0, 5)):
      case 0:
        if place < len(message):
          message[place] ^= 1 << draw(st.integers(0, 7))
      case 1:
        del message[place:]
      case 2:
        del message[place : place + draw(st.integers(1, 8))]
      case 3:
        message[place:place] = draw(st.binary(min_size=1, max_size=20))
      case 4:  # The end of another message.
        other = draw(st.sampled_from(_KNOWN))
        message[place:] = other[draw(st.integers(0, len(other))) :]
      case 5:  # A large number.
        message[place : place + 1] = b'\xff' * 9 + b'\x01'
  return bytes(message)


@examples.settings(100)
@hypothesis.given(
    message=_mutated() | st.binary(max_size=40),
    before=st.sampled_from([served.JOIN, served.STEP]),
)
def test_any_message_has_an_allowed_answer(
    port: served_world.ServedWorld, message: bytes, before: bytes
):
  port.answer(before)
  _check(_ask(port, message))
