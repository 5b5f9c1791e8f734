"""A served world sends nothing of the truth, and its memory is closed."""

from collections.abc import Callable
import ctypes
import os
import subprocess
import sys
from typing import Any

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
import numpy as np
import pytest

from realab_suite.doors.served import served_evaluation
from realab_suite.engine import environment
from tests import patience
from tests.doors.served import served
from tests.engine import helpers

_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')


# The wire.


def _pay(value: Any) -> Callable[[environment.Environment], None]:
  """Replaces the true reward, which no meter measures."""

  def alter(env: environment.Environment) -> None:
    def get_reward(physics: Any) -> Any:
      del physics
      if isinstance(value, Exception):
        raise value
      return value

    env.task.get_reward = get_reward

  return alter


_SECRETS = {
    'nothing': _pay(0.0),
    'a number': _pay(173.2317),
    'an error': _pay(ZeroDivisionError('173.2317')),
}


def _wire(secret: str) -> list[bytes]:
  """Returns all answers to an agent that also makes mistakes."""
  actions: Any = None

  def make_env() -> environment.Environment:
    nonlocal actions
    env = served.load('value_advice', max_steps=8)
    _SECRETS[secret](env)
    actions = helpers.random_actions(env, 12)
    return env

  with served.in_thread(make_env) as serving:
    stream = served.RawStream(serving.address)
    answers = [stream.ask(served.request(step=pb.StepRequest()))]
    answers.append(stream.ask(served.JOIN))
    specs = served.response(answers[-1]).join_world.specs
    for action in actions:
      step = pb.StepRequest(
          actions={1: tensor_utils.pack_tensor(action)},
          requested_observations=list(specs.observations),
      )
      answers.append(stream.ask(served.request(step=step)))
      answers.append(stream.ask(b'\xff'))
      bad = {1: tensor_utils.pack_tensor(np.nan)}
      step = pb.StepRequest(actions=bad, requested_observations=[1, 99])
      answers.append(stream.ask(served.request(step=step)))
    stream.close()
  return answers


@pytest.fixture(name='without_secrets', scope='module')
def _without_secrets():
  return _wire('nothing')


@pytest.mark.parametrize('secret', list(_SECRETS)[1:])
def test_no_byte_on_the_wire_depends_on_a_secret(secret, without_secrets):
  assert _wire(secret) == without_secrets
  assert len(without_secrets) == 2 + 3 * 12


def test_the_secrets_reach_the_evaluator():
  env = served.load('none', 5)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  _SECRETS['a number'](env)
  for _ in range(3):
    env.step(served.still(env))
  env.close()
  assert [float(step.true_reward) for step in sink.steps] == [173.2317] * 2


# The memory.


_READ_MEMORY = """
import ctypes, os, sys
is_hidden = sys.argv[1] == 'hide'
if is_hidden:
  from realab_suite.doors.served import served_evaluation
os.setuid(65534)  # Root could read everything.
ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)  # A change of user has hidden it.
if is_hidden:
  served_evaluation.hide_from_debuggers()
child = os.fork()
if not child:
  ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)
  try:
    open(f'/proc/{os.getppid()}/mem', 'rb')
  except PermissionError:
    os._exit(13)
  os._exit(0)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@_is_linux
def test_the_process_of_a_world_is_not_dumpable():
  # It would be open to other processes of the same user.
  prctl = ctypes.CDLL(None).prctl
  get_dumpable, set_dumpable = 3, 4
  assert prctl(get_dumpable, 0, 0, 0, 0) == 1
  try:
    served_evaluation.hide_from_debuggers()
    assert prctl(get_dumpable, 0, 0, 0, 0) == 0
  finally:
    prctl(set_dumpable, 1, 0, 0, 0)


@_is_linux
@pytest.mark.skipif(os.geteuid() != 0, reason='needs root')
@pytest.mark.parametrize(('how', 'status'), [('hide', 13), ('show', 0)])
def test_the_memory_of_a_world_is_closed_to_the_same_user(how, status):
  ran = subprocess.run(
      [sys.executable, '-W', 'ignore', '-c', _READ_MEMORY, how],
      cwd=served.ROOT, timeout=patience.SECONDS, check=False,
  )  # fmt: skip
  assert ran.returncode == status
