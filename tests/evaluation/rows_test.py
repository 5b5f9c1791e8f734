"""A slice of campaign C39: rows and other files that were damaged."""

import numpy as np
import pytest

from campaigns import rows_campaign
from realab_suite.config import validation
from realab_suite.evaluation import results
from realab_suite.experiments import storage


def _damage(monkeypatch, times=100):
  monkeypatch.setattr(storage.os, 'fsync', lambda descriptor: None)
  return rows_campaign.damage_many(times, np.random.default_rng(0))


def test_nothing_that_was_damaged_is_taken_for_whole(monkeypatch):
  tally, others, taken = _damage(monkeypatch, 210)
  assert tally.damaged == 210
  assert tally.noticed > 150
  assert (tally.accepted, tally.lost, tally.unnoticed) == (0, 0, 0)
  assert (others, taken) == (21, 0)


def test_rows_without_checksums_are_taken_though_damaged(monkeypatch):
  monkeypatch.setattr(results, '_checksum', lambda text: b'')
  tally, _, _ = _damage(monkeypatch)
  assert tally.accepted > 0


def test_rows_that_are_not_read_are_counted_as_lost(monkeypatch):
  monkeypatch.setattr(results, 'read_rows', lambda path: iter(()))
  tally, _, _ = _damage(monkeypatch)
  assert tally.lost > 0
  assert tally.unnoticed > 0


@pytest.mark.parametrize(
    ('module', 'name'), [(validation, 'digest_of'), (storage, '_digest')]
)
def test_other_files_without_checksums_are_taken_for_whole(
    monkeypatch, module, name
):
  monkeypatch.setattr(module, name, lambda content: '')
  monkeypatch.setattr(storage, '_read_done', lambda path: {})
  _, others, taken = _damage(monkeypatch, 400)
  assert others == 40
  assert taken > 0
