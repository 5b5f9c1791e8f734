"""Server of a world over gRPC, for one agent at a time.

The thread that calls `Server.run` runs the world. The threads of gRPC queue
requests for it, and wait for the answers.
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
# One thread serves the agent, the other refuses further connections.
_NUM_THREADS = 2
# Time for an agent to read the last answer.
_LINGER_SECONDS = 5.0
# Longest wait for an event. Python handles signals in the main thread, which
# may be waiting, while the system may deliver them to a thread of gRPC.
_PULSE_SECONDS = 0.25
_MAX_STREAMS = 16
_HANDSHAKE_MS = 800
_MAX_HEADER_BYTES = 8 << 10
_OPTIONS = (
    ('grpc.max_receive_message_length', MAX_REQUEST_BYTES),
    ('grpc.max_metadata_size', _MAX_HEADER_BYTES),
    ('grpc.max_concurrent_streams', _MAX_STREAMS),
    ('grpc.server_handshake_timeout_ms', _HANDSHAKE_MS),
    # No other process may listen at the same address.
    ('grpc.so_reuseport', 0),
    # No compression: compressed sizes depend on the content, and a small
    # message could decompress to a huge one.
    ('grpc.compression_enabled_algorithms_bitset', 1),
    ('grpc.http2.max_pings_without_data', 0),
)
_BUSY = 'R17: another agent is connected'
_OVER = 'R18: the connection has ended'


@final
class _Session:
  """Stream of requests of an admitted agent."""

  def __init__(self, context: grpc.ServicerContext) -> None:
    self.context = context


@final
class _Connected(NamedTuple):
  session: _Session


@final
class _Request(NamedTuple):
  session: _Session
  request: bytes
  answer: futures.Future[bytes]


@final
class _Disconnected(NamedTuple):
  session: _Session


@final
class _Stop(NamedTuple):
  pass


_SessionEvent = _Connected | _Request | _Disconnected
_Event = _SessionEvent | _Stop


class Service(abc.ABC):
  """Service for agents. All calls come from the thread that runs the server."""

  @abc.abstractmethod
  def connect(self) -> None:
    """Handles a new connection; no other agent connects until `disconnect`."""

  @abc.abstractmethod
  def answer(self, request: bytes) -> bytes:
    """Returns the answer to a request of the agent; must not raise."""

  @abc.abstractmethod
  def disconnect(self) -> None:
    """Handles the end of a connection, by the agent or by its timeout."""

  @abc.abstractmethod
  def settle(self) -> bool:
    """Does work for which the agent does not wait, after each request.

    Returns:
      True if the service has more episodes.
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
      world: Service that answers requests.
      address: `unix:/folder/name` or `host:port`; port 0 selects a free port.
      idle_seconds: Time without requests after which a connection ends, in
        seconds.
      owner: Ids of the agent's user and group; `None` for those of this
        process.
      clock: Function that returns the time for `idle_seconds`, in seconds.
    """
    self._world = world
    self._owner = owner
    self._given_address = address
    self._idle_seconds = idle_seconds
    self._clock = clock
    self._events: queue.SimpleQueue[_Event] = queue.SimpleQueue()
    self._agent_slot = threading.Lock()
    # Guards `_is_closed` and additions to the queue.
    self._lock = threading.Lock()
    self._is_closed = False
    self._session: _Session | None = None
    self._deadline = 0.0
    self._is_ending = False
    self._pid = os.getpid()
    self._address = address
    self._server: Any = None

  @property
  def address(self) -> str:
    """Address that clients connect to."""
    return self._address

  def start(self) -> None:
    """Begins to listen; requests wait until `run`.

    Raises:
      SpecError: If the address is invalid or in use.
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
            f'address: cannot listen at {self._given_address!r:.120}; it may be'
            ' in use'
        ) from error
    if kind is grpc.LocalConnectionType.LOCAL_TCP:
      host = self._given_address.rpartition(':')[0]
      self._address = f'{host}:{number}'
    self._server.start()

  def run(self) -> None:
    """Runs the world in this thread until the service or `stop` ends it.

    Raises:
      ForkError: If the process was forked after the server was made.
    """
    if os.getpid() != self._pid:
      raise errors.ForkError(
          'a server does not survive a fork; make it in the process that calls'
          ' run'
      )
    try:
      while not (self._is_ending and self._session is None):
        try:
          event = self._events.get(
              timeout=min(self._time_left(), _PULSE_SECONDS)
          )
        except queue.Empty:
          self._expire()
          continue
        if isinstance(event, _Stop):
          break
        self._handle(event)
      if self._session is not None:
        self._end_session()
    finally:
      self.close()

  def stop(self) -> None:
    """Makes `run` return; any thread may call this method."""
    self._events.put(_Stop())

  # These methods run in the thread that runs the world.

  def _handle(self, event: _SessionEvent) -> None:
    if isinstance(event, _Connected):
      self._session = event.session
      self._world.connect()
      self._extend_deadline()
      return
    if event.session is not self._session:
      # Its connection has already ended by timeout.
      if isinstance(event, _Request):
        event.answer.cancel()
      return
    if isinstance(event, _Disconnected):
      self._end_session()
      return
    try:
      answer = self._world.answer(event.request)
    except BaseException:
      # A thread of gRPC waits for the answer, and the process for that thread.
      event.answer.cancel()
      raise
    event.answer.set_result(answer)
    self._settle()
    self._extend_deadline()

  def _settle(self) -> None:
    if not self._is_ending and not self._world.settle():
      self._is_ending = True
      self._deadline = self._clock() + _LINGER_SECONDS

  def _extend_deadline(self) -> None:
    if not self._is_ending:
      self._deadline = self._clock() + self._idle_seconds

  def _time_left(self) -> float:
    """Returns the time until the connection ends, in seconds."""
    if self._session is None:
      return _PULSE_SECONDS
    return max(0.0, self._deadline - self._clock())

  def _expire(self) -> None:
    """Ends the connection if the agent has been idle for too long."""
    if self._session is not None and not self._time_left():
      if not self._is_ending:
        logging.warning(
            'no request from the agent for %g s; its connection ends',
            self._idle_seconds,
        )
      self._session.context.cancel()
      self._end_session()

  def _end_session(self) -> None:
    self._session = None
    try:
      self._world.disconnect()
      self._settle()
    finally:
      self._agent_slot.release()

  def close(self) -> None:
    """Stops the server and cancels waiting requests; `run` calls this last."""
    with self._lock:
      if self._is_closed:
        return
      self._is_closed = True
    stopped = self._server.stop(grace=None)
    while not self._events.empty():
      event = self._events.get()
      if isinstance(event, _Request):
        event.answer.cancel()
    stopped.wait()
    sockets.remove(self._given_address)

  # These methods run in threads of gRPC.

  def _process(
      self, requests: Iterator[bytes], context: grpc.ServicerContext
  ) -> Iterator[bytes]:
    session = self._admit(context)
    for request in requests:
      answer: futures.Future[bytes] = futures.Future()
      if not self._put(_Request(session, request, answer)):
        return
      try:
        yield answer.result()
      except futures.CancelledError:
        return

  def _admit(self, context: grpc.ServicerContext) -> _Session:
    """Starts a session if no other agent is connected.

    Raises:
      Exception: From gRPC, to end the stream, if another agent is connected or
        the server is closed.
    """
    if not self._agent_slot.acquire(blocking=False):
      context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, _BUSY)
    session = _Session(context)
    if not self._put(_Connected(session)):
      context.abort(grpc.StatusCode.UNAVAILABLE, _OVER)
    event = _Disconnected(session)
    if not context.add_callback(lambda: self._put(event)):
      self._put(event)
      context.abort(grpc.StatusCode.CANCELLED, _OVER)
    return session

  def _put(self, event: _SessionEvent) -> bool:
    with self._lock:
      if not self._is_closed:
        self._events.put(event)
      return not self._is_closed
