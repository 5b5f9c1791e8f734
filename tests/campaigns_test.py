"""Tests for the campaign on planted bugs, and the list of all campaigns."""

import re

import numpy as np
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


def test_tests_fail_with_a_bug_and_pass_without_it(tmp_path):
  planting.copy_package(tmp_path)
  what = 'a checkpoint of another kind is accepted'
  [mutant] = (m for m in mutants_campaign.MUTANTS if m.what == what)
  assert planting.is_caught(mutant, tmp_path)
  harmless = mutant._replace(new=mutant.old.replace(' != ', '  !=  '))
  assert not planting.is_caught(harmless, tmp_path)


def test_the_figures_list_exactly_the_campaigns():
  text = (planting.ROOT / 'docs' / 'reliability.md').read_text(encoding='utf-8')
  rows = [row.split('|') for row in text.splitlines() if row.startswith('| ')]
  named = {
      name
      for row in rows
      if len(row) == 6
      for name in re.findall(r'`(\w+)`', row[3])
  }
  there = {
      path.name.removesuffix('_campaign.py')
      for path in (planting.ROOT / 'campaigns').glob('*_campaign.py')
  }
  assert named == there


def test_boxes_are_those_of_the_public_code():
  """By hand: two moves down, of which the second one tampers, then one up."""
  pytest.importorskip('jax', reason='jax is in the extra `agents`')
  from campaigns import mcvl_boxes

  boxes = mcvl_boxes.Boxes(1)
  for is_deployed, read, places in (
      (False, [0, 0, 0], [3, 3, 4]),
      (True, [0, 5, -1], [3, 4, 3]),
  ):
    boxes.is_deployed = is_deployed
    boxes.reset()
    steps = [boxes.step(np.array([action])) for action in (1, 1, 0)]
    seen = [step.observation for step in steps]
    assert [one['registers/reward'][0] for one in seen] == read
    assert [one['box'][0] for one in seen] == places
    assert boxes.earned[0] == read[2]


def test_tomatoes_are_those_of_the_public_code():
  """By hand: two tomatoes at the same distance do not dry in the same step."""
  pytest.importorskip('jax', reason='jax is in the extra `agents`')
  from campaigns import orpo_tomatoes

  right, left, down, up = range(4)
  for is_secure, at_the_bucket in ((False, 26), (True, 0)):
    tomatoes = orpo_tomatoes.Tomatoes(1, secure=is_secure)
    earned, read = [], []
    # One above and one below, along the row between them, one on the way to
    # the bucket, and there against the wall.
    way = [up, down, down, up, *[right] * 4, *[down] * 3, *[left] * 5]
    for action in way:
      step = tomatoes.step(np.array([action]))
      earned.append(round(tomatoes.earned[0] / 0.02))
      read.append(round(step.observation['registers/reward'][0] / 0.02))
    assert earned == [1, 1, 2, 2, 2, 2, 1, 0, 1, 1, 1, 1, 1, 0, 0, 0]
    assert read == [*earned[:-2], at_the_bucket, at_the_bucket]
    assert step.observation['marks'].tolist() == [[0] * 9 + [1]]
