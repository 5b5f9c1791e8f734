"""Tests of the program `stake`."""

import pytest

from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import judging
from realab_suite.launchers import stake
from tests.lab.experiments import small
from tests.launchers import in_process

_SHORT = ('--task=near', '--max_steps=15', '--set=dof=planar')


@pytest.fixture(autouse=True)
def fixture_quick_stakes():
  with small.quick_stakes():
    yield


def test_the_stakes_of_a_design_are_printed():
  ended = in_process.run(stake, *_SHORT)
  assert (ended.status, ended.stderr) == (0, '')
  found = judging.stakes_of(
      worlds.World('unlock_door', 'near', 15),
      specs.load('instantaneous_reward', ['dof=planar']),
  )
  header, _, whole, discounted, _, origin = ended.stdout.splitlines()
  assert [cell.strip() for cell in header.split('|')[1:-1]] == [
      'part of the objective', 'stake', 'more than', 'degenerate',
      'confirmed',
  ]  # fmt: skip
  for line, name in ((whole, 'return'), (discounted, 'discounted return')):
    one = found.parts[name]
    assert [cell.strip() for cell in line.split('|')[1:-1]] == [
        name,
        f'{one.estimate:.4g} [{one.low:.4g}, {one.high:.4g}]',
        one.than,
        'no',
        'yes' if one.is_confirmed else 'no',
    ]
  # The reference task of the domain, whatever the task is.
  assert 'unlock_door.standard' in origin
  assert 'confirmed in unlock_door.near' in origin
  assert origin.endswith(f'key {found.key}')


def test_a_provider_whose_clean_values_saturate_is_told_of():
  # Each apple is worth 1.
  narrow = '--set=registers.reward.range=[-0.5, 0.5]'
  ended = in_process.run(stake, *_SHORT, '--max_steps=60', narrow)
  assert (ended.status, ended.stderr) == (0, '')
  line = ended.stdout.splitlines()[-1]
  assert line.startswith("* clean values of 'reward' are beyond its range in ")
  assert line.endswith(' episodes of the twin')


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('--design=none',), "design 'none' has no stake: the design has no"),
        (('--target=reward',), "Unknown command line flag 'target'"),
    ],
)
def test_a_design_without_stakes_is_refused_in_one_line(arguments, text):
  assert text in in_process.complaint(stake, *arguments)
