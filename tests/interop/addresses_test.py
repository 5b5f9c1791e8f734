"""Tests of the addresses of servers: sockets, folders and ports."""

import os
import re
import socket
import subprocess
import sys
import threading

import pytest

from realab_suite import errors
from realab_suite.interop.rpc import agent_process
from realab_suite.interop.rpc import agent_server
from realab_suite.interop.rpc import sockets
from tests import patience
from tests.interop import served

_PYTHON = sys.executable
_NOBODY = 65534
_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')


@pytest.fixture(name='serving', scope='module')
def _serving():
  with served.in_thread() as serving:
    yield serving


# Addresses.


class _Nothing:
  """A world that echoes requests."""

  def connect(self):
    pass

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


def test_a_folder_open_to_others_is_refused(tmp_path):
  tmp_path.chmod(0o755)
  with pytest.raises(errors.SpecError, match='mode 0755; allowed is 0700'):
    agent_server.Server(_Nothing(), f'unix:{tmp_path}/socket').start()


def test_a_link_to_a_folder_is_refused(tmp_path):
  (tmp_path / 'own').mkdir(mode=0o700)
  (tmp_path / 'link').symlink_to(tmp_path / 'own')
  with pytest.raises(errors.SpecError, match='is not a folder of user'):
    agent_server.Server(_Nothing(), f'unix:{tmp_path}/link/socket').start()


@_is_root
def test_a_folder_of_another_user_is_refused(tmp_path):
  (tmp_path / 'theirs').mkdir(mode=0o700)
  os.chown(tmp_path / 'theirs', _NOBODY, _NOBODY)
  address = f'unix:{tmp_path}/theirs/socket'
  for owner in (None, (_NOBODY, _NOBODY)):
    with pytest.raises(errors.SpecError, match='is not a folder of user 0'):
      agent_server.Server(_Nothing(), address, owner=owner).start()


@_is_root
def test_a_folder_belongs_to_the_group_of_the_current_client(tmp_path):
  folder = tmp_path / 'own'
  for group in (_NOBODY, _NOBODY - 1):
    with sockets.prepared(f'unix:{folder}/socket', (_NOBODY, group)):
      (folder / 'socket').touch()
    status = folder.stat()
    assert (status.st_mode & 0o777, status.st_gid) == (0o710, group)
    (folder / 'socket').unlink()
  with pytest.raises(errors.SpecError, match='cannot make folder'):
    with sockets.prepared(f'unix:{tmp_path}/a/b/s', (_NOBODY, _NOBODY)):
      pass


def test_a_port_cannot_be_limited_to_one_user():
  with pytest.raises(errors.SpecError, match='every user can connect'):
    agent_server.Server(_Nothing(), 'localhost:0', owner=(1, 1)).start()


@_is_root
def test_an_agent_cannot_be_root():
  with pytest.raises(errors.SpecError, match='is root'):
    agent_process.owner_of('root')


def test_a_socket_is_open_to_its_user_only(serving):
  path = sockets.path_of(serving.address)
  assert path.parent.stat().st_mode & 0o777 == 0o700
  assert path.stat().st_mode & 0o777 == 0o600


def test_an_address_in_use_is_refused(serving):
  with pytest.raises(errors.SpecError, match='is in use'):
    agent_server.Server(_Nothing(), serving.address).start()
  with served.Client(serving.address) as client:
    client.join()


def test_the_socket_of_a_killed_server_is_reused(tmp_path):
  tmp_path.chmod(0o700)
  with socket.socket(socket.AF_UNIX) as killed:
    killed.bind(str(tmp_path / 'socket'))
  server = agent_server.Server(_Nothing(), f'unix:{tmp_path}/socket')
  server.start()
  server.stop()
  server.run()
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


def test_an_interrupted_answer_does_not_block_the_exit(tmp_path):
  # Python waits for the threads of pools when it ends.
  program = f"""
import threading
from realab_suite.interop.rpc import agent_server
from tests.interop import addresses_test, served
def interrupt(request):
  raise KeyboardInterrupt
world = addresses_test._Nothing()
world.answer = interrupt
made = agent_server.Server(world, 'unix:{tmp_path}/s/socket')
made.start()
stream = served.RawStream(made.address)
threading.Thread(target=stream.ask, args=(b'x',), daemon=True).start()
try:
  made.run()
except KeyboardInterrupt:
  raise SystemExit(7)
"""
  ran = subprocess.run(
      [_PYTHON, '-c', program], cwd=served.ROOT, timeout=patience.SECONDS,
      check=False, stderr=subprocess.DEVNULL,
  )  # fmt: skip
  assert ran.returncode == 7


def test_a_server_does_not_survive_a_fork(tmp_path, monkeypatch):
  made = agent_server.Server(_Nothing(), f'unix:{tmp_path}/s/socket')
  monkeypatch.setattr(os, 'getpid', lambda: -1)
  with pytest.raises(errors.ForkError):
    made.run()
