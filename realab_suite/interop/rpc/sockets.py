"""Sockets of servers: addresses, private folders, and users of connections."""

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
_UCRED = struct.Struct('3i')  # Process id, user id, group id.


def path_of(address: str) -> pathlib.Path | None:
  """Returns the path in a unix socket's address; `None` for other addresses."""
  if not address.startswith(_UNIX):
    return None
  return pathlib.Path(address.removeprefix(_UNIX).removeprefix('//'))


@contextlib.contextmanager
def prepared(
    address: str, owner: tuple[int, int] | None = None
) -> Iterator[grpc.LocalConnectionType]:
  """Prepares an address, and restricts the socket that the context creates.

  Only one user can connect to a unix socket.

  Args:
    address: `unix:/folder/name` or `host:port`.
    owner: Ids of the user and the group that may connect; `None` for those of
      this process.

  Yields:
    The kind of connection.

  Raises:
    SpecError: If the address is invalid or in use, or other users could reach
      the socket.
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
          ' unix:/folder/name only, because every user can connect to a port'
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
    raise errors.SpecError(f'address: {address!r:.120} is in use')
  yield grpc.LocalConnectionType.UDS
  path.chmod(0o600)
  if owner is not None:
    os.chown(path, *owner, follow_symlinks=False)


def remove(address: str) -> None:
  """Removes the socket file of an address, if there is one."""
  path = path_of(address)
  if path is not None:
    path.unlink(missing_ok=True)


def users_connected_to(address: str) -> set[int]:
  """Returns the ids of the users that are connected to this process.

  gRPC does not report the users of its connections, so this function inspects
  the process's sockets: an accepted connection has the address of the socket
  that listens.

  Args:
    address: Address at which this process listens. The result is empty unless
      it is a unix socket.
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
          end.getpeername()  # Raises OSError for the socket that listens.
          credentials = end.getsockopt(
              socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size
          )
          users.add(_UCRED.unpack(credentials)[1])
    except OSError:  # The socket listens, or was closed in the meantime.
      continue
  return users


def _make_private(folder: pathlib.Path, owner: tuple[int, int] | None) -> None:
  """Makes a folder that only this user can access; a group may traverse it.

  The folder must belong to this user, because the owner of a folder can replace
  the socket in it.

  Args:
    folder: Path of the folder.
    owner: Ids of the agent's user and group; `None` for those of this process.
      The group may traverse the folder.

  Raises:
    SpecError: If the folder cannot be made, or belongs to another user, or has
      another mode.
  """
  allowed = 0o700 if owner is None else 0o710
  try:
    # The agent's user could not traverse parents that are created here.
    folder.mkdir(mode=0o700, parents=owner is None, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
      raise errors.SpecError(
          f'address: {folder} is not a folder of user {os.geteuid()}; allowed'
          ' are folders into which no other user can put a socket'
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
        f' {allowed:04o}, so that other users cannot reach the socket'
    )


def _is_alive(path: pathlib.Path) -> bool:
  """Returns True if a process listens at a unix socket."""
  with socket.socket(socket.AF_UNIX) as probe:
    try:
      probe.connect(str(path))
    except OSError:
      return False
  return True
