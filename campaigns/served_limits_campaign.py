"""Campaign C25: clients that try to exhaust a served world.

Run from the root of the repository, about half a minute in full:

    python -m campaigns.served_limits_campaign

An agent continues to play while other clients send shapes of many elements,
large messages and very many settings, connect very often, or send a byte per
second. The server is a process of its own. Prints `C25 figure target verdict
seed`. Arguments are the scale and the seed.
"""

from collections.abc import Callable, Iterator
import contextlib
import hashlib
import socket
import threading
import time
from typing import Any, NamedTuple, final

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from google.rpc import code_pb2
import grpc
import numpy as np

from campaigns import figure_lines
from realab_suite.interop.rpc import sockets
from tests import patience
from tests.interop import served

CONNECTIONS = 1_000
QUEUED = 1_000_000
SETTINGS_KEYS = 100_000
_MIB = 2**20


@final
class PeakMemory:
  """Records the peak memory of a process."""

  def __init__(self, pid: int) -> None:
    self._pid = pid
    self._is_over = threading.Event()
    self._thread = threading.Thread(target=self._watch, daemon=True)
    self.before = self.peak = served.rss(pid)

  def _watch(self) -> None:
    while not self._is_over.wait(0.01):
      self.peak = max(self.peak, served.rss(self._pid))

  def __enter__(self) -> 'PeakMemory':
    self._thread.start()
    return self

  def __exit__(self, *unused: Any) -> None:
    self._is_over.set()
    self._thread.join()

  @property
  def growth(self) -> float:
    return self.peak - self.before


def rollout(stream: served.RawStream, steps: int) -> str:
  """Plays; returns a digest of all answers."""
  digest = hashlib.sha256()
  for i in range(steps):
    action = np.sin(np.arange(6) + i)
    step = pb.StepRequest(
        actions={1: tensor_utils.pack_tensor(action)},
        requested_observations=range(1, 10),
    )
    answer = served.response(stream.ask(served.request(step=step)))
    digest.update(answer.SerializeToString(deterministic=True))
  return digest.hexdigest()


def _repeated_rollout(program: served.Program, steps: int) -> str:
  """Returns the digest of the same episodes without an attack."""
  with served.in_process(
      program.output.parent / 'again',
      f'--repeat={program.output / "run.json"}',
      '--episodes=1000',
      task=(),
  ) as again:
    stream = served.connect_eventually(again.address)
    stream.ask(served.JOIN)
    stream.ask(served.STEP)
    digest = rollout(stream, steps)
    stream.close()
  return digest


@final
class Attack(NamedTuple):
  """Result of an attack on a server while its agent plays."""

  growth: float
  seconds: float
  num_refused: int
  is_undisturbed: bool


def attack(
    how: Callable[[served.RawStream, served.Program], tuple[int, float]],
    steps: int,
) -> Attack:
  """Serves a world, attacks it, and plays as its agent."""
  with served.endlessly() as program:
    stream = served.connect_eventually(program.address)
    stream.ask(served.JOIN)
    stream.ask(served.STEP)
    with PeakMemory(program.process.pid) as memory:
      num_refused, seconds = how(stream, program)
      digest = rollout(stream, steps)
    stream.close()
    is_undisturbed = digest == _repeated_rollout(program, steps)
  return Attack(memory.growth, seconds, num_refused, is_undisturbed)


def _refused(ask: Callable[[], Any], code: int) -> tuple[int, float]:
  start = time.monotonic()
  answer = served.response(ask())
  return int(answer.error.code == code), time.monotonic() - start


def bomb(
    stream: served.RawStream, program: served.Program
) -> tuple[int, float]:
  """Sends shapes of many more elements than bytes."""
  del program
  refused, slowest = 0, 0.0
  for shape in ([20_000, 20_000], [-1], [2**31 - 1] * 8, [6, 1, -1]):
    tensor = tensor_utils.pack_tensor(0.5)
    tensor.shape[:] = shape
    settings = pb.ResetRequest(settings={'x': tensor})
    for request, code in (
        (served.request(reset=settings), code_pb2.PERMISSION_DENIED),
        (
            served.request(step=pb.StepRequest(actions={1: tensor})),
            code_pb2.INVALID_ARGUMENT,
        ),
    ):
      number, seconds = _refused(lambda r=request: stream.ask(r), code)
      refused, slowest = refused + number, max(slowest, seconds)
  return refused, slowest


def many_settings(
    stream: served.RawStream, program: served.Program, number: int
) -> tuple[int, float]:
  """Sends very many settings in one message."""
  del program
  tensor = pb.Tensor()
  settings = {f'{i:x}': tensor for i in range(number)}
  message = served.request(reset=pb.ResetRequest(settings=settings))
  return _refused(lambda: stream.ask(message), code_pb2.PERMISSION_DENIED)


def large_messages(
    stream: served.RawStream, program: served.Program
) -> tuple[int, float]:
  """Sends messages of 8 MiB from other clients."""
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
  """Opens silent connections, and then connects clients."""
  del stream
  path = str(sockets.path_of(program.address))
  with contextlib.ExitStack() as stack:
    for _ in range(number):
      silent = stack.enter_context(socket.socket(socket.AF_UNIX))
      silent.settimeout(patience.SECONDS)
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
  """Sends a byte per second, until the server closes the connection."""
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
  """Sends requests without reading any answer.

  Returns:
    Growth of the server, in MiB, and the number of requests that it took.
  """
  handed_over = 0

  def requests() -> Iterator[bytes]:
    nonlocal handed_over
    yield served.JOIN
    while handed_over < number:
      handed_over += 1
      yield served.STEP

  with PeakMemory(program.process.pid) as memory:
    channel = grpc.insecure_channel(program.address)
    call = channel.stream_stream(served.METHOD)(requests())
    patience = time.monotonic() + 30.0
    last = -1
    while handed_over < number and time.monotonic() < patience:
      time.sleep(0.5)
      if handed_over == last:  # The server makes the sender wait.
        break
      last = handed_over
    call.cancel()
    channel.close()
  served.connect_eventually(program.address).close()
  return memory.growth, handed_over


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C25', seed)
  steps = 60
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
    found = attack(how, steps)
    lines.at_least(f'{name}: refused', found.num_refused, number)
    lines.at_most(f'{name}: memory growth, MiB', found.growth, 256)
    lines.at_most(f'{name}: seconds to refuse', found.seconds, 1.0)
    lines.at_most(f'{name}: agent disturbed', int(not found.is_undisturbed), 0)
  with served.endlessly() as program:
    growth, number = queued_requests(program, int(QUEUED * scale))
  lines.at_least('queued requests', number, 100)
  lines.at_most('queued requests: memory growth, MiB', growth, 256)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
