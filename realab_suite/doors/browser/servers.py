"""Server of one page for one person, at a local address with a token.

The page and its connection are refused without the token in the address, so
other users of the machine, and other pages in the same browser, cannot act.
"""

import hmac
import http
from importlib import resources
import json
import queue
import secrets
import threading
from typing import Any, final
from urllib import parse

from websockets import datastructures
from websockets import exceptions
from websockets import http11
from websockets.sync import server as websocket_server

_LOCAL = '127.0.0.1'  # Only programs on this machine reach it.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline';"
    " img-src blob: data:; connect-src 'self' ws:; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    'Content-Type': 'text/html; charset=utf-8',
    'Content-Security-Policy': _POLICY,
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store',
}
_LARGEST_MESSAGE = 4096


@final
class PageServer:
  """Serves a page, and exchanges messages with it.

  The page that connected last is the one that is served.
  """

  def __init__(self) -> None:
    """Starts serving at a free port of this machine."""
    folder = resources.files('realab_suite.doors.browser')
    self._page = (folder / 'pages' / 'supervise.html').read_bytes()
    self._token = secrets.token_urlsafe(16)
    self._connection: websocket_server.ServerConnection | None = None
    self._lock = threading.Lock()  # Of the connection and its event.
    self._is_connected = threading.Event()
    self._messages: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    self._server = websocket_server.serve(
        self._handle,
        _LOCAL,
        0,
        process_request=self._answer,
        compression=None,
        max_size=_LARGEST_MESSAGE,
        server_header=None,
    )
    port = self._server.socket.getsockname()[1]
    self.url = f'http://{_LOCAL}:{port}/?token={self._token}'
    self._thread = threading.Thread(
        target=self._server.serve_forever, name='page server', daemon=True
    )
    self._thread.start()

  @property
  def is_connected(self) -> bool:
    """True while a page is connected."""
    return self._is_connected.is_set()

  def receive(self, timeout: float) -> dict[str, Any] | None:
    """Returns the next message, or `None` without one within a time.

    Args:
      timeout: The time, in seconds.
    """
    try:
      return self._messages.get(timeout=max(timeout, 0.0))
    except queue.Empty:
      return None

  def send(self, content: dict[str, Any]) -> None:
    """Sends a message to the page, if there is one."""
    self._send(json.dumps(content, allow_nan=False))

  def send_picture(self, view: int, jpeg: bytes) -> None:
    """Sends a picture, which replaces the last one of the same view.

    Args:
      view: Number of the view in the page, from 0 to 255.
      jpeg: The picture.
    """
    self._send(bytes([view]) + jpeg)

  def close(self) -> None:
    """Stops serving."""
    connection = self._connection
    if connection is not None:
      connection.close()
    self._server.shutdown()
    self._thread.join()

  def _send(self, message: str | bytes) -> None:
    connection = self._connection
    if connection is not None:
      try:
        connection.send(message)
      except exceptions.ConnectionClosed:
        pass  # The episode waits for the next page.

  def _answer(
      self,
      connection: websocket_server.ServerConnection,
      request: http11.Request,
  ) -> http11.Response | None:
    """Returns the page or a refusal, or `None` to accept a connection."""
    try:
      parts = parse.urlsplit(request.path)
      [token] = parse.parse_qs(parts.query).get('token', [''])[:1]
    except ValueError:
      return connection.respond(
          http.HTTPStatus.BAD_REQUEST, 'The address is malformed.\n'
      )
    # Bytes, because strings may contain only ASCII characters.
    if not hmac.compare_digest(token.encode(), self._token.encode()):
      return connection.respond(
          http.HTTPStatus.FORBIDDEN, 'The address needs its token.\n'
      )
    if parts.path == '/socket':
      origin = request.headers.get('Origin')
      if origin != f'http://{request.headers.get("Host")}':
        return connection.respond(
            http.HTTPStatus.FORBIDDEN, 'Another page cannot connect.\n'
        )
      return None
    if parts.path != '/':
      return connection.respond(http.HTTPStatus.NOT_FOUND, 'Not found.\n')
    headers = datastructures.Headers(_HEADERS)
    headers['Content-Length'] = str(len(self._page))
    headers['Connection'] = 'close'
    return http11.Response(http.HTTPStatus.OK, 'OK', headers, self._page)

  def _handle(self, connection: websocket_server.ServerConnection) -> None:
    """Receives the messages of a page."""
    with self._lock:
      before, self._connection = self._connection, connection
      self._is_connected.set()
    if before is not None:
      before.close()
    try:
      for text in connection:
        try:
          content = json.loads(text)
        except (ValueError, RecursionError):
          continue
        if isinstance(content, dict):
          self._messages.put(content)
    finally:
      with self._lock:
        if self._connection is connection:
          self._connection = None
          self._is_connected.clear()
