"""Property tests: each message to the agent's port has one allowed answer."""

from collections.abc import Iterator
import re
from typing import Any

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import any_pb2
import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite.interop.rpc import refusals
from realab_suite.interop.rpc import served_world
from tests import examples
from tests.interop import served

_MAX_STEPS = 20
_MAX_UINT64 = 2**64 - 1
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


def _properties() -> Iterator[bytes]:
  value = tensor_utils.pack_tensor(1.0)
  request = properties_pb2.PropertyRequest
  for message in (
      request(read_property=properties_pb2.ReadPropertyRequest(key='score')),
      request(
          write_property=properties_pb2.WritePropertyRequest(
              key='score', value=value
          )
      ),
      request(list_property=properties_pb2.ListPropertyRequest()),
  ):
    packed = any_pb2.Any()
    packed.Pack(message)
    yield served.request(extension=packed)


_SETTINGS = {'seed': tensor_utils.pack_tensor(1)}
# Messages that agents may not send.
_OUTSIDE = [
    served.request(create_world=pb.CreateWorldRequest()),
    served.request(create_world=pb.CreateWorldRequest(settings=_SETTINGS)),
    served.request(destroy_world=pb.DestroyWorldRequest(world_name='world')),
    served.request(reset_world=pb.ResetWorldRequest(world_name='world')),
    served.request(extension=any_pb2.Any(type_url='a/b', value=b'c')),
    *_properties(),
]
_KNOWN = [served.JOIN, served.RESET, served.LEAVE, served.STEP, *_OUTSIDE]


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


@st.composite
def _wrong_steps(draw: Any) -> bytes:
  """Draws a step with parts of the right kinds, most of them wrong."""
  size = draw(st.sampled_from([0, 1, 5, 6, 6, 6, 7, 100]))
  values = np.zeros(size)
  if size:
    values[draw(st.integers(0, size - 1))] = draw(
        st.sampled_from([0.0, 1.0, -1.0, 1.5, np.nan, np.inf, 1e300])
    )
  dtype = draw(st.sampled_from(['f8', 'f8', 'f4', 'i4', 'u1', '?']))
  with np.errstate(invalid='ignore', over='ignore'):
    tensor = tensor_utils.pack_tensor(values.astype(dtype))
  if draw(st.booleans()):
    tensor.shape[:] = draw(st.lists(st.integers(-1, 2**31 - 1), max_size=3))
  uid = draw(st.sampled_from([1, 1, 1, 0, 2, _MAX_UINT64]))
  uids = draw(st.lists(st.integers(0, 12) | st.just(_MAX_UINT64), max_size=4))
  step = pb.StepRequest(actions={uid: tensor}, requested_observations=uids)
  return served.request(step=step)


@examples.settings(400)
@hypothesis.given(
    message=_mutated() | _wrong_steps() | st.binary(max_size=40),
    before=st.sampled_from([served.JOIN, served.STEP]),
)
def test_any_message_has_an_allowed_answer(
    port: served_world.ServedWorld, message: bytes, before: bytes
):
  port.answer(before)
  _check(_ask(port, message))


@examples.settings(200)
@hypothesis.given(uid=st.integers(0, 300) | st.integers(0, _MAX_UINT64))
def test_observations_of_the_spec_are_all_that_there_is(
    port: served_world.ServedWorld, uid: int
):
  port.answer(served.LEAVE)
  joined = _ask(port, served.JOIN).join_world.specs.observations
  step = pb.StepRequest(requested_observations=[uid], actions=served.ACTION)
  answer = _ask(port, served.request(step=step))
  if uid in joined:
    assert list(answer.step.observations) == [uid]
    assert answer.step.observations[uid].shape == joined[uid].shape
  else:
    assert answer.error.message == f'observation {uid} is unknown'


_HOSTILE: dict[str, bytes] = {
    'join': served.JOIN,
    'reset': served.RESET,
    'leave': served.LEAVE,
    'step': served.STEP,
    'bare step': served.request(step=pb.StepRequest()),
    'strange uid': served.request(
        step=pb.StepRequest(
            actions=served.ACTION, requested_observations=[_MAX_UINT64]
        )
    ),
    'outside': _OUTSIDE[0],
    'property': _OUTSIDE[-1],
    'join another world': served.request(
        join_world=pb.JoinWorldRequest(world_name='another')
    ),
    'join with settings': served.request(
        join_world=pb.JoinWorldRequest(world_name='world', settings=_SETTINGS)
    ),
    'reset with settings': served.request(
        reset=pb.ResetRequest(settings=_SETTINGS)
    ),
    'empty': b'',
    'noise': b'\xff' * 40,
}


class _Model:
  """Predicts the refusal of each request in a sequence, or `None`."""

  def __init__(self) -> None:
    self._is_joined = False
    self._steps_left = 0

  def refusal(self, what: str) -> _Reason | None:
    """Returns the reason to refuse the next request, or `None`."""
    fixed = {
        'outside': _Reason.NOT_FOR_AGENTS,
        'property': _Reason.NOT_FOR_AGENTS,
        'empty': _Reason.EMPTY,
        'noise': _Reason.UNREADABLE,
    }
    if what in fixed:
      return fixed[what]
    if what == 'leave':
      self._is_joined = False
      return None
    if what in ('join', 'join another world', 'join with settings'):
      if self._is_joined:
        return _Reason.JOINED
      if what != 'join':
        return _Reason.WORLD if 'another' in what else _Reason.SETTINGS
      self._is_joined, self._steps_left = True, 0
      return None
    if not self._is_joined:
      return _Reason.NOT_JOINED
    if what == 'reset with settings':
      return _Reason.SETTINGS
    if what == 'reset':
      return _Reason.MID_EPISODE if self._steps_left else None
    if what == 'strange uid':
      return _Reason.OBSERVATION
    if not self._steps_left:
      self._steps_left = _MAX_STEPS
      return None
    if what == 'bare step':
      return _Reason.NO_ACTION
    self._steps_left -= 1
    return None


_LIKELY = st.sampled_from(['step', 'step', 'join'])


@examples.settings(60)
@hypothesis.given(
    sequence=st.lists(_LIKELY | st.sampled_from(sorted(_HOSTILE)), max_size=40)
)
def test_a_hostile_sequence_is_answered_as_predicted(
    port: served_world.ServedWorld, sequence: list[str]
):
  port.answer(served.LEAVE)
  model = _Model()
  for what in sequence:
    answer = _ask(port, _HOSTILE[what])
    _check(answer)
    reason = model.refusal(what)
    if reason is None:
      assert answer.WhichOneof('payload') != 'error'
    else:
      code, text = reason.value
      assert answer.error.message.startswith(text.partition('{')[0])
      assert answer.error.code == code


def test_an_answer_that_names_a_file_is_not_allowed():
  answer = pb.EnvironmentResponse()
  answer.error.message = 'KeyError: /home/me'
  with pytest.raises(AssertionError):
    _check(answer)
