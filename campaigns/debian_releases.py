"""Installs and tries the package on newer releases of Debian.

  python -m campaigns.debian_releases /var/tmp/releases trixie sid

Needs Linux, root, git and debootstrap. Each release is unpacked into the
folder, with its own Python (trixie: 3.13, sid: 3.14), and gets a clone of the
commit that is checked out here. There, the doctor and small tests run, the
trained agents among them. The folders stay, for more of the same kind:

  chroot /var/tmp/releases/sid make -C /realab PYTHON=python3 demo

Before a folder is removed, its `proc` has to be unmounted.
"""

import pathlib
import shutil
import subprocess
import sys

from campaigns import dependency_ranges

_PACKAGES = (
    *('python3-venv', 'python3-pip', 'make', 'git', 'ca-certificates'),
    *('libegl1', 'libgl1', 'libgl1-mesa-dri'),
)
_SCRIPTS = pathlib.Path('/usr/share/debootstrap/scripts')
_CERTIFICATES = pathlib.Path('etc/ssl/certs/ca-certificates.crt')
_TRIES = (
    'make -s PYTHON=python3 .venv/dev',
    '.venv/bin/realab doctor',
    *(f'.venv/bin/python -m {words}' for words in dependency_ranges.TRIES),
)


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
    # This machine may trust a proxy of its own.
    shutil.copy(pathlib.Path('/') / _CERTIFICATES, root / _CERTIFICATES)
    clone = root / 'realab'
    _run('rm', '-rf', clone)
    _run('git', 'clone', '-q', pathlib.Path.cwd(), clone)
    for words in _TRIES:
      print(f'{release}: {words}', flush=True)
      script = f'cd /realab && LC_ALL=C.UTF-8 {words}'
      tried = subprocess.run(['chroot', root, 'sh', '-c', script], check=False)
      failures += tried.returncode != 0
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
