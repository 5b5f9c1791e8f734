"""Tests of the server of a page for one person."""

import contextlib
import socket
from urllib import error
from urllib import parse
from urllib import request

import pytest

pytest.importorskip('websockets')

from websockets import exceptions
from websockets.sync import client

from realab_suite.doors.browser import servers
from tests import patience

_UPGRADE = (
    b'Host: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
    b'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n'
    b'Sec-WebSocket-Version: 13\r\n\r\n'
)


@pytest.fixture(name='server')
def fixture_server():
  with contextlib.closing(servers.PageServer()) as server:
    yield server


def _connect(server, origin=None, path='/socket'):
  base, token = server.url.split('/?')
  return client.connect(
      f'{base.replace("http", "ws")}{path}?{token}', origin=origin or base
  )


def _status(url):
  try:
    with request.urlopen(url, timeout=patience.SECONDS) as answer:
      return answer.status
  except error.HTTPError as refusal:
    with refusal:  # Its body is a file.
      return refusal.code


def test_the_page_needs_the_token(server):
  base, token = server.url.split('?')
  assert _status(server.url) == 200
  assert _status(base) == 403
  assert _status(f'{base}?{token}x') == 403
  assert _status(f'{base}other?{token}') == 404


def test_the_address_is_local_and_the_page_may_load_nothing(server):
  assert server.url.startswith('http://127.0.0.1:')
  with request.urlopen(server.url, timeout=patience.SECONDS) as answer:
    policy = answer.headers['Content-Security-Policy']
    page = answer.read().decode()
  assert "default-src 'none'" in policy
  assert 'https:' not in page


def test_a_page_of_another_address_cannot_connect(server):
  with pytest.raises(exceptions.InvalidStatus, match='403'):
    _connect(server, origin='http://elsewhere.example')


def test_messages_go_both_ways_and_others_are_dropped(server):
  with _connect(server) as connection:
    for text in ('not json', '[1]', '{"type": "run"}'):
      connection.send(text)
    message = server.receive(patience.SECONDS)
    assert message == {'type': 'run'}
    server.send({'type': 'state'})
    assert connection.recv(timeout=patience.SECONDS) == '{"type": "state"}'
    server.send_picture(2, b'jpeg')
    assert connection.recv(timeout=patience.SECONDS) == b'\x02jpeg'


def test_a_malformed_request_is_refused_without_a_traceback(server, caplog):
  address = parse.urlsplit(server.url)
  with socket.create_connection((address.hostname, address.port)) as raw:
    raw.settimeout(patience.SECONDS)
    raw.sendall(b'GET http://[::1?token= HTTP/1.1\r\n' + _UPGRADE)
    assert raw.recv(4096).startswith(b'HTTP/1.1 400 ')
  assert not [one for one in caplog.records if one.exc_info]


def test_messages_that_cannot_be_parsed_are_dropped(server):
  with _connect(server) as connection:
    for text in ('[' * 4_000, '{"a":' * 800, '1' * 4_000):
      connection.send(text)
    connection.send('{"type": "run"}')
    message = server.receive(60.0)  # Not longer: a failure never answers.
  assert message == {'type': 'run'}
