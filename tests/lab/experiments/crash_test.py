"""A run that is killed at any operation on a file ends like any other."""

import hypothesis
from hypothesis import strategies as st
import pytest

from tests import examples
from tests import zygote
from tests.lab.experiments import crashes

# At least as many operations as a run has; see the first test.
_MOST_OPERATIONS = 50


@pytest.fixture(scope='module', name='nursery')
def _nursery():
  with zygote.Zygote(crashes.__name__) as nursery:
    yield nursery


@pytest.fixture(scope='module', name='killer')
def _killer(nursery, tmp_path_factory):
  return crashes.Killer(nursery, tmp_path_factory.mktemp('killed'))


def test_a_run_has_operations_to_be_killed_at(killer):
  assert 30 < killer.num_operations <= _MOST_OPERATIONS


@examples.settings(6)
@hypothesis.given(
    kills=st.lists(
        st.tuples(
            st.integers(1, _MOST_OPERATIONS), st.sampled_from(crashes.WAYS)
        ),
        min_size=1,
        max_size=3,
    )
)
# Among these are a checkpoint, and lines that were written after one.
@hypothesis.example([(5, crashes.KILLED), (16, crashes.KILLED)])
@hypothesis.example([(11, crashes.TORN), (23, crashes.TORN)])
def test_a_run_that_is_killed_ends_like_any_other(killer, kills):
  assert killer.kill_and_finish(kills) == []


def test_a_run_that_is_killed_where_adaptation_begins_ends_like_any_other(
    nursery, tmp_path
):
  killer = crashes.Killer(nursery, tmp_path, crashes.CLASS)
  assert 40 < killer.num_operations <= _MOST_OPERATIONS
  # Rows of both stages are written by operations 19 and 22, between checkpoints
  # that are there after 16 and 29.
  for kills in (
      [(19, crashes.TORN)],
      [(22, crashes.KILLED), (7, crashes.KILLED)],
      [(28, crashes.TORN)],
  ):
    assert killer.kill_and_finish(kills) == []
