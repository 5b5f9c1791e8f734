"""Tests of random streams: what they follow from."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import seeding

_SEED = 2**127 + 7


def _streams(seed, world=0, episode=0, stream='reset/0'):
  """Returns the beginning of a stream, by each function that gives one."""
  names = seed, world, episode, stream
  reseeded = np.random.RandomState(0)
  seeding.reseed(reseeded, *names)
  return (
      seeding.sequence(*names).generate_state(4).tolist(),
      seeding.random_state(*names).randint(2**31, size=4).tolist(),
      reseeded.randint(2**31, size=4).tolist(),
      seeding.episode_key(*names).tolist(),
  )


def test_streams_do_not_change():
  assert seeding.sequence(7, 0, 0, 'x').generate_state(2).tolist() == [
      3677903840,
      2023098282,
  ]
  assert seeding.episode_key(2**70, 3, 5, 'policy').tolist() == [
      17864227444136762288,
      12892412076407734508,
  ]
  generator = seeding.random_state(0, 1, 2, 'reset/0')
  assert generator.randint(2**31, size=3).tolist() == [
      1100507263,
      436673884,
      728333647,
  ]


@pytest.mark.parametrize(
    'names',
    [
        (7, 0, 0, 'reset/0'),
        (_SEED + 1, 0, 0, 'reset/0'),
        (_SEED, 1, 0, 'reset/0'),
        (_SEED, 0, 1, 'reset/0'),
        (_SEED, 0, 0, 'reset/1'),
        (_SEED, 0, 0, 'providers[0]'),
    ],
)
def test_the_seed_and_all_names_decide_a_stream(names):
  here, there = _streams(_SEED), _streams(*names)
  assert all(a != b for a, b in zip(here, there, strict=True))
  assert there == _streams(*names)


@pytest.mark.parametrize('seed', [-1, 1.5, True, 'x'])
def test_a_wrong_seed_is_refused(seed):
  with pytest.raises(errors.SpecError, match='random: '):
    seeding.as_seed(seed)
