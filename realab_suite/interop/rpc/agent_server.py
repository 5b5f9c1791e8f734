"""A socket with a world behind it, for one agent at a time.

The world is run by one thread: the one that calls `Server.run`. The threads of
gRPC hand requests over, and wait.
"""

import abc
from collections.abc import Callable, Iterator
from concurrent import futures
import os
import queue
import threading
import time
from typing import Any, NamedTuple, final

from absl import logging
import grpc

from realab_suite import errors
from realab_suite.interop.rpc import sockets

MAX_REQUEST_BYTES = 1 << 20
IDLE_SECONDS = 60.0

_SERVICE, _METHOD = 'dm_env_rpc.v1.Environment', 'Process'
# One for the agent, and one that turns others away.
_NUM_THREADS = 2
# For how long an agent is let to read the last answer.
_LINGER_SECONDS = 5.0
# A signal may have interrupted a thread of gRPC's. Python hears of it when the
# main thread wakes up, which may be the one that waits.
_PULSE_SECONDS = 0.25
_MAX_STREAMS = 16
_HANDSHAKE_MS = 800
_MAX_HEADER_BYTES = 8 << 10
_OPTIONS = (
    ('grpc.max_receive_message_length', MAX_REQUEST_BYTES),
    ('grpc.max_metadata_size', _MAX_HEADER_BYTES),
    ('grpc.max_concurrent_streams', _MAX_STREAMS),
    ('grpc.server_handshake_timeout_ms', _HANDSHAKE_MS),
    # Nobody else may listen at the same address.
    ('grpc.so_reuseport', 0),
    # The identity alone: what is compressed has a size that depends on it, and
    # may be huge when it is unpacked.
    ('grpc.compression_enabled_algorithms_bitset', 1),
    ('grpc.http2.max_pings_without_data', 0),
)
_BUSY = 'R17: another agent is connected'
_OVER = 'R18: the connection has ended'


@final
class _Session:
  """A stream of requests, from when it is let in until it is over."""

  def __init__(self, context: grpc.ServicerContext) -> None:
    self.context = context


@final
class _Opened(NamedTuple):
  session: _Session


@final
class _Asked(NamedTuple):
  session: _Session
  request: bytes
  answer: futures.Future[bytes]


@final
class _Gone(NamedTuple):
  session: _Session


@final
class _Stop(NamedTuple):
  pass


_Event = _Opened | _Asked | _Gone | _Stop


class Service(abc.ABC):
  """What is served. All calls come from the thread that runs the server."""

  @abc.abstractmethod
  def connect(self) -> None:
    """An agent has connected; it is the only one until `disconnect`."""

  @abc.abstractmethod
  def answer(self, request: bytes) -> bytes:
    """Returns the answer to a request of the agent's; never raises."""

  @abc.abstractmethod
  def disconnect(self) -> None:
    """The agent has gone, or has been silent for too long."""

  @abc.abstractmethod
  def settle(self) -> bool:
    """Does what the agent does not wait for, after each of its requests.

    Returns:
      Whether there is more to be had here.
    """


@final
class Server:
  """Serves a world to one agent at a time.

  server = Server(world, 'unix:/folder/socket')
  server.start()
  server.run()
  """

  def __init__(
      self,
      world: Service,
      address: str,
      idle_seconds: float = IDLE_SECONDS,
      owner: tuple[int, int] | None = None,
      clock: Callable[[], float] = time.monotonic,
  ) -> None:
    """Makes the server.

    Args:
      world: What answers.
      address: `unix:/folder/name` or `host:port`; port 0 for any that is free.
      idle_seconds: For how long an agent may be silent.
      owner: The user and the group of the agent; `None` for this user's own.
      clock: Time by which an agent is silent, seconds.
    """
    self._world = world
    self._owner = owner
    self._given_address = address
    self._idle_seconds = idle_seconds
    self._clock = clock
    self._events: queue.SimpleQueue[_Event] = queue.SimpleQueue()
    self._is_taken = threading.Lock()
    # While it is held, nobody is let in or turned away for good.
    self._door = threading.Lock()
    self._is_closed = False
    self._session: _Session | None = None
    self._deadline = 0.0
    self._is_ending = False
    self._pid = os.getpid()
    self._address = address
    self._server: Any = None

  @property
  def address(self) -> str:
    """Where it listens, as a client names it."""
    return self._address

  def start(self) -> None:
    """Begins to listen; requests wait until `run`.

    Raises:
      SpecError: If it cannot listen there.
    """
    self._server = grpc.server(
        futures.ThreadPoolExecutor(_NUM_THREADS, 'realab_rpc'),
        options=_OPTIONS,
        compression=grpc.Compression.NoCompression,
    )
    handler = grpc.stream_stream_rpc_method_handler(self._process)
    self._server.add_generic_rpc_handlers(
        [grpc.method_handlers_generic_handler(_SERVICE, {_METHOD: handler})]
    )
    with sockets.prepared(self._given_address, self._owner) as kind:
      try:
        number = self._server.add_secure_port(
            self._given_address, grpc.local_server_credentials(kind)
        )
      except RuntimeError as error:
        raise errors.SpecError(
            f'address: cannot listen at {self._given_address!r:.120}; is it in'
            ' use?'
        ) from error
    if kind is grpc.LocalConnectionType.LOCAL_TCP:
      host = self._given_address.rpartition(':')[0]
      self._address = f'{host}:{number}'
    self._server.start()

  def run(self) -> None:
    """Answers until there is no more to be had. This thread runs the world.

    Raises:
      ForkError: If the process was forked since the server was made.
    """
    if os.getpid() != self._pid:
      raise errors.ForkError(
          'a server does not survive a fork; make it in the process that runs'
          ' it'
      )
    try:
      while not (self._is_ending and self._session is None):
        try:
          event = self._events.get(
              timeout=min(self._patience(), _PULSE_SECONDS)
          )
        except queue.Empty:
          self._expire()
          continue
        if isinstance(event, _Stop):
          break
        self._handle(event)
      if self._session is not None:
        self._part()
    finally:
      self.close()

  def stop(self) -> None:
    """Makes `run` return; any thread may call."""
    self._events.put(_Stop())

  # In the thread that runs the world.

  def _handle(self, event: _Opened | _Asked | _Gone) -> None:
    if isinstance(event, _Opened):
      self._session = event.session
      self._world.connect()
      self._stay()
      return
    if event.session is not self._session:
      # It was silent for too long, and has been told so.
      if isinstance(event, _Asked):
        event.answer.cancel()
      return
    if isinstance(event, _Gone):
      self._part()
      return
    try:
      answer = self._world.answer(event.request)
    except BaseException:
      # A thread of gRPC's waits for it, and the process for that thread.
      event.answer.cancel()
      raise
    event.answer.set_result(answer)
    self._settle()
    self._stay()

  def _settle(self) -> None:
    if not self._is_ending and not self._world.settle():
      self._is_ending = True
      self._deadline = self._clock() + _LINGER_SECONDS

  def _stay(self) -> None:
    if not self._is_ending:
      self._deadline = self._clock() + self._idle_seconds

  def _patience(self) -> float:
    """Returns for how much longer the agent may be silent, seconds."""
    if self._session is None:
      return _PULSE_SECONDS
    return max(0.0, self._deadline - self._clock())

  def _expire(self) -> None:
    """Frees the world of an agent that has been silent for too long."""
    if self._session is not None and not self._patience():
      if not self._is_ending:
        logging.warning(
            'the agent has been silent for %g s; its connection ends',
            self._idle_seconds,
        )
      self._session.context.cancel()
      self._part()

  def _part(self) -> None:
    self._session = None
    try:
      self._world.disconnect()
      self._settle()
    finally:
      self._is_taken.release()

  def close(self) -> None:
    """Lets nobody in any more, and nobody wait; `run` ends with it."""
    with self._door:
      if self._is_closed:
        return
      self._is_closed = True
    stopped = self._server.stop(grace=None)
    while not self._events.empty():
      event = self._events.get()
      if isinstance(event, _Asked):
        event.answer.cancel()
    stopped.wait()
    sockets.remove(self._given_address)

  # In threads of gRPC.

  def _process(
      self, requests: Iterator[bytes], context: grpc.ServicerContext
  ) -> Iterator[bytes]:
    session = self._admit(context)
    for request in requests:
      answer: futures.Future[bytes] = futures.Future()
      if not self._put(_Asked(session, request, answer)):
        return
      try:
        yield answer.result()
      except futures.CancelledError:
        return

  def _admit(self, context: grpc.ServicerContext) -> _Session:
    """Lets an agent in if there is none.

    Raises:
      Exception: Of gRPC's, which ends the stream, otherwise.
    """
    if not self._is_taken.acquire(blocking=False):
      context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, _BUSY)
    session = _Session(context)
    if not self._put(_Opened(session)):
      context.abort(grpc.StatusCode.UNAVAILABLE, _OVER)
    gone = _Gone(session)
    if not context.add_callback(lambda: self._put(gone)):
      self._put(gone)
      context.abort(grpc.StatusCode.CANCELLED, _OVER)
    return session

  def _put(self, event: _Opened | _Asked | _Gone) -> bool:
    with self._door:
      if not self._is_closed:
        self._events.put(event)
      return not self._is_closed
