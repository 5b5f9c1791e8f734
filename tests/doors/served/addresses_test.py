"""Tests of the addresses of servers: sockets and ports."""

import re
import socket
import threading

import pytest

from realab_suite import errors
from realab_suite.doors.served import agent_server
from tests.doors.served import served


@pytest.fixture(name='serving', scope='module')
def _serving():
  with served.in_thread() as serving:
    yield serving


# Addresses.


class _Nothing:
  """A world that echoes requests."""

  def answer(self, request):
    return request

  def disconnect(self):
    pass

  def settle(self):
    return True


@pytest.mark.parametrize(
    'address',
    ['socket', 'unix:socket', 'unix:/' + 'x' * 200, 'localhost:http', ':1'],
)
def test_a_wrong_address_is_refused(address):
  with pytest.raises(errors.SpecError, match='address: '):
    agent_server.Server(_Nothing(), address).start()


def test_a_long_temporary_folder_is_named():
  folder = f'/{"x" * 120}/realab-1'
  with pytest.raises(errors.SpecError, match='set a shorter TMPDIR'):
    agent_server.Server(_Nothing(), f'unix:{folder}/socket').start()


def test_an_address_in_use_is_refused(serving):
  with pytest.raises(errors.SpecError, match='is in use'):
    agent_server.Server(_Nothing(), serving.address).start()
  with served.Client(serving.address) as client:
    client.join()


def test_the_socket_of_a_killed_server_is_reused(tmp_path):
  with socket.socket(socket.AF_UNIX) as killed:
    killed.bind(str(tmp_path / 'socket'))
  server = agent_server.Server(_Nothing(), f'unix:{tmp_path}/socket')
  server.start()
  thread = threading.Thread(target=server.run)
  thread.start()
  stream = served.RawStream(server.address)
  assert stream.ask(b'echo') == b'echo'
  stream.close()
  server.stop()
  thread.join()
  assert not (tmp_path / 'socket').exists()


def test_a_port_of_this_machine_can_be_served():
  server = agent_server.Server(_Nothing(), 'localhost:0')
  server.start()
  assert re.fullmatch(r'localhost:[1-9]\d*', server.address)
  thread = threading.Thread(target=server.run)
  thread.start()
  stream = served.RawStream(server.address)
  assert stream.ask(b'echo') == b'echo'
  stream.close()
  server.stop()
  thread.join()
