"""Paths that lead out of the working directory, and a watch over files."""

from collections.abc import Iterator
import contextlib
import os
import pathlib
import sys
import tempfile
from typing import Any

from realab_suite.policies import network_files

# Name of the folder in which nothing may be opened.
FOLDER = 'off_limits'
_LINK = 'link.yaml'
_SECRET = 'schema: 1\nname: secret\nregisters: {}\n'


class Watch:
  """Records the files that are opened outside of some folders."""

  def __init__(self) -> None:
    self.opened: list[str] = []
    self._allowed: list[str] = []
    sys.addaudithook(self._hear)  # Cannot be removed.

  @contextlib.contextmanager
  def only(self, *allowed: str) -> Iterator[None]:
    """Records files outside of these while the context lasts."""
    self.opened.clear()
    self._allowed = [os.path.realpath(path) for path in allowed]
    try:
      yield
    finally:
      self._allowed = []

  def _hear(self, event: str, arguments: Any) -> None:
    if not self._allowed or event not in ('open', 'os.listdir', 'os.scandir'):
      return
    path = arguments[0]
    if not isinstance(path, str | bytes | os.PathLike):
      return
    real = os.path.realpath(os.fsdecode(path))
    if not any(os.path.commonpath([real, a]) == a for a in self._allowed):
      self.opened.append(real)


def make_paths(outside: pathlib.Path) -> dict[str, str]:
  """Returns paths out of the working directory, and makes their links."""
  os.symlink(outside / 'secret.yaml', _LINK)
  os.symlink(outside, 'linked')
  os.symlink('linked', 'twice')
  os.symlink('loop', 'loop')
  up = os.path.relpath(outside, '.')
  return {
      'absolute': str(outside / 'secret.yaml'),
      'two slashes': f'/{outside}/secret.yaml',
      'up': f'{up}/secret.yaml',
      'up and down': f'sub/../{up}/secret.yaml',
      'link': _LINK,
      'link to a folder': 'linked/secret.yaml',
      'link to a link': 'twice/secret.yaml',
      'link and up': f'linked/../{outside.name}/secret.yaml',
      'link to itself and up': 'loop/../../x',
      'URL': f'file://{outside}/secret.yaml',
      'home': '~/.netrc',
      'device': '/dev/zero',
      'process': '/proc/self/environ',
      'folder': str(outside),
      'network': str(outside / 'secret.npz'),
      'format': '%s%n',
      'newline': 'a\n../b',
      'dots': '..',
      'home folder': '~',
      'home of another user': '~root/x.npz',
      'drive': 'C:\\x.npz',
      'drive without a folder': 'C:x.npz',
      'share': '\\\\server\\share\\x.npz',
      'up, with backslashes': f'..\\{outside.name}\\secret.npz',
      'NUL': 'a\0b',
  }


@contextlib.contextmanager
def workplace() -> Iterator[pathlib.Path]:
  """Enters a new working directory; yields a folder that is off limits."""
  before = os.getcwd()
  with tempfile.TemporaryDirectory() as name:
    outside = pathlib.Path(name, FOLDER)
    inside = pathlib.Path(name, 'inside')
    outside.mkdir()
    (inside / 'sub').mkdir(parents=True)
    (outside / 'secret.yaml').write_text(_SECRET, encoding='utf-8')
    network = network_files.load('demonstrator_v1')
    (outside / 'secret.npz').write_bytes(network.to_bytes())
    os.chdir(inside)
    try:
      yield outside
    finally:
      os.chdir(before)
