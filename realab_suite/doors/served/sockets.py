"""Addresses of servers."""

import os
import pathlib
import socket

import grpc

from realab_suite import errors

_UNIX = 'unix:'
_MAX_PATH = 100  # The system's limit is 107 or less.


def path_of(address: str) -> pathlib.Path | None:
  """Returns the path in a unix socket's address; `None` for other addresses."""
  if not address.startswith(_UNIX):
    return None
  return pathlib.Path(address.removeprefix(_UNIX).removeprefix('//'))


def prepare(address: str) -> grpc.LocalConnectionType:
  """Checks an address, and creates the folder of a unix socket.

  Args:
    address: `unix:/folder/name` or `host:port`.

  Returns:
    The kind of connection.

  Raises:
    SpecError: If the address is invalid, in use, or in a folder that cannot be
      created.
  """
  path = path_of(address)
  if path is None:
    host, colon, port = address.rpartition(':')
    if not (host and colon and port.isdecimal()):
      raise errors.SpecError(
          f'address: {address!r:.80}; must be unix:/folder/name or host:port'
      )
    return grpc.LocalConnectionType.LOCAL_TCP
  if len(os.fsencode(path)) > _MAX_PATH or not path.is_absolute():
    raise errors.SpecError(
        f'address: {address!r:.80}; must be an absolute path of at most'
        f' {_MAX_PATH} bytes; without --address, set a shorter TMPDIR'
    )
  try:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
  except OSError as error:
    raise errors.SpecError(
        f'address: cannot create folder {path.parent}: {error.strerror}'
    ) from error
  if _is_alive(path):  # gRPC would take the place of the other socket.
    raise errors.SpecError(f'address: {address!r:.120} is in use')
  return grpc.LocalConnectionType.UDS


def remove(address: str) -> None:
  """Removes the socket file of an address, if there is one."""
  path = path_of(address)
  if path is not None:
    path.unlink(missing_ok=True)


def _is_alive(path: pathlib.Path) -> bool:
  """Returns True if a process listens at a unix socket."""
  with socket.socket(socket.AF_UNIX) as probe:
    try:
      probe.connect(str(path))
    except OSError:
      return False
  return True
