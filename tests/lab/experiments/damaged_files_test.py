"""Tests for damaged files: they are refused, and run no code."""

from collections.abc import Iterator
import contextlib
import pathlib
import pickle
import sys
from typing import Any

import hypothesis
from hypothesis import strategies as st
import pytest

from realab_suite import errors
from tests import damage
from tests import examples
from tests.lab.experiments import file_kinds

# Audit events of a pickle that is read, and of a command that one may run.
_FORBIDDEN = ('pickle.find_class', 'os.system')
_NAMES = (
    'checkpoint', 'learner.bin', 'snapshot', 'trace.bin', 'network',
    'config.json', 'episodes.jsonl', 'curve.jsonl',
)  # fmt: skip
_HEARD: list[str] = []
_is_listening = False


def _hear(event: str, arguments: Any) -> None:
  del arguments
  if _is_listening and event in _FORBIDDEN:
    _HEARD.append(event)


sys.addaudithook(_hear)  # Cannot be removed.


@contextlib.contextmanager
def _listening() -> Iterator[None]:
  global _is_listening
  _HEARD.clear()
  _is_listening = True
  try:
    yield
  finally:
    _is_listening = False


@pytest.fixture(scope='module')
def kinds(
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, file_kinds.Kind]:
  found = file_kinds.build(tmp_path_factory.mktemp('kinds'))
  return {kind.name: kind for kind in found}


def test_every_kind_of_file_is_damaged(kinds: dict[str, file_kinds.Kind]):
  assert set(kinds) == set(_NAMES)


@pytest.mark.parametrize('name', _NAMES)
@examples.settings(12)
@hypothesis.given(data=st.data())
def test_a_damaged_file_is_refused_or_unchanged(
    kinds: dict[str, file_kinds.Kind], name: str, data: Any
):
  kind = kinds[name]
  whole = kind.path.read_bytes()
  others = [kinds[other].path.read_bytes() for other in _NAMES if other != name]
  expected = repr(kind.read())
  kind.path.write_bytes(data.draw(damage.damaged(whole, others)))
  try:
    with _listening():
      refusal = _refusal(kind, expected)
  finally:
    kind.path.write_bytes(whole)
  assert len(refusal.splitlines()) <= 1
  assert len(refusal) < 2_000
  assert not _HEARD


def _refusal(kind: file_kinds.Kind, expected: str) -> str:
  """Returns why a file is refused, or '' if nothing in it has changed."""
  try:
    found = repr(kind.read())
  except errors.RealabError as error:
    return str(error)
  assert found == expected  # White space in JSON may differ.
  return ''


def test_reading_a_pickle_is_heard():
  with _listening():
    pickle.loads(pickle.dumps(pathlib.PurePath('x')))
  assert 'pickle.find_class' in _HEARD
