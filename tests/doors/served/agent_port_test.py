"""Tests of the requests of agents, message by message, without a socket."""

import re

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import any_pb2
import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite.doors.served import refusals
from realab_suite.doors.served import served_world
from realab_suite.engine import events
from tests import examples
from tests.doors.served import served
from tests.engine import helpers


def _make(design='instantaneous_reward', max_steps=20):
  env = served.load(design, max_steps)
  return env, _serve(env)


def _serve(env):
  return served_world.ServedWorld(env, 10**6, lambda result: None)


def _ask(port, **payload):
  answer = port.answer(served.request(**payload))
  return pb.EnvironmentResponse.FromString(answer)


def _join(port):
  return _ask(port, join_world=pb.JoinWorldRequest(world_name='world'))


def _step(port, action=None, uids=()):
  actions = {} if action is None else {1: action}
  step = pb.StepRequest(actions=actions, requested_observations=uids)
  return _ask(port, step=step)


@pytest.fixture(name='env', scope='module')
def _env():
  env = served.load()
  yield env
  env.close()


@pytest.fixture(name='port')
def _port(env):
  env.abandon()
  return _serve(env)


@pytest.fixture(name='running')
def _running(port):
  _join(port)
  assert _step(port).step.state == pb.RUNNING
  return port


def _properties():
  read = properties_pb2.ReadPropertyRequest(key='score')
  request = any_pb2.Any()
  request.Pack(properties_pb2.PropertyRequest(read_property=read))
  return served.request(extension=request)


_SETTINGS = {'seed': tensor_utils.pack_tensor(1)}
_REFUSED = {
    'bytes that are no message': ('UNREADABLE', b'\xff' * 40),
    'no bytes': ('EMPTY', b''),
    'another world': (
        'WORLD',
        served.request(join_world=pb.JoinWorldRequest(world_name='another')),
    ),
    'settings of a world': (
        'SETTINGS',
        served.request(
            join_world=pb.JoinWorldRequest(
                world_name='world', settings=_SETTINGS
            )
        ),
    ),
    'settings of a reset': (
        'SETTINGS',
        served.JOIN,
        served.request(reset=pb.ResetRequest(settings=_SETTINGS)),
    ),
    'a new world': (
        'NOT_FOR_AGENTS',
        served.request(create_world=pb.CreateWorldRequest()),
    ),
    'a property': ('NOT_FOR_AGENTS', served.JOIN, _properties()),
    'a step before joining': ('NOT_JOINED', served.STEP),
    'a reset before joining': ('NOT_JOINED', served.RESET),
    'a step after leaving': (
        'NOT_JOINED', served.JOIN, served.LEAVE, served.STEP,
    ),
    'joining twice': ('JOINED', served.JOIN, served.JOIN),
    'a reset in mid-episode': (
        'MID_EPISODE', served.JOIN, served.STEP, served.RESET,
    ),
    'an unknown observation': (
        'OBSERVATION',
        served.JOIN,
        served.request(step=pb.StepRequest(requested_observations=[99])),
    ),
}  # fmt: skip


@pytest.mark.parametrize('what', _REFUSED)
def test_a_wrong_request_is_refused_and_the_world_goes_on(what, port):
  name, *requests, wrong = _REFUSED[what]
  code, text = refusals.Reason[name].value
  for request in requests:
    assert not served.response(port.answer(request)).HasField('error')
  error = served.response(port.answer(wrong)).error
  assert (error.code, error.message) == (code, text.format(99))
  _join(port)
  assert _step(port, _no_op()).step.state == pb.RUNNING


# The braces of one text are the message of an `ActionError`.
_TEXTS = [
    re.escape(text).replace(r'\{\}', r'action\b.*' if text == '{}' else r'\d+')
    for _, text in (reason.value for reason in refusals.Reason)
    if text != refusals.Reason.FAILED.value[1]
]
_KNOWN = st.sampled_from([
    served.JOIN, served.RESET, served.LEAVE, served.STEP,
    served.request(create_world=pb.CreateWorldRequest()),
])  # fmt: skip
_LARGE = b'\xff' * 9 + b'\x01'


@st.composite
def _changed(draw):
  """Draws a known message in which up to two parts are replaced by others."""
  message = draw(_KNOWN)
  for _ in range(draw(st.integers(1, 2))):
    start = draw(st.integers(0, len(message)))
    rest = message[draw(st.integers(start, len(message))) :]
    part = draw(st.binary(max_size=20) | st.just(_LARGE) | _KNOWN)
    message = message[:start] + part + rest
  return message


@pytest.fixture(name='any_port', scope='module')
def _any_port():
  env, port = _make()
  yield port
  env.close()


@examples.settings(100)
@hypothesis.given(
    message=_changed() | st.binary(max_size=40),
    before=st.sampled_from([served.JOIN, served.STEP]),
)
def test_any_message_has_an_allowed_answer(any_port, message, before):
  any_port.answer(before)
  answer = served.response(any_port.answer(message))
  if answer.WhichOneof('payload') == 'error':
    assert not answer.error.details
    assert any(re.fullmatch(text, answer.error.message) for text in _TEXTS)
  assert answer.WhichOneof('payload') is not None


def test_leaving_abandons_the_episode():
  env, port = _make()
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  _join(port)
  _step(port)
  _ask(port, leave_world=pb.LeaveWorldRequest())
  assert [end.value for end in sink.ends] == ['abandoned']
  _join(port)
  assert _step(port).step.state == pb.RUNNING
  assert [start.episode for start in sink.starts] == [0, 1]
  env.close()


def _no_op():
  return tensor_utils.pack_tensor(np.zeros(6))


def _doubles(values, shape):
  tensor = pb.Tensor(shape=shape)
  tensor.doubles.array.extend(values)
  return tensor


def _with(index, value):
  values = np.zeros(6)
  values[index] = value
  return tensor_utils.pack_tensor(values)


_OTHER_SPEC = 'action 1: type or shape differs from', ' its spec'
_BAD_ACTIONS = {
    'not a number': (_with(3, np.nan), 'action[3] (', ') is nan'),
    'too large': (_with(5, 1.01), 'action[5] (', ' = 1.01 outside [-1, 1]'),
    'single precision': (
        tensor_utils.pack_tensor(np.zeros(6, np.float32)), *_OTHER_SPEC
    ),
    'too many elements': (_doubles([0.0], [20_000]), *_OTHER_SPEC),
    'another shape': (_doubles([0.0] * 6, [2, 3]), *_OTHER_SPEC),
    'no values': (_doubles([], [6]), *_OTHER_SPEC),
}  # fmt: skip


@pytest.mark.parametrize('what', _BAD_ACTIONS)
def test_a_bad_action_is_refused_and_changes_nothing(what, running, env):
  before = env.save().to_bytes()
  tensor, start, end = _BAD_ACTIONS[what]
  error = _step(running, tensor).error
  assert error.code == refusals.Reason.OTHER_SPEC.value[0]
  assert error.message.startswith(start)
  assert error.message.endswith(end)
  assert env.save().to_bytes() == before
  assert _ask(running, reset=pb.ResetRequest()).HasField('error')  # It runs.
  assert _step(running, _no_op()).step.state == pb.RUNNING


def test_an_unknown_action_is_refused_by_number(running):
  step = pb.StepRequest(actions={1: _no_op(), 9: _no_op()})
  assert _ask(running, step=step).error.message == 'action 9 is unknown'
  assert _step(running).error.message == 'action 1 is missing'


def test_a_served_episode_that_a_signal_ends_is_terminated_and_valid():
  signal = helpers.one_register(
      'stop',
      [{'kind': 'constant', 'value': 5.0, 'writes': ['stop']}],
      role='signal',
      range=[0, 9],
      ends_episode={'above': 2},
  )
  found = []
  env = served.load(signal)
  world = served_world.ServedWorld(env, 1, found.append)
  action = tensor_utils.pack_tensor(helpers.no_op(env))
  step = served.request(step=pb.StepRequest(actions={1: action}))
  replies = [world.answer(r) for r in (served.JOIN, served.STEP, step)]
  last = pb.EnvironmentResponse.FromString(replies[-1])
  assert last.step.state == pb.TERMINATED
  assert not world.settle()
  env.close()
  [result] = found
  assert (result.end, result.is_valid) == (events.End.SIGNAL, True)
