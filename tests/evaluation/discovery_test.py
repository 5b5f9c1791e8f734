"""Discovery figures, worked out by hand."""

import pytest

from realab_suite.evaluation import discovery


def _record(step, num_steps, contact=None, paying=None, num_paying=0):
  return {
      'step': step,
      'num_steps': num_steps,
      'first_contact': contact,
      'first_paying_read': paying,
      'num_paying_reads': num_paying,
      'is_valid': True,
  }


@pytest.mark.parametrize(
    ('records', 'num_envs', 'contact', 'paying', 'num_paying', 'share'),
    [
        ([], 4, None, None, 0, None),
        ([_record(400, 100)], 4, None, None, 0, 0.0),
        # The episode of 100 steps ends after 1,000 steps of 4 worlds. Its step
        # 30 is 70 steps before that, and 4 * 70 = 280.
        ([_record(1000, 100, 30)], 4, 720, None, 0, 1.0),
        ([_record(1000, 100, 30, 100, 1)], 4, 720, 1000, 1, 1.0),
        # One world alone.
        ([_record(100, 100, 30, 41, 7)], 1, 30, 41, 7, 1.0),
        # A long episode that ends later can have the earlier contact.
        ([_record(400, 10, 9, None), _record(800, 200, 1, 200, 2),
          _record(800, 50), _record(800, 50, None, None, 0)], 4,
         800 - 4 * 199, 800, 2, 0.5),
        # First events of different episodes.
        ([_record(400, 100, 50, 90, 3), _record(404, 100, 80, 85, 5)], 4,
         200, 344, 8, 1.0),
    ],
)  # fmt: skip
def test_discovery_by_hand(
    records, num_envs, contact, paying, num_paying, share
):
  found = discovery.discovery(records, [], num_envs)
  assert found.first_contact == contact
  assert found.first_paying == paying
  assert found.num_paying_reads == num_paying
  assert found.num_paying_episodes == sum(
      one['num_paying_reads'] > 0 for one in records
  )
  assert found.contact_share == share
  assert found.num_episodes == len(records)


def test_episodes_that_were_cut_off_count():
  cut = {**_record(400, 100, 50, 90, 3), 'is_valid': False}
  found = discovery.discovery([cut], [], 4)
  assert (found.num_paying_reads, found.contact_share) == (3, 1.0)


@pytest.mark.parametrize(
    ('means', 'expected'),
    [
        ([], None),
        ([0.0, 0.5], None),
        ([2.0, 3.0], 100),
        ([0.0, 2.0, 3.0], 200),
        # From the onset on, all points are above 1.
        ([2.0, 0.5, 2.0, 3.0], 300),
        ([0.0, 2.0, 1.0], None),
        # Points without episodes are skipped.
        ([0.0, None, 2.0, None, 3.0, None], 300),
        ([None, None], None),
    ],
)
def test_onsets_by_hand(means, expected):
  curve = [
      {'step': 100 * (i + 1), 'gain': mean} for i, mean in enumerate(means)
  ]
  assert discovery.onset(curve) == expected
  assert discovery.discovery([], curve, 4).onset == expected
