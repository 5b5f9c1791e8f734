"""A test fails on every warning that it does not announce.

Python's warnings are errors by `filterwarnings` in `setup.cfg`, the ones that
arise where no code can catch them included: a `ResourceWarning` in a destructor
fails the test that is running. This plugin adds what pytest does not see:

* MuJoCo's warnings, which end up in a log. A test that breaks the physics on
  purpose says what may come of it: `@pytest.mark.mujoco_warns('BADQPOS')`.
* Errors in callbacks at exit, which Python prints after the verdict is given.
  They change the exit status of pytest.
"""

import atexit
from collections.abc import Iterator
import os
import sys
from typing import Any, final

# Sets a callback of its own for MuJoCo's warnings when it is imported; after
# that it stays with ours.
from dm_control.mujoco.wrapper import core  # noqa: F401
import mujoco
import pytest

_MARKER = 'mujoco_warns'
# What MuJoCo's messages contain, by the name of the warning.
MESSAGES = {
    'INERTIA': 'Inertia matrix is too close to singular',
    'CONTACTFULL': 'Too many contacts',
    'CNSTRFULL': 'Insufficient arena memory',
    'BADQPOS': 'Nan, Inf or huge value in QPOS',
    'BADQVEL': 'Nan, Inf or huge value in QVEL',
    'BADQACC': 'Nan, Inf or huge value in QACC',
    'BADCTRL': 'Nan, Inf or huge value in CTRL',
}
_FAILED = 1


def name_of(message: str) -> str:
  """Returns the name of one of MuJoCo's warnings, or the message itself."""
  for name, text in MESSAGES.items():
    if text in message:
      return name
  return message


@final
class Gate:
  """A pytest plugin; `tests/conftest.py` registers it."""

  def __init__(self) -> None:
    self._exit_errors: list[str] = []
    # What is registered first is called last.
    atexit.register(self._leave)

  def pytest_configure(self, config: pytest.Config) -> None:
    config.addinivalue_line(
        'markers',
        f'{_MARKER}(*names): breaks the physics, so that MuJoCo warns of these',
    )
    # pytest stops listening in a cleanup that is added later, so done before.
    config.add_cleanup(self._listen)

  @pytest.hookimpl(wrapper=True)
  def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
    """Listens while a test and its fixtures run."""
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    item.stash[_HEARD] = heard
    try:
      return (yield)
    finally:
      mujoco.set_mju_user_warning(before)

  @pytest.hookimpl(wrapper=True)
  def pytest_runtest_call(self, item: pytest.Item) -> Iterator[Any]:
    """Judges what a test has made MuJoCo say."""
    try:
      result = yield
    finally:  # What a failing test has made it say is not its fixtures' doing.
      found = sorted({name_of(message) for message in item.stash[_HEARD]})
      item.stash[_HEARD].clear()
    allowed = {
        name for marker in item.iter_markers(_MARKER) for name in marker.args
    }
    if unlisted := [name for name in found if name not in allowed]:
      pytest.fail(
          f'MuJoCo warned of {unlisted}; announced were {sorted(allowed)}',
          pytrace=False,
      )
    return result

  @pytest.hookimpl(wrapper=True)
  def pytest_runtest_teardown(self, item: pytest.Item) -> Iterator[Any]:
    """Judges what fixtures have made MuJoCo say."""
    result = yield
    if item.stash[_HEARD]:
      names = sorted({name_of(message) for message in item.stash[_HEARD]})
      pytest.fail(f'MuJoCo warned of {names} in a fixture', pytrace=False)
    return result

  def _listen(self) -> None:
    sys.unraisablehook = self._note

  def _note(self, unraisable: Any) -> None:
    what = unraisable.err_msg or 'Exception ignored in'
    self._exit_errors.append(
        f'{what} {unraisable.object!r}: {unraisable.exc_value!r}'
    )

  def _leave(self) -> None:
    if self._exit_errors:
      for error in self._exit_errors:
        sys.stderr.write(f'after the tests: {error}\n')
      sys.stderr.flush()
      sys.stdout.flush()
      os._exit(_FAILED)


_HEARD: pytest.StashKey[list[str]] = pytest.StashKey()
