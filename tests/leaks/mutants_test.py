"""Tests that the checks find every planted leak: campaign C09."""

import pytest

from tests.leaks import mutants
from tests.leaks import pairs
from tests.leaks import walk

# Channel L43 is about physics that fail.
_BREAKS = pytest.mark.mujoco_warns('BADQPOS')
_CHANNELS = [f'L{number}' for number in range(1, 46)]


@_BREAKS
@pytest.mark.parametrize(
    'mutant',
    mutants.MUTANTS,
    ids=lambda m: f'{m.channel} {m.what}',
)
def test_a_planted_leak_is_found(mutant: mutants.Mutant):
  assert mutants.found_by(mutant)


@_BREAKS
@pytest.mark.parametrize(
    'check',
    dict.fromkeys(mutant.check for mutant in mutants.MUTANTS),
    ids=lambda check: check.__doc__,
)
def test_nothing_is_found_where_nothing_was_planted(check: mutants.Check):
  assert check() == []


def test_every_channel_has_a_planted_leak_or_a_reason_for_none():
  planted = [mutant.channel for mutant in mutants.MUTANTS]
  assert sorted([*planted, *mutants.NOT_HERE]) == sorted(_CHANNELS)
  assert len(planted) == 38


@pytest.mark.parametrize('num_envs', [0, 2])
def test_no_public_name_of_a_view_leads_to_a_secret(num_envs: int):
  assert walk.find(pairs.Case(num_envs=num_envs, steps=3)) == []
