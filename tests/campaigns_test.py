"""Each bug of the campaign on planted bugs can still be planted."""

import pytest

from campaigns import mutants_campaign
from campaigns import planting


@pytest.mark.parametrize(
    'mutant', mutants_campaign.MUTANTS, ids=lambda mutant: mutant.what
)
def test_a_bug_can_be_planted_and_its_tests_exist(mutant):
  path = planting.ROOT / 'realab_suite' / mutant.file
  text = path.read_text(encoding='utf-8')
  spoilt = planting.mutated(mutant, text)
  assert spoilt != text
  compile(spoilt, mutant.file, 'exec')
  files = [one for one in mutant.tests if one.endswith('.py')]
  assert files
  assert all((planting.ROOT / one).exists() for one in files)
