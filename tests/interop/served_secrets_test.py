"""A served world keeps its secrets, and planted leaks are found.

Small parts of the campaign `served_secrets`, and the leaks of channels L32 to
L37 (`NOT_HERE` in tests/leaks/mutants.py).
"""

import ctypes
import itertools
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
import numpy as np
import pytest

from campaigns import searches
from campaigns import served_secrets_campaign as secrets
from realab_suite.entities import registers
from realab_suite.experiments import served_evaluation
from realab_suite.interop.rpc import agent_process
from tests import patience
from tests.engine import helpers
from tests.interop import clones
from tests.interop import served

_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')
_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')


def _unchanged(world: Any) -> None:
  """Leaves a world as it is."""


# The wire: C08, L35.


@pytest.mark.parametrize('secret', ['a number', 'an error', 'a listener'])
def test_no_byte_on_the_wire_depends_on_a_secret(secret):
  found = secrets.wire(secrets.SECRETS[secret], steps=12)
  assert found == secrets.wire(_unchanged, steps=12)
  assert len(secrets.sizes_of_steps(found)) == 1
  assert len(found) > 30


def test_the_secrets_reach_the_evaluator():
  env = served.load('none', 5)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  secrets.SECRETS['a number'](env)
  for _ in range(3):
    env.step(served.still(env))
  env.close()
  assert [float(step.true_reward) for step in sink.steps] == [173.2317] * 2


def test_answers_that_are_longer_with_a_reward_are_found():
  def pad(world):
    env, answer = world._env, world.answer
    heard = helpers.RecordingSink()
    env.add_sink(heard)

    def leak(request):
      # A field that clients do not know, and skip.
      reward = heard.steps[-1].true_reward if heard.steps else 0.0
      return answer(request) + b'\x80\x7d\x01' * bool(reward > 0)

    world.answer = leak

  found = secrets.wire(secrets.SECRETS['a number'], alter_world=pad)
  assert found != secrets.wire(_unchanged, alter_world=pad)


# Other channels.


_READ_MEMORY = """
import ctypes, os, sys
is_hidden = sys.argv[1] == 'hide'
if is_hidden:
  from realab_suite.experiments import served_evaluation
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
  # L32: it would be open to other processes of the same user.
  prctl = ctypes.CDLL(None).prctl
  get_dumpable, set_dumpable = 3, 4
  assert prctl(get_dumpable, 0, 0, 0, 0) == 1
  try:
    served_evaluation.hide_from_debuggers()
    assert prctl(get_dumpable, 0, 0, 0, 0) == 0
  finally:
    prctl(set_dumpable, 1, 0, 0, 0)


@_is_linux
@_is_root
@pytest.mark.parametrize(('how', 'status'), [('hide', 13), ('show', 0)])
def test_the_memory_of_a_world_is_closed_to_the_same_user(how, status):
  ran = subprocess.run(
      [sys.executable, '-W', 'ignore', '-c', _READ_MEMORY, how],
      cwd=served.ROOT, timeout=patience.SECONDS, check=False,
  )  # fmt: skip
  assert ran.returncode == status


def test_an_agent_inherits_no_variable_of_its_evaluator():
  # L33.
  secret = {'REALAB_RESULTS': '/results/of/the/evaluator', 'PATH': '/bin'}
  passed = agent_process.environment_of('/home/agent', 'unix:/s', secret)
  assert secrets.exposed({'variables': secret}, ['/results'])
  assert not secrets.exposed({'variables': passed}, ['/results'])


def test_an_answer_to_a_hidden_uid_is_found():
  # L34: `port_properties_test.py` sweeps the uids of the real port.
  def answer_any_uid(world):
    answer = world.answer

    def leak(request):
      reply = pb.EnvironmentResponse.FromString(answer(request))
      if reply.error.message.startswith('R09'):
        reply = pb.EnvironmentResponse(step=pb.StepResponse(state=pb.RUNNING))
        hidden = tensor_utils.pack_tensor(173.2317)
        reply.step.observations[77].CopyFrom(hidden)
      return reply.SerializeToString()

    world.answer = leak

  step = pb.StepRequest(actions=served.ACTION, requested_observations=[77])
  found = []
  for alter in (answer_any_uid, _unchanged):
    with served.in_thread(alter=alter) as serving:
      stream = served.connect_eventually(serving.address)
      stream.ask(served.JOIN)
      answer = served.response(stream.ask(served.request(step=step)))
      found.append(77 in answer.step.observations)
      stream.close()
  assert found == [True, False]


class _FakeClock:
  """A clock that advances by sleeping, and at random with each reading."""

  def __init__(self) -> None:
    self._now = 0.0
    self._rng = np.random.default_rng(0)

  def __call__(self) -> float:
    self._now += self._rng.exponential(0.001)
    return self._now

  def sleep(self, seconds: float) -> None:
    """Advances the clock."""
    self._now += seconds


@pytest.mark.parametrize('is_slower', [True, False])
def test_a_step_that_takes_longer_with_a_reward_is_found(is_slower):
  # L36.
  clock = _FakeClock()

  def linger() -> float:
    clock.sleep(0.002 * is_slower)
    return 1.0

  effect, p = secrets.timing(linger, lambda: 0.0, 100, 0, clock)
  assert (effect > 0.01 and p < 0.01) == is_slower


def _writes_per_step(alter: Any) -> set[int]:
  env = served.load(max_steps=10)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  alter(env)
  for action in helpers.random_actions(env, 10):
    env.step(action)
  env.close()
  return {
      sum(isinstance(record, registers.Write) for record in step.records)
      for step in sink.steps
  }


def test_every_step_has_the_same_number_of_writes():
  # L37.
  def skip(env):
    update, steps = env.mechanism.update_providers, itertools.count()

    def update_providers(*args, **kwargs):
      records, *rest = update(*args, **kwargs)
      if next(steps) % 2:
        records = [r for r in records if not isinstance(r, registers.Write)]
      return (records, *rest)

    env.mechanism.update_providers = update_providers

  assert len(_writes_per_step(_unchanged)) == 1
  assert len(_writes_per_step(skip)) > 1


def test_an_agent_is_given_nothing_of_its_evaluator():
  # C19.
  found = secrets.expose()
  assert not secrets.exposed(found.given, found.secrets)
  assert not found.wide_modes
  assert len(found.given['descriptors']) >= 3


# Everything within reach: C10.


def test_a_canary_is_nowhere_except_at_the_evaluator():
  found = secrets.search(173.23170943)
  assert found.num_bytes > 2**20
  assert found.num_files >= 10 or os.geteuid() != 0
  assert [found.in_wire, found.in_agent, found.in_reach] == [[]] * 3
  assert 'row' in found.in_evaluator
  assert 'f8 little-endian' in found.in_evaluator
  assert 'salt: bytes' in found.in_evaluator


@_is_root
def test_files_that_are_open_to_other_users_are_found():
  with tempfile.TemporaryDirectory() as folder:
    os.chmod(folder, 0o755)
    for name, mode in (('open', 0o644), ('closed', 0o600)):
      path = pathlib.Path(folder, name)
      path.write_text(name)
      path.chmod(mode)
    found = searches.read_as_another_user([pathlib.Path(folder)])
  assert found == (1, b'open')


def test_a_canary_and_a_salt_are_found_in_every_form():
  for name, pattern in searches.patterns(173.2317).items():
    assert name in searches.hits(b'\x00' * 8 + pattern, 173.2317)
  assert not searches.hits(bytes(100), 173.2317)
  salt = bytes(range(16))
  for name, form in clones.forms_of(salt).items():
    data = b'\x01' * 5 + form + b'x'
    assert f'salt: {name}' in searches.salt_hits(data, salt)
  assert not searches.salt_hits(bytes(100), salt)
