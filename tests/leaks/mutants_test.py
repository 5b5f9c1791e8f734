"""Tests that the checks find every planted leak: campaign C09."""

import pytest

from campaigns import leaks_campaign
from tests.leaks import mutants
from tests.leaks import pairs
from tests.leaks import walk

# Channel L43 is about physics that fail.
_BREAKS = pytest.mark.mujoco_warns('BADQPOS')
_CHANNELS = [f'L{number}' for number in range(1, 46)]
# One of each channel; the campaign plants all of them.
_ONE_OF_EACH = {mutant.channel: mutant for mutant in mutants.MUTANTS[::-1]}


@_BREAKS
@pytest.mark.parametrize(
    'mutant',
    _ONE_OF_EACH.values(),
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
  planted = {mutant.channel for mutant in mutants.MUTANTS}
  assert not planted & set(mutants.NOT_HERE)
  assert sorted(planted | set(mutants.NOT_HERE)) == sorted(_CHANNELS)
  assert len(planted) >= 36
  assert len({mutant.what for mutant in mutants.MUTANTS}) == len(
      mutants.MUTANTS
  )


def test_an_undetected_leak_is_reported():
  blind = mutants.MUTANTS[0]._replace(check=list)
  assert leaks_campaign.uncaught([blind]) == [
      'L1 The reward is the true reward.'
  ]


@pytest.mark.parametrize('num_envs', [0, 2])
def test_no_public_name_of_a_view_leads_to_a_secret(num_envs: int):
  assert walk.find(pairs.Case(num_envs=num_envs, steps=3)) == []


def test_private_names_lead_to_secrets():
  reached = walk.secrets_reached(pairs.Case(steps=3))
  assert 'environment' in reached
