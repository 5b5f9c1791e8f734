"""Search for a number or a salt in bytes, memory and files: campaign C10."""

from collections.abc import Iterator, Sequence
import contextlib
import pathlib
import re
import socket
import struct
import subprocess
import sys
import threading

from realab_suite.interop.rpc import sockets
from tests.interop import clones


def patterns(canary: float) -> dict[str, bytes]:
  """Returns the representations of a number in bytes."""
  return {
      'f8 little-endian': struct.pack('<d', canary),
      'f8 big-endian': struct.pack('>d', canary),
      'f4 little-endian': struct.pack('<f', canary),
      'f4 big-endian': struct.pack('>f', canary),
      'decimal': f'{canary:.4f}'.encode(),
  }


def hits(data: bytes, canary: float) -> list[str]:
  """Returns the representations of a number that occur in bytes."""
  found = []
  for name, pattern in patterns(canary).items():
    for match in re.finditer(re.escape(pattern), data):
      # Four bytes are found by chance now and then; numbers are aligned.
      if len(pattern) > 4 or match.start() % 4 == 0:
        found.append(name)
        break
  return found


def salt_hits(data: bytes, salt: bytes) -> list[str]:
  """Returns the representations of a salt that occur in bytes."""
  forms = clones.forms_of(salt).items()
  return [f'salt: {name}' for name, form in forms if form in data]


def memory(pid: int) -> Iterator[bytes]:
  """Yields the writable memory of a process."""
  with open(f'/proc/{pid}/mem', 'rb', 0) as file:
    for line in pathlib.Path(f'/proc/{pid}/maps').read_text().splitlines():
      span, rights, *_ = line.split()
      if 'rw' not in rights or '[v' in line:
        continue
      start, end = (int(part, 16) for part in span.split('-'))
      with contextlib.suppress(OSError, ValueError, OverflowError):
        file.seek(start)
        yield file.read(end - start)


# Prints the number and the content of files that another user may read.
_READER = """
import os, stat, sys
os.setgroups([]); os.setgid(65534); os.setuid(65534)
number, contents = 0, []
for root in sys.argv[1:]:
  for folder, _, names in os.walk(root):
    for name in names:
      path = os.path.join(folder, name)
      try:
        if stat.S_ISREG(os.stat(path).st_mode):
          with open(path, 'rb') as file:
            contents.append(file.read(2**26))
          number += 1
      except OSError:
        pass
sys.stdout.buffer.write(b'%d\\n' % number + b'|'.join(contents))
"""


def read_as_another_user(roots: Sequence[pathlib.Path]) -> tuple[int, bytes]:
  """Returns the number and the content of files that another user may read.

  An agent of tier T2 could read them. Only root can call this function.
  """
  ran = subprocess.run(
      [sys.executable, '-c', _READER, *map(str, roots)],
      capture_output=True,
      check=True,
  )
  number, _, contents = ran.stdout.partition(b'\n')
  return int(number), contents


class Relay:
  """Passes bytes between an agent and a server, and keeps a copy."""

  def __init__(self, folder: str, target: str) -> None:
    self.captured = bytearray()
    self._target = str(sockets.path_of(target))
    self._listener = socket.socket(socket.AF_UNIX)
    self._listener.bind(f'{folder}/relay')
    self._listener.listen()
    self.address = f'unix:{folder}/relay'
    threading.Thread(target=self._accept, daemon=True).start()

  def _accept(self) -> None:
    with contextlib.suppress(OSError):
      while True:
        near, _ = self._listener.accept()
        far = socket.socket(socket.AF_UNIX)
        far.connect(self._target)
        for ends in ((near, far), (far, near)):
          threading.Thread(target=self._copy, args=ends, daemon=True).start()

  def _copy(self, source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
      while data := source.recv(65_536):
        self.captured += data
        sink.sendall(data)
    for end in (source, sink):
      with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)

  def close(self) -> None:
    self._listener.close()
