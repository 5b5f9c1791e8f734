"""Where a server listens: folders that are the user's own, and who connects."""

from collections.abc import Iterator
import contextlib
import os
import pathlib
import socket
import stat
import struct

import grpc

from realab_suite import errors

_UNIX = 'unix:'
_MAX_PATH = 100  # The system's limit is 107 or less.
_UCRED = struct.Struct('3i')  # Process, user, group.


def path_of(address: str) -> pathlib.Path | None:
  """Returns the path of a unix socket's address; `None` for others."""
  if not address.startswith(_UNIX):
    return None
  return pathlib.Path(address.removeprefix(_UNIX).removeprefix('//'))


@contextlib.contextmanager
def prepared(
    address: str, owner: tuple[int, int] | None = None
) -> Iterator[grpc.LocalConnectionType]:
  """Makes room for a socket; what is made within is for one user only.

  Args:
    address: Where to listen.
    owner: The user and the group who may connect; `None` for this user's own.

  Raises:
    SpecError: If others could get at the socket, or somebody listens there.
  """
  path = path_of(address)
  if path is None:
    host, colon, port = address.rpartition(':')
    if not (host and colon and port.isdecimal()):
      raise errors.SpecError(
          f'address: {address!r:.80}; allowed are unix:/folder/name and'
          ' host:port'
      )
    if owner is not None:
      raise errors.SpecError(
          f'address: {address!r:.80}; allowed with a user for the agent is'
          ' unix:/folder/name alone, because anybody could connect to a port'
      )
    yield grpc.LocalConnectionType.LOCAL_TCP
    return
  if len(os.fsencode(path)) > _MAX_PATH or not path.is_absolute():
    raise errors.SpecError(
        f'address: {address!r:.80}; allowed is an absolute path of at most'
        f' {_MAX_PATH} bytes'
    )
  _make_private(path.parent, owner)
  if _is_alive(path):
    raise errors.SpecError(
        f'address: somebody listens at {address!r:.120} already'
    )
  yield grpc.LocalConnectionType.UDS
  path.chmod(0o600)
  if owner is not None:
    os.chown(path, *owner, follow_symlinks=False)


def remove(address: str) -> None:
  """Removes what is left of a socket."""
  path = path_of(address)
  if path is not None:
    path.unlink(missing_ok=True)


def users_connected_to(address: str) -> set[int]:
  """Returns the users at the other ends of this process's connections.

  gRPC does not say who has connected, but the system does: a connection that
  was accepted has the address of the socket that it was made to.

  Args:
    address: Where this process listens. There are users at unix sockets only.
  """
  path = path_of(address)
  users: set[int] = set()
  if path is None or not hasattr(socket, 'SO_PEERCRED'):
    return users
  for name in os.listdir('/proc/self/fd'):
    try:
      if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
        continue
      with socket.socket(fileno=os.dup(int(name))) as end:
        if end.family == socket.AF_UNIX and end.getsockname() == str(path):
          end.getpeername()  # The socket that listens has no other end.
          credentials = end.getsockopt(
              socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size
          )
          users.add(_UCRED.unpack(credentials)[1])
    except OSError:  # It has been closed meanwhile.
      continue
  return users


def _make_private(folder: pathlib.Path, owner: tuple[int, int] | None) -> None:
  """Makes a folder that its user alone can enter; the owner's group may pass.

  The folder is this user's and stays so, because whoever has it can put another
  socket there.
  """
  allowed = 0o700 if owner is None else 0o710
  try:
    # Folders that are made on the way would not let the owner pass.
    folder.mkdir(mode=0o700, parents=owner is None, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
      raise errors.SpecError(
          f'address: {folder} is no folder of user {os.geteuid()}; allowed is'
          ' one that nobody else could put a socket into'
      )
    mode = stat.S_IMODE(status.st_mode)
    if owner is not None and not mode & ~allowed:
      os.chown(folder, -1, owner[1])
      folder.chmod(allowed)
  except OSError as error:
    raise errors.SpecError(
        f'address: cannot make folder {folder}: {error.strerror}'
    ) from error
  if mode & ~allowed:
    raise errors.SpecError(
        f'address: folder {folder} has mode {mode:04o}; allowed is'
        f' {allowed:04o}, so that others cannot reach the socket'
    )


def _is_alive(path: pathlib.Path) -> bool:
  """Returns whether somebody listens at a path."""
  with socket.socket(socket.AF_UNIX) as probe:
    try:
      probe.connect(str(path))
    except OSError:
      return False
  return True
