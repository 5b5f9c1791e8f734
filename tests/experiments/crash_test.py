"""Slices of campaigns C36, C37 and C38: crashes, failing disks, launchers."""

import pathlib

import numpy as np
import pytest

from campaigns import disk_campaign
from campaigns import kill_campaign
from campaigns import launchers_campaign
from campaigns import victims
from campaigns import zygote


@pytest.fixture(scope='module', name='nursery')
def _nursery():
  with zygote.Zygote(victims.__name__) as nursery:
    yield nursery


@pytest.fixture(scope='module', name='killer')
def _killer(nursery, tmp_path_factory):
  return kill_campaign.Killer(nursery, tmp_path_factory.mktemp('killed'))


@pytest.fixture(autouse=True)
def _new_tally(request):
  if 'killer' in request.fixturenames:
    request.getfixturevalue('killer').tally = kill_campaign.Tally()


@pytest.mark.parametrize('way', victims.WAYS)
def test_a_run_that_is_killed_at_an_operation_ends_like_any_other(killer, way):
  # Among these are a checkpoint, and lines that were written after one.
  place = victims.WAYS.index(way)
  for number in (5 + 13 * place, killer.num_operations - 7 * place):
    killer.kill_at(number, way)
  assert killer.tally == kill_campaign.Tally(kills=2)


def test_a_run_that_is_killed_at_random_times_ends_like_any_other(killer):
  killer.kill_at_random(np.random.default_rng(0))
  tally = killer.tally
  assert (tally.failures, tally.differing) == ([], [])


@pytest.mark.parametrize(
    ('bug', 'number', 'way'),
    [
        ('files are written in place', 8, victims.POWER),
        ('nothing is synchronised', 24, victims.NAMES_FIRST),
        ('lines behind the checkpoint stay', 24, victims.KILLED),
        ('the learner forgets a step', 24, victims.KILLED),
    ],
)
def test_a_kill_shows_what_was_done_wrong(killer, bug, number, way):
  killer.kill_at(number, way, bug)
  assert killer.tally.kills == 1
  assert killer.tally.failures or killer.tally.differing


def test_no_row_that_was_acknowledged_is_lost(nursery, killer, tmp_path):
  rows = kill_campaign.rows_of(killer, 3)
  tally = kill_campaign.RowTally()
  for number in (1, 3, 4, 6):
    for way in victims.WAYS:
      kill_campaign.kill_writer(nursery, tmp_path, rows, number, way, tally)
  assert tally.kills == 16
  assert tally.acknowledged > 0
  assert tally.torn > 0
  assert (tally.lost, tally.unnoticed) == (0, 0)


def test_a_full_disk_is_told_in_one_line_and_nothing_is_lost(killer, tmp_path):
  vandal = disk_campaign.Vandal(killer, tmp_path)
  largest = disk_campaign.largest_file(killer)
  for size in (0, 700, largest - 1):
    vandal.limit(size)
  for name in disk_campaign.files_written_whole()[-4:-2]:
    vandal.fill(name)
  assert vandal.tally == disk_campaign.Tally(failed=5)


@pytest.mark.parametrize('accident', victims.ACCIDENTS)
def test_what_happens_to_a_folder_is_told_in_one_line(
    killer, tmp_path, accident
):
  vandal = disk_campaign.Vandal(killer, tmp_path)
  vandal.have_accident(accident)
  assert vandal.tally == disk_campaign.Tally(failed=1)


def test_a_folder_that_is_read_only_is_told_in_one_line(killer, tmp_path):
  vandal = disk_campaign.Vandal(killer, tmp_path)
  vandal.forbid()
  assert vandal.tally == disk_campaign.Tally(failed=1)


def test_an_accident_shows_what_was_done_wrong(killer, tmp_path):
  vandal = disk_campaign.Vandal(killer, tmp_path)
  vandal.have_accident('curve is full', 'errors are swallowed')
  assert vandal.tally.complaints


def test_a_sweep_that_is_killed_lacks_nothing_and_does_nothing_twice(
    nursery, tmp_path
):
  rng = np.random.default_rng(0)
  tally = launchers_campaign.sweep(nursery, tmp_path, 8, 1, rng)
  assert tally == launchers_campaign.Tally(kills=1, second=1)


def test_two_launchers_at_once_are_noticed(nursery, tmp_path: pathlib.Path):
  tally = launchers_campaign.Tally()
  launchers_campaign.race(nursery, tmp_path, 'locks hold nobody off', tally)
  assert tally.not_refused
