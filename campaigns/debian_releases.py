"""Runs the tests and the demo on newer releases of Debian, in a folder each.

  python -m campaigns.debian_releases /var/tmp/releases trixie forky

Needs Linux, root, git and debootstrap. Each release is unpacked into the
folder, with its own Python (trixie: 3.13, forky: 3.14), and gets a clone of the
commit that is checked out here. The folders stay; remove them after unmounting
their `proc`.
"""

import pathlib
import subprocess
import sys
import time

_PACKAGES = (
    *('python3-venv', 'python3-pip', 'make', 'git', 'ca-certificates'),
    *('libegl1', 'libgl1', 'libgl1-mesa-dri'),
)
_SCRIPTS = pathlib.Path('/usr/share/debootstrap/scripts')
_SETTINGS = ('env', 'LC_ALL=C.UTF-8', 'make', '-C', '/realab', 'PYTHON=python3')


def main() -> int:
  """Tries each release, and returns the number of failures."""
  folder, *releases = sys.argv[1:]
  failures = 0
  for release in releases:
    root = pathlib.Path(folder).resolve() / release
    if not root.exists():
      _unpack(release, root)
    # JAX reads the processors from there.
    if not (root / 'proc' / 'self').exists():
      _run('mount', '--bind', '/proc', root / 'proc')
    clone = root / 'realab'
    _run('rm', '-rf', clone)
    _run('git', 'clone', '-q', pathlib.Path.cwd(), clone)
    for target in ('test', 'demo'):
      start = time.monotonic()
      ran = subprocess.run(['chroot', root, *_SETTINGS, target], check=False)
      minutes = (time.monotonic() - start) / 60
      print(f'{release}: make {target}: {ran.returncode}, {minutes:.1f} min')
      failures += ran.returncode != 0
  return failures


def _unpack(release: str, root: pathlib.Path) -> None:
  # An older debootstrap does not know the names of later releases.
  script = _SCRIPTS / release
  if not script.exists():
    script.symlink_to('sid')
  include = f'--include={",".join(_PACKAGES)}'
  _run('debootstrap', '--variant=minbase', include, release, root)


def _run(*command: object) -> None:
  subprocess.run([str(word) for word in command], check=True)


if __name__ == '__main__':
  sys.exit(main())
