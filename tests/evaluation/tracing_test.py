"""Tests of the arithmetic of tracing, with tables worked out by hand."""

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hypothesis_numpy
import numpy as np
import pytest

from realab_suite.evaluation import tracing

_NONE = [0.0] * 6
_EACH = [True] * 6
_NEVER = [False] * 6


def _trace(permanent, temporary, now, now_temporary, is_written, culprits):
  agent = tracing.Parts(np.array(permanent), np.array(temporary))
  caused = tracing.Parts(np.array(now), np.array(now_temporary))
  return tracing.trace(
      agent, caused, np.array(is_written), np.array(culprits)
  ).tolist()


def test_a_throw_is_traced_to_the_step_of_the_throw():
  # Step 1 throws the base block: 2 units at once. It flies on by 3 and 1 units
  # in steps 2 and 3, without an action. Step 4 pushes it back by 6.
  permanent = [0.0, 2.0, 5.0, 6.0, 0.0, 0.0]
  now = [0.0, 2.0, 0.0, 0.0, -6.0, 0.0]
  # 2 x 5 steps + 3 x 4 + 1 x 3 = 25, and -6 x 2 = -12: the sum is 13.
  assert _trace(permanent, _NONE, now, _NONE, _EACH, [0, 0, 1, 1, 1, 4]) == [
      0, 25, 0, 0, -12, 0,
  ]  # fmt: skip


@pytest.mark.parametrize(
    ('is_written', 'temporary', 'expected'),
    [
        # Repaired in every step: each step has its own.
        (_EACH, [0.0, 4.0, 1.0, 0.0, 0.0, 0.0], [0, 4, 1, 0, 0, 0]),
        # Step 4 writes: 4 units count in steps 1 to 3.
        (
            [1, 0, 0, 0, 1, 0],
            [0.0, 4.0, 5.0, 5.0, 0.0, 0.0],
            [0, 12, 2, 0, 0, 0],
        ),
        (_NEVER, [0.0, 4.0, 5.0, 5.0, 5.0, 5.0], [0, 20, 4, 0, 0, 0]),
    ],
)
def test_temporary_corruption_counts_until_the_next_write(
    is_written, temporary, expected
):
  now = [0.0, 4.0, 1.0, 0.0, 0.0, 0.0]
  is_written = np.array(is_written, bool)
  found = _trace(_NONE, temporary, _NONE, now, is_written, [0, 0, 1, 2, 2, 2])
  assert found == expected


def test_a_block_in_the_hand_is_traced_to_the_step_that_grasped_it():
  # Each write moves the block away, and it returns to the hand by 3 units.
  temporary = [0.0, 0.0, 3.0, 3.0, 3.0, 3.0]
  culprits = [0, 0, 1, 1, 1, 1]
  found = _trace(_NONE, temporary, _NONE, _NONE, _EACH, culprits)
  assert found == [0, 12, 0, 0, 0, 0]


def test_culprits_are_steps_that_moved_the_register_or_acted():
  has_moved = np.array([0, 1, 0, 0, 1, 0], bool)
  has_acted = np.array([1, 1, 0, 1, 1, 0], bool)
  disturbed = np.array([0, 0, 1, 1, 1, 1], bool)
  find = tracing.find_culprits
  assert find(has_moved, has_acted, disturbed).tolist() == [0, 0, 1, 1, 1, 4]
  nowhere = np.zeros(6, bool)
  assert find(has_moved, has_acted, nowhere).tolist() == [0, 0, 1, 1, 3, 4]
  assert find(nowhere, has_acted, disturbed).tolist() == [0, 0, 1, 1, 3, 4]
  # Nothing before has acted.
  assert find(nowhere, nowhere, disturbed).tolist() == [0, 1, 2, 3, 4, 5]


_series = hypothesis_numpy.arrays(float, 7, elements=st.floats(-60, 60))
_masks = hypothesis_numpy.arrays(bool, 7)


@given(_series, _series, _series, _series, _masks, _masks, _masks, _masks)
def test_what_is_traced_to_steps_is_the_share_of_the_agent(
    permanent, temporary, now, now_temporary, written, moved, acted, disturbed
):
  culprits = tracing.find_culprits(moved, acted, disturbed)
  found = _trace(permanent, temporary, now, now_temporary, written, culprits)
  share = (permanent + temporary).sum()
  assert sum(found) == pytest.approx(share, abs=1e-9)
