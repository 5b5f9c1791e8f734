"""Server of a world over gRPC, for one agent at a time.

The thread that calls `Server.run` runs gRPC's event loop and, in its
callbacks, the world. No other thread accesses the world.
"""

import asyncio
import contextlib
import os
import signal
from typing import Any, final

from absl import logging
import grpc
from grpc import aio

from realab_suite import errors
from realab_suite.doors.served import served_world
from realab_suite.doors.served import sockets

IDLE_SECONDS = 60.0

_SERVICE, _METHOD = 'dm_env_rpc.v1.Environment', 'Process'
# Time for an agent to read the last answer.
_LINGER_SECONDS = 5.0
# Time for the tasks of gRPC to end; they need a few milliseconds.
_END_SECONDS = 2.0
# No other process may listen at the same address.
_OPTIONS = (('grpc.so_reuseport', 0),)
_BUSY = 'another agent is connected'
_OVER = 'the connection has ended'


@final
class Server:
  """Serves a world to one agent at a time.

  server = Server(world, 'unix:/folder/socket')
  server.start()
  server.run()
  """

  def __init__(
      self,
      world: served_world.ServedWorld,
      address: str,
      idle_seconds: float = IDLE_SECONDS,
  ) -> None:
    """Makes the server.

    Args:
      world: World that answers requests.
      address: `unix:/folder/name` or `host:port`; port 0 selects a free port.
      idle_seconds: Time without requests after which a connection ends, in
        seconds.
    """
    self._world = world
    self._given_address = address
    self._idle_seconds = idle_seconds
    self._is_busy = False
    self._has_more = True
    self._pid = os.getpid()
    self._address = address
    self._server: Any = None
    self._loop: asyncio.AbstractEventLoop
    # Is done when `run` has to return.
    self._end: asyncio.Future[None]

  @property
  def address(self) -> str:
    """Address that clients connect to."""
    return self._address

  def start(self) -> None:
    """Begins to listen; requests wait until `run`.

    Raises:
      SpecError: If the address is invalid or in use.
    """
    self._loop = asyncio.new_event_loop()
    self._end = self._loop.create_future()
    try:
      self._loop.run_until_complete(self._listen())
    except BaseException:
      self._loop.close()
      raise

  def stop_on(self, number: signal.Signals) -> None:
    """Makes a signal end `run` between two requests; in the main thread only.

    An exception in the middle of a request would write tracebacks.
    """
    self._loop.add_signal_handler(number, self.stop)

  def run(self) -> None:
    """Runs the world in this thread until its episodes or `stop` end it.

    Raises:
      ForkError: If the process was forked after the server was made.
    """
    if os.getpid() != self._pid:
      raise errors.ForkError(
          'a server does not survive a fork; make it in the process that calls'
          ' run'
      )
    try:
      self._loop.run_until_complete(self._end)
    finally:
      self.close()

  def stop(self) -> None:
    """Makes `run` return; any thread may call this after `start`."""
    with contextlib.suppress(RuntimeError):  # The loop is closed.
      self._loop.call_soon_threadsafe(self._finish)

  def close(self) -> None:
    """Stops the server; `run` calls this last."""
    if not self._loop.is_closed():
      self._loop.run_until_complete(self._stop())
      self._loop.close()
      sockets.remove(self._given_address)

  async def _listen(self) -> None:
    server = aio.server(options=_OPTIONS)
    handler = grpc.stream_stream_rpc_method_handler(self._process)
    server.add_generic_rpc_handlers(
        [grpc.method_handlers_generic_handler(_SERVICE, {_METHOD: handler})]
    )
    kind = sockets.prepare(self._given_address)
    try:
      number = server.add_secure_port(
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
    await server.start()
    self._server = server

  async def _stop(self) -> None:
    """Stops gRPC's server, and ends its tasks.

    Tasks that are pending when a loop closes write tracebacks.
    """
    await self._server.stop(grace=None)
    pending = asyncio.all_tasks() - {asyncio.current_task()}
    if pending:
      _, pending = await asyncio.wait(pending, timeout=_END_SECONDS)
    for task in pending:
      task.cancel()
    if pending:
      await asyncio.wait(pending, timeout=_END_SECONDS)

  async def _process(self, unused_requests: Any, context: Any) -> None:
    """Serves a connection from its first request to its end."""
    if self._is_busy:
      await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, _BUSY)
    self._is_busy = True
    try:
      try:
        await self._answer_all(context)
      finally:  # Also if the client has cancelled the call.
        self._is_busy = False
        self._world.disconnect()
        self._settle()
        if not self._has_more:
          self._finish()
    except TimeoutError:
      if self._has_more:
        logging.warning(
            'no request from the agent for %g s; its connection ends',
            self._idle_seconds,
        )
      # It fails if an answer is still on its way to an agent that reads none.
      with contextlib.suppress(aio.InternalError):
        await context.abort(grpc.StatusCode.CANCELLED, _OVER)
    except aio.BaseError as error:
      logging.info('the connection is broken: %s', error)
    except Exception as error:  # `run` raises it.
      self._finish(error)

  async def _answer_all(self, context: Any) -> None:
    """Answers requests until there are no more.

    Raises:
      TimeoutError: If the agent is idle, or does not read an answer.
    """
    deadline = self._loop.time() + self._idle_seconds
    while True:
      async with asyncio.timeout_at(deadline):
        request = await context.read()
      if request is aio.EOF:
        return
      answer = self._world.answer(request)
      if self._has_more:
        deadline = self._loop.time() + self._idle_seconds
      async with asyncio.timeout_at(deadline):
        await context.write(answer)
      if self._has_more:
        self._settle()  # The agent does not wait for this.
        if not self._has_more:
          deadline = self._loop.time() + _LINGER_SECONDS

  def _settle(self) -> None:
    self._has_more = self._world.settle()

  def _finish(self, error: Exception | None = None) -> None:
    """Makes `run` return, or raise an error."""
    if self._end.done():
      return
    if error is None:
      self._end.set_result(None)
    else:
      self._end.set_exception(error)
