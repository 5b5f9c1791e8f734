"""Property tests: rows of a damaged file are never taken for others."""

import pathlib
import warnings

import hypothesis
from hypothesis import strategies as st
import pytest

from realab_suite import errors
from realab_suite.evaluation import results
from tests import damage
from tests import examples
from tests.evaluation import rows

_ROWS = [
    rows.row(episode=episode, true_return=2.0 + episode) for episode in range(4)
]
_DATA = b''.join(results.line(row) for row in _ROWS)
_LINES = _DATA.split(b'\n')


@pytest.fixture(scope='module')
def path(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  return tmp_path_factory.mktemp('rows') / 'rows'


def _read(path: pathlib.Path) -> tuple[list[results.EpisodeRow], bool]:
  """Returns the rows that can be read, and True if there is a complaint."""
  found = []
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    try:
      for row in results.read_rows(path):
        found.append(row)
    except errors.ResultsError:
      return found, True
  return found, bool(caught)


def _num_intact(damaged: bytes) -> int:
  """Returns the number of rows before the first damaged one."""
  pairs = list(zip(_LINES[:-1], damaged.split(b'\n')[:-1], strict=False))
  intact = [before == after for before, after in pairs]
  return [*intact, False].index(False)


@examples.settings(200)
@hypothesis.given(damaged=damage.damaged(_DATA))
def test_a_damaged_file_yields_only_rows_that_were_written(
    path: pathlib.Path, damaged: bytes
):
  path.write_bytes(damaged)
  found, is_noticed = _read(path)
  assert all(row in _ROWS for row in found)
  assert len(found) >= _num_intact(damaged)
  # Whole lines may be missing or repeated: `done.json` guards against that.
  assert is_noticed or set(damaged.split(b'\n')) <= set(_LINES)


@examples.settings(50)
@hypothesis.given(size=st.integers(0, len(_DATA) - 1))
def test_a_torn_file_yields_all_rows_before_the_torn_one(
    path: pathlib.Path, size: int
):
  path.write_bytes(_DATA[:size])
  found, is_noticed = _read(path)
  # A row that lacks only its newline is whole.
  num_whole = _DATA[: size + 1].count(b'\n')
  assert found == _ROWS[:num_whole]
  is_torn = size > 0 and _DATA[size - 1 : size + 1].count(b'\n') == 0
  assert is_noticed == is_torn
