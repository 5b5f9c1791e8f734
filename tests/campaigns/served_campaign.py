"""Campaigns C16, C24, C25 and C26: clients of a served world that mean ill.

Run from the root of the repository, about fifty minutes in full:

    python -m tests.campaigns.served_campaign [scale] [seed] [C24 ...]

C16 sweeps uids and message types, C24 sends mutated messages and hostile
sequences, C25 tries to use things up, and C26 goes away at every point of the
protocol in every way. The server is a process of its own. Prints a line per
figure; the exit status is the number of targets missed.
"""

import collections
from collections.abc import Callable, Iterator, Sequence
import contextlib
import hashlib
import os
import pathlib
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, NamedTuple

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import any_pb2
from google.rpc import code_pb2
import grpc
import numpy as np

from realab_suite.interop.rpc import refusals
from realab_suite.interop.rpc import sockets
from tests.campaigns import lines as campaign_lines
from tests.interop import served

MESSAGES = 50_000
SEQUENCES = 2_000
UIDS = 65_536
RANDOM_UIDS = 5_000
CONNECTIONS = 1_000
QUEUED = 1_000_000
SETTINGS_KEYS = 100_000
REPETITIONS = 50

_FAILED = refusals.Reason.FAILED.value[0]
_TEXTS = [
    re.compile(re.escape(f'{id_}: {text}').replace(r'\{\}', r'\d+'))
    for id_, _, text in (reason.value for reason in refusals.Reason)
]
_MIB = 2**20
_IDLE_SECONDS = 1.0
_MAX_UINT64 = 2**64 - 1


@contextlib.contextmanager
def serving(*flags: str) -> Iterator[served.Program]:
  """Serves a world that never ends, from a process of its own."""
  with (
      tempfile.TemporaryDirectory() as folder,
      served.in_process(
          pathlib.Path(folder) / 'results',
          '--episodes=1000000000',
          '--max_steps=20',
          *flags,
      ) as program,
  ):
    # Nobody reads what it says.
    for stream in (program.process.stdout, program.process.stderr):
      threading.Thread(target=_drain, args=[stream], daemon=True).start()
    yield program


def _drain(stream: Any) -> None:
  with contextlib.suppress(ValueError, OSError):
    for _ in stream:
      pass


def rss(pid: int) -> float:
  """Returns how much memory a process has, in MiB."""
  pages = int(pathlib.Path(f'/proc/{pid}/statm').read_text().split()[1])
  return pages * resource.getpagesize() / _MIB


def counts(pid: int) -> tuple[int, int]:
  """Returns how many threads and descriptors a process has."""
  return (
      len(os.listdir(f'/proc/{pid}/task')),
      len(os.listdir(f'/proc/{pid}/fd')),
  )


class PeakMemory:
  """Watches the memory of a process."""

  def __init__(self, pid: int) -> None:
    self._pid = pid
    self._is_over = threading.Event()
    self._thread = threading.Thread(target=self._watch, daemon=True)
    self.before = self.peak = rss(pid)

  def _watch(self) -> None:
    while not self._is_over.wait(0.01):
      self.peak = max(self.peak, rss(self._pid))

  def __enter__(self) -> 'PeakMemory':
    self._thread.start()
    return self

  def __exit__(self, *unused: Any) -> None:
    self._is_over.set()
    self._thread.join()

  @property
  def growth(self) -> float:
    return self.peak - self.before


# C16: what there is to be asked for.


class Sweep(NamedTuple):
  """What came of asking for everything."""

  num_asked: int
  num_observations: int
  num_strange: int


def sweep(
    stream: served.RawStream, num_uids: int, num_random: int, seed: int
) -> Sweep:
  """Asks for every uid, every kind of message and every setting."""
  generator = np.random.default_rng(seed)
  stream.ask(_JOIN)
  specs = _response(stream.ask(_request(reset=pb.ResetRequest()))).reset.specs
  sizes = {
      uid: (spec.name, tuple(spec.shape), spec.dtype)
      for uid, spec in specs.observations.items()
  }
  uids = [*range(num_uids)]
  uids += generator.integers(0, _MAX_UINT64, num_random, np.uint64).tolist()
  num_strange = num_observations = 0
  for uid in uids:
    step = pb.StepRequest(requested_observations=[uid], actions=_GOOD_ACTION)
    answer = _response(stream.ask(_request(step=step)))
    if uid not in sizes:
      expected = f'R09: observation {uid} is unknown'
      num_strange += answer.error.message != expected
      continue
    num_observations += 1
    found = dict(answer.step.observations)
    num_strange += list(found) != [uid]
    num_strange += tuple(found[uid].shape) != sizes[uid][1]
  others = [*_OUTSIDE, *_settings(generator, max(10, num_random // 50))]
  for request in others:
    answer = _response(stream.ask(request))
    is_plain = answer.WhichOneof('payload') == 'error' and not _is_strange(
        answer
    )
    num_strange += not is_plain
  return Sweep(len(uids) + len(others), num_observations, num_strange)


def _properties() -> Iterator[bytes]:
  property_request = properties_pb2.PropertyRequest
  for message in (
      property_request(
          read_property=properties_pb2.ReadPropertyRequest(key='score')
      ),
      property_request(
          write_property=properties_pb2.WritePropertyRequest(
              key='score', value=tensor_utils.pack_tensor(1.0)
          )
      ),
      property_request(list_property=properties_pb2.ListPropertyRequest()),
  ):
    packed = any_pb2.Any()
    packed.Pack(message)
    yield _request(extension=packed)


def _settings(generator: Any, number: int) -> Iterator[bytes]:
  names = ['seed', 'task', 'design', 'true_reward', 'debug', 'world', '']
  for i in range(number):
    key = names[i] if i < len(names) else generator.bytes(6).hex()
    value = {key: tensor_utils.pack_tensor(1)}
    yield _request(reset=pb.ResetRequest(settings=value))
    yield _request(
        join_world=pb.JoinWorldRequest(world_name='world', settings=value)
    )
    yield _request(create_world=pb.CreateWorldRequest(settings=value))


def run_c16(lines: campaign_lines.Lines, scale: float, seed: int) -> None:
  with serving() as program:
    stream = served.RawStream(program.address)
    found = sweep(
        stream, int(UIDS * scale) + 20, int(RANDOM_UIDS * scale), seed
    )
    stream.close()
  lines.at_least('observations that there are', found.num_observations, 5)
  lines.at_most(f'strange replies of {found.num_asked}', found.num_strange, 0)


# C24: messages.


def _request(**payload: Any) -> bytes:
  return served.request(**payload)


def _response(answer: bytes) -> pb.EnvironmentResponse:
  return pb.EnvironmentResponse.FromString(answer)


_GOOD_ACTION = {1: tensor_utils.pack_tensor(np.zeros(6))}
_JOIN = _request(join_world=pb.JoinWorldRequest(world_name='world'))
_RESET = _request(reset=pb.ResetRequest())
_LEAVE = _request(leave_world=pb.LeaveWorldRequest())
_STEP = _request(
    step=pb.StepRequest(
        actions=_GOOD_ACTION, requested_observations=[1, 2, 3, 8]
    )
)
_OUTSIDE = [
    _request(create_world=pb.CreateWorldRequest()),
    _request(destroy_world=pb.DestroyWorldRequest(world_name='world')),
    _request(reset_world=pb.ResetWorldRequest(world_name='world')),
    _request(extension=any_pb2.Any(type_url='a/b', value=b'c')),
    *_properties(),
]
_SEEDS = [_JOIN, _RESET, _LEAVE, _STEP, *_OUTSIDE]


def mutate(generator: np.random.Generator) -> bytes:
  """Returns a message that began as a good one."""
  message = bytearray(_SEEDS[generator.choice([0, 1, 2, 3, 3, 3, 3, 4, 5, 7])])
  for _ in range(generator.integers(1, 4)):
    place = int(generator.integers(0, len(message) + 1))
    match generator.integers(7):
      case 0:  # A bit.
        if place < len(message):
          message[place] ^= 1 << generator.integers(8)
      case 1:  # An end.
        del message[place:]
      case 2:  # A hole.
        del message[place : place + int(generator.integers(1, 9))]
      case 3:  # Noise.
        message[place:place] = generator.bytes(int(generator.integers(1, 20)))
      case 4:  # An echo.
        message[place:place] = message[: int(generator.integers(0, 60))]
      case 5:  # Somebody else's tail.
        other = _SEEDS[generator.integers(len(_SEEDS))]
        message[place:] = other[int(generator.integers(0, len(other))) :]
      case 6:  # A large number where a small one was.
        message[place : place + 1] = b'\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01'
  return bytes(message)


def compose(generator: np.random.Generator) -> bytes:
  """Returns a step whose parts are of the right kinds, and mostly wrong."""
  size = int(generator.choice([0, 1, 5, 6, 6, 6, 7, 100]))
  specials = [0.0, 1.0, -1.0, 1.5, np.nan, np.inf, -np.inf, 1e300]
  values = np.zeros(size)
  if size and generator.random() < 0.5:
    values[generator.integers(size)] = specials[generator.integers(8)]
  dtype = [np.float64, np.float64, np.float32, np.int32, np.uint8, np.bool_][
      generator.integers(6)
  ]
  with np.errstate(invalid='ignore', over='ignore'):
    tensor = tensor_utils.pack_tensor(values.astype(dtype))
  if generator.random() < 0.3:
    rank = int(generator.integers(0, 4))
    tensor.shape[:] = generator.integers(-1, 2**31 - 1, rank).tolist()
  uid = int(generator.choice([1, 1, 1, 0, 2])) if size else _MAX_UINT64
  uids = generator.integers(1, 11, generator.integers(0, 4)).tolist()
  step = pb.StepRequest(actions={uid: tensor}, requested_observations=uids)
  return _request(step=step)


def _is_strange(answer: pb.EnvironmentResponse) -> bool:
  """Returns whether an answer says anything but what it may."""
  if answer.WhichOneof('payload') != 'error':
    return answer.WhichOneof('payload') is None
  error = answer.error
  if error.details or error.message.startswith(_FAILED):
    return True
  return not any(text.fullmatch(error.message) for text in _TEXTS)


class Fuzz(NamedTuple):
  """What came of a number of messages."""

  answers: collections.Counter[str]
  num_strange: int
  num_misplaced: int
  seconds: np.ndarray


def fuzz(ask: Callable[[bytes], bytes], number: int, seed: int) -> Fuzz:
  """Sends mutated messages, each of which has one answer."""
  generator = np.random.default_rng(seed)
  answers: collections.Counter[str] = collections.Counter()
  num_strange = num_misplaced = 0
  seconds = np.zeros(number)
  for i in range(number):
    if i % 100 == 99:
      # Were an answer missing or one too many, these would be others'.
      ask(_JOIN)
      uid = 10**9 + i
      step = pb.StepRequest(actions=_GOOD_ACTION, requested_observations=[uid])
      said = _response(ask(_request(step=step))).error.message
      num_misplaced += str(uid) not in said
    # Now and then as it should be, or most would be refused for one reason.
    if i % 5 == 0:
      message = (_JOIN, _STEP)[i // 5 % 2]
    else:
      message = (mutate, compose)[i % 2](generator)
    start = time.perf_counter()
    answer = _response(ask(message))
    seconds[i] = time.perf_counter() - start
    kind = answer.WhichOneof('payload') or 'none'
    answers[answer.error.message[:3] if kind == 'error' else kind] += 1
    num_strange += _is_strange(answer)
  return Fuzz(answers, num_strange, num_misplaced, seconds)


_NO_ERROR = 0
_HOSTILE: dict[str, bytes] = {
    'join': _JOIN,
    'reset': _RESET,
    'leave': _LEAVE,
    'step': _STEP,
    'bare step': _request(step=pb.StepRequest()),
    'greedy step': _request(
        step=pb.StepRequest(
            actions=_GOOD_ACTION, requested_observations=[9] * 100_000
        )
    ),
    'strange uid': _request(
        step=pb.StepRequest(
            actions=_GOOD_ACTION, requested_observations=[_MAX_UINT64]
        )
    ),
    'outside': _OUTSIDE[0],
    'property': _OUTSIDE[4],
    'settings': _request(
        reset=pb.ResetRequest(settings={'seed': tensor_utils.pack_tensor(1)})
    ),
    'empty': b'',
    'noise': b'\xff' * 40,
}


class Model:
  """Says which code each request of a sequence should be answered with."""

  def __init__(self, max_steps: int = 20) -> None:
    self._max_steps = max_steps
    self.is_joined = False
    self._steps_left = 0

  def code(self, what: str) -> int:
    """Returns the code, and goes on to what is then."""
    if what in ('outside', 'property'):
      return code_pb2.PERMISSION_DENIED
    if what in ('empty', 'noise'):
      return code_pb2.INVALID_ARGUMENT
    if what == 'leave':
      self.is_joined = False
      return _NO_ERROR
    if what == 'join':
      was_joined, self.is_joined = self.is_joined, True
      if not was_joined:
        self._steps_left = 0
      return code_pb2.FAILED_PRECONDITION if was_joined else _NO_ERROR
    if not self.is_joined:
      return code_pb2.FAILED_PRECONDITION
    if what == 'settings':
      return code_pb2.PERMISSION_DENIED
    if what == 'reset':
      return code_pb2.FAILED_PRECONDITION if self._steps_left else _NO_ERROR
    if what == 'strange uid':
      return code_pb2.INVALID_ARGUMENT
    if not self._steps_left:
      self._steps_left = self._max_steps
      return _NO_ERROR
    if what == 'bare step':
      return code_pb2.INVALID_ARGUMENT
    self._steps_left -= 1
    return _NO_ERROR


def sequences(
    connect: Callable[[], served.RawStream], number: int, seed: int
) -> tuple[collections.Counter[str], int]:
  """Sends legal but hostile sequences; returns answers and wrong ones."""
  generator = np.random.default_rng(seed)
  names = list(_HOSTILE)
  wrong = 0
  seen: collections.Counter[str] = collections.Counter()
  stream = connect()
  model = Model()
  for i in range(number):
    if i % 50 == 49:
      stream.close()
      stream = connect()
      model = Model()
    for _ in range(generator.integers(5, 30)):
      likely = ['step', 'join'] if generator.random() < 0.5 else names
      what = likely[generator.integers(len(likely))]
      answer = _response(stream.ask(_HOSTILE[what]))
      code = model.code(what)
      wrong += answer.error.code != code
      wrong += _is_strange(answer)
      seen[f'{what}: {code}'] += 1
  stream.close()
  return seen, wrong


def connect_eventually(address: str, seconds: float = 5.0) -> served.RawStream:
  """Returns a stream that has been let in."""
  deadline = time.monotonic() + seconds
  while True:
    stream = served.RawStream(address)
    try:
      stream.ask(_LEAVE)
      return stream
    except grpc.RpcError:
      stream.close()
      if time.monotonic() > deadline:
        raise
      time.sleep(0.01)


def run_c24(lines: campaign_lines.Lines, scale: float, seed: int) -> None:
  with serving() as program:
    pid = program.process.pid
    stream = connect_eventually(program.address)
    fuzz(stream.ask, 200, seed + 1)
    before = rss(pid)
    number = int(MESSAGES * scale)
    try:
      found = fuzz(stream.ask, number, seed)
    except grpc.RpcError as error:
      print(f'C24 the stream broke off: {error.code()}')
      lines.at_most('streams that broke off', 1, 0)
      return
    stream.close()
    print('C24 answers:', dict(found.answers.most_common()))
    lines.at_least('kinds of answers', len(found.answers), 12)
    lines.at_most(
        f'answers of {number // 100} that are not in their place',
        found.num_misplaced,
        0,
    )
    lines.at_most('strange answers', found.num_strange, 0)
    lines.at_most('p99, s', float(np.quantile(found.seconds, 0.99)), 1.0)
    number = int(SEQUENCES * scale) + 1
    seen, wrong = sequences(
        lambda: connect_eventually(program.address), number, seed
    )
    lines.at_least('kinds of requests and answers', len(seen), 15)
    lines.at_most(f'wrong answers in {number} sequences', wrong, 0)
    lines.at_most('memory growth, MiB', rss(pid) - before, 50)
    lines.at_most('server deaths', int(program.process.poll() is not None), 0)


# C25: limits.


def rollout(stream: served.RawStream, steps: int) -> str:
  """Plays; returns a digest of all answers."""
  digest = hashlib.sha256()
  for i in range(steps):
    action = np.sin(np.arange(6) + i)
    step = pb.StepRequest(
        actions={1: tensor_utils.pack_tensor(action)},
        requested_observations=range(1, 10),
    )
    answer = _response(stream.ask(_request(step=step)))
    digest.update(answer.SerializeToString(deterministic=True))
  return digest.hexdigest()


def expected_rollout(steps: int) -> str:
  """Returns the digest of the first episodes of a server left in peace."""
  with serving() as program:
    stream = connect_eventually(program.address)
    stream.ask(_JOIN)
    stream.ask(_STEP)
    digest = rollout(stream, steps)
    stream.close()
  return digest


class Attack(NamedTuple):
  """What came of an attack on a server whose agent plays on."""

  growth: float
  seconds: float
  num_refused: int
  is_undisturbed: bool


def attack(
    how: Callable[[served.RawStream, served.Program], tuple[int, float]],
    steps: int,
    expected: str,
) -> Attack:
  """Serves, lets an agent join, attacks, and lets the agent play."""
  with serving() as program:
    stream = connect_eventually(program.address)
    stream.ask(_JOIN)
    stream.ask(_STEP)
    with PeakMemory(program.process.pid) as memory:
      num_refused, seconds = how(stream, program)
      digest = rollout(stream, steps)
    stream.close()
  return Attack(memory.growth, seconds, num_refused, digest == expected)


def _refused(ask: Callable[[], Any], code: int) -> tuple[int, float]:
  start = time.monotonic()
  answer = _response(ask())
  return int(answer.error.code == code), time.monotonic() - start


def bomb(
    stream: served.RawStream, program: served.Program
) -> tuple[int, float]:
  """Shapes of many times more elements than there are bytes."""
  del program
  refused, slowest = 0, 0.0
  for shape in ([20_000, 20_000], [-1], [2**31 - 1] * 8, [6, 1, -1]):
    tensor = tensor_utils.pack_tensor(0.5)
    tensor.shape[:] = shape
    settings = pb.ResetRequest(settings={'x': tensor})
    for request, code in (
        (_request(reset=settings), code_pb2.PERMISSION_DENIED),
        (
            _request(step=pb.StepRequest(actions={1: tensor})),
            code_pb2.INVALID_ARGUMENT,
        ),
    ):
      number, seconds = _refused(lambda r=request: stream.ask(r), code)
      refused, slowest = refused + number, max(slowest, seconds)
  return refused, slowest


def many_settings(
    stream: served.RawStream, program: served.Program, number: int
) -> tuple[int, float]:
  """Very many settings in one message."""
  del program
  tensor = pb.Tensor()
  settings = {f'{i:x}': tensor for i in range(number)}
  message = _request(reset=pb.ResetRequest(settings=settings))
  return _refused(lambda: stream.ask(message), code_pb2.PERMISSION_DENIED)


def large_messages(
    stream: served.RawStream, program: served.Program
) -> tuple[int, float]:
  """Messages of 8 MiB, from others than the agent."""
  del stream
  refused, slowest = 0, 0.0
  for _ in range(5):
    other = served.RawStream(program.address)
    start = time.monotonic()
    try:
      other.ask(b'\x0a' * (8 * _MIB))
    except grpc.RpcError as error:
      refused += error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    slowest = max(slowest, time.monotonic() - start)
    other.close()
  return refused, slowest


def many_connections(
    stream: served.RawStream, program: served.Program, number: int
) -> tuple[int, float]:
  """Connections that say nothing, and clients that come all the same."""
  del stream
  path = str(sockets.path_of(program.address))
  with contextlib.ExitStack() as stack:
    for _ in range(number):
      silent = stack.enter_context(socket.socket(socket.AF_UNIX))
      silent.settimeout(5.0)
      silent.connect(path)
    refused, slowest = 0, 0.0
    for _ in range(10):
      with served.Client(program.address) as client:
        start = time.monotonic()
        try:
          client.join()
        except grpc.RpcError as error:
          refused += error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        slowest = max(slowest, time.monotonic() - start)
  return refused, slowest


def slow_sender(
    stream: served.RawStream, program: served.Program, seconds: float
) -> tuple[int, float]:
  """A client that sends a byte per second; how long it is listened to."""
  del stream
  preface = b'PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n' * 10
  with socket.socket(socket.AF_UNIX) as sender:
    sender.connect(str(sockets.path_of(program.address)))
    sender.settimeout(0.02)
    start, num_sent = time.monotonic(), 0
    while (elapsed := time.monotonic() - start) < seconds:
      try:
        if elapsed >= num_sent:
          sender.send(preface[num_sent : num_sent + 1])
          num_sent += 1
        if not sender.recv(4096):
          return 1, elapsed
      except TimeoutError:
        continue
      except OSError:
        return 1, elapsed
  return 0, seconds


def queued_requests(program: served.Program, number: int) -> tuple[float, int]:
  """Requests that are sent without reading any answer.

  Returns:
    By how much the server grew, MiB, and how many requests were handed over.
  """
  handed_over = 0

  def requests() -> Iterator[bytes]:
    nonlocal handed_over
    yield _JOIN
    while handed_over < number:
      handed_over += 1
      yield _STEP

  with PeakMemory(program.process.pid) as memory:
    channel = grpc.insecure_channel(program.address)
    call = channel.stream_stream(served.STEP)(requests())
    patience = time.monotonic() + 30.0
    last = -1
    while handed_over < number and time.monotonic() < patience:
      time.sleep(0.5)
      if handed_over == last:  # The server has had enough: it makes it wait.
        break
      last = handed_over
    call.cancel()
    channel.close()
  connect_eventually(program.address).close()
  return memory.growth, handed_over


def run_c25(lines: campaign_lines.Lines, scale: float, seed: int) -> None:
  del seed
  steps = 60
  expected = expected_rollout(steps)
  connections = max(20, int(CONNECTIONS * scale))
  keys = max(1_000, int(SETTINGS_KEYS * scale))
  attacks: dict[str, tuple[Any, int]] = {
      'shape bombs': (bomb, 8),
      f'{keys} settings': (
          lambda stream, program: many_settings(stream, program, keys),
          1,
      ),
      '8 MiB messages': (large_messages, 5),
      f'{connections} connections': (
          lambda stream, program: many_connections(
              stream, program, connections
          ),
          10,
      ),
      '1 byte/s': (
          lambda stream, program: slow_sender(stream, program, 20.0),
          1,
      ),
  }
  for name, (how, number) in attacks.items():
    found = attack(how, steps, expected)
    lines.at_least(f'{name}: refused', found.num_refused, number)
    lines.at_most(f'{name}: memory growth, MiB', found.growth, 256)
    lines.at_most(f'{name}: seconds to refuse', found.seconds, 1.0)
    lines.at_most(f'{name}: agent disturbed', int(not found.is_undisturbed), 0)
  with serving() as program:
    growth, number = queued_requests(program, int(QUEUED * scale))
  lines.at_least('queued requests', number, 100)
  lines.at_most('queued requests: memory growth, MiB', growth, 256)


# C26: going away.

_CLIENT = """
import os, signal, sys, threading, time
import grpc, numpy as np
from dm_env_rpc.v1 import dm_env_rpc_pb2
from tests.campaigns import served_campaign
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
print('ready', flush=True)
for line in sys.stdin:
  address, point = line.split()
  if not os.fork():
    client = served_campaign.go_to(address, int(point))
    print(os.getpid(), flush=True)
    time.sleep(600)
"""


class Zygote:
  """A program that becomes a client, as often as one likes, at little cost."""

  def __init__(self) -> None:
    self._process = subprocess.Popen(
        [sys.executable, '-c', _CLIENT],
        cwd=served.ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    self._process.stdout.readline()

  def client(self, address: str, point: int) -> int:
    """Returns the number of a process that has gone to a point."""
    self._process.stdin.write(f'{address} {point}\n')
    self._process.stdin.flush()
    return int(self._process.stdout.readline())

  def close(self) -> None:
    self._process.kill()
    self._process.communicate()


def _ask_without_waiting(stream: served.RawStream) -> None:
  stream.tell(_STEP)


# What a client does before it goes: requests in turn.
POINTS: dict[str, list[bytes | Callable[[served.RawStream], None]]] = {
    'connected': [_LEAVE],
    'joined': [_JOIN],
    'refused': [_OUTSIDE[0]],
    'joined and refused': [_JOIN, _JOIN],
    'first step': [_JOIN, _STEP],
    'second step': [_JOIN, _STEP, _STEP],
    'refused in mid-episode': [_JOIN, _STEP, _HOSTILE['bare step']],
    'last step': [_JOIN, *[_STEP] * 21],
    'reset after the last step': [_JOIN, *[_STEP] * 21, _RESET],
    'second episode': [_JOIN, *[_STEP] * 22],
    'left in mid-episode': [_JOIN, _STEP, _LEAVE],
    'waiting for an answer': [_JOIN, _STEP, _ask_without_waiting],
}
_IS_MID_EPISODE = (
    'first step',
    'second step',
    'refused in mid-episode',
    'second episode',
    'waiting for an answer',
)
WAYS = ('cancel', 'close', 'kill', 'stop')


def go_to(address: str, point: int) -> served.RawStream:
  """Connects, and does what leads to a point."""
  stream = connect_eventually(address)
  for act in list(POINTS.values())[point]:
    if callable(act):
      act(stream)
    else:
      stream.ask(act)
  return stream


class Leaving(NamedTuple):
  """What came of a client that went away."""

  seconds_until_free: float
  is_clean: bool
  seconds_until_refused: float


def go_away(address: str, point: int, way: str, zygote: Zygote) -> Leaving:
  """Goes to a point, then away; returns how it was for the next one."""
  stream = pid = None
  if way in ('kill', 'stop'):
    pid = zygote.client(address, point)
  else:
    stream = go_to(address, point)
  refused_after = _time_of_refusal(address)
  start = time.monotonic()
  if way == 'kill':
    os.kill(pid, signal.SIGKILL)
  elif way == 'stop':
    os.kill(pid, signal.SIGSTOP)
    start += _IDLE_SECONDS
  elif way == 'cancel':
    stream.cancel()
  else:
    stream.channel.close()
  following = connect_eventually(address, 10.0)
  free_after = time.monotonic() - start
  following.ask(_JOIN)
  answer = _response(following.ask(_STEP)).step
  is_clean = answer.state == pb.RUNNING and len(answer.observations) == 4
  following.ask(_LEAVE)
  following.close()
  if way == 'stop':
    os.kill(pid, signal.SIGKILL)
  if stream is not None:
    stream.close()
  return Leaving(free_after, is_clean, refused_after)


def _time_of_refusal(address: str) -> float:
  with served.Client(address) as second:
    grpc.channel_ready_future(second.channel).result(5)
    start = time.monotonic()
    try:
      second.join()
    except grpc.RpcError as error:
      if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED:
        return time.monotonic() - start
  return float('inf')


def go_away_everywhere(
    address: str,
    repetitions: int,
    ways: Sequence[str] = WAYS,
    points: Sequence[int] = range(12),
) -> list[Leaving]:
  """Goes away from every point in every way."""
  zygote = Zygote()
  try:
    return [
        go_away(address, point, way, zygote)
        for _ in range(repetitions)
        for way in ways
        for point in points
    ]
  finally:
    zygote.close()


def run_c26(lines: campaign_lines.Lines, scale: float, seed: int) -> None:
  del seed
  repetitions = max(1, int(REPETITIONS * scale))
  with serving(f'--idle_seconds={_IDLE_SECONDS}') as program:
    connect_eventually(program.address).close()
    before = counts(program.process.pid)
    found = go_away_everywhere(program.address, repetitions)
    time.sleep(1.0)
    after = counts(program.process.pid)
    death = program.process.poll() is not None
    rows = (program.output / 'episodes.jsonl').read_text()
  expected = repetitions * len(WAYS) * len(_IS_MID_EPISODE)
  number = len(found)
  lines.at_most(
      f'slowest of {number} until free, s',
      max(one.seconds_until_free for one in found),
      2.0,
  )
  lines.at_most(
      'next without a clean FIRST', sum(not f.is_clean for f in found), 0
  )
  refusals_ = [one.seconds_until_refused for one in found]
  lines.at_most('slowest refusal of a second client, s', max(refusals_), 0.1)
  lines.at_most(
      'episodes not marked',
      abs(rows.count('"end":"disconnect"') - expected),
      0,
  )
  lines.at_most('more threads', after[0] - before[0], 4)
  lines.at_most('more descriptors', after[1] - before[1], 8)
  lines.at_most('server deaths', int(death), 0)


_RUNS = {'C16': run_c16, 'C24': run_c24, 'C25': run_c25, 'C26': run_c26}


def main(scale: float = 1.0, seed: int = 0, *names: str) -> int:
  """Prints the figures and returns the number of targets missed."""
  return campaign_lines.print_all(_RUNS, scale, seed, names)


if __name__ == '__main__':
  campaign_lines.run(main)
