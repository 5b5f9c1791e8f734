"""Tests of random streams: what they follow from, and what a salt changes."""

import copy
import json
import logging

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import forking
from realab_suite.engine import seeding

_SALT = bytes(range(seeding.NUM_SALT_BYTES))
_OTHER_SALT = bytes([*_SALT[:-1], _SALT[-1] ^ 1])
_SALTED = seeding.SaltedSeed(7, _SALT)
_WORLD = 'unlock_door', 'standard'


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


def test_streams_without_a_salt_do_not_change():
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


def test_streams_with_a_salt_do_not_change():
  # Runs are repeated by their salt.
  assert seeding.episode_key(_SALTED, 3, 5, 'policy').tolist() == [
      3044171645842236865,
      1710624450426912569,
  ]


@pytest.mark.parametrize(
    'names',
    [
        (7, 0, 0, 'reset/0'),
        (seeding.SaltedSeed(7, _OTHER_SALT), 0, 0, 'reset/0'),
        (seeding.SaltedSeed(8, _SALT), 0, 0, 'reset/0'),
        (_SALTED, 1, 0, 'reset/0'),
        (_SALTED, 0, 1, 'reset/0'),
        (_SALTED, 0, 0, 'reset/1'),
        (_SALTED, 0, 0, 'providers[0]'),
        # Numbers that read the same one after the other.
        (seeding.SaltedSeed(70, _SALT), 0, 0, 'reset/0'),
        (_SALTED, 0, 0, '0,reset/0'),
    ],
)
def test_a_salt_and_all_names_decide_a_stream(names):
  here, there = _streams(_SALTED), _streams(*names)
  assert all(a != b for a, b in zip(here, there, strict=True))
  assert there == _streams(*names)


def test_large_seeds_take_a_salt():
  seeds = [seeding.SaltedSeed(2**i, _SALT) for i in (31, 32, 63, 64, 128)]
  assert len({_streams(seed)[0][0] for seed in seeds}) == len(seeds)


def test_a_salted_seed_is_the_number_wherever_it_is_written(caplog):
  text = json.dumps({'seed': _SALTED}) + f'{_SALTED} {_SALTED!r}'
  logging.getLogger().error('%s %r', _SALTED, {'seed': _SALTED})
  assert text == '{"seed": 7}7 7'
  assert caplog.messages == ["7 {'seed': 7}"]


def test_a_digest_tells_salts_apart():
  other = seeding.SaltedSeed(7, _OTHER_SALT)
  assert _SALTED.salt_digest != other.salt_digest
  assert _SALTED.salt_digest == seeding.SaltedSeed(8, _SALT).salt_digest
  assert len(_SALTED.salt_digest) == 16


@pytest.mark.parametrize('copied', [copy.copy, copy.deepcopy])
def test_copies_keep_the_salt(copied):
  found = copied({'seed': _SALTED})['seed']
  assert (found, found.salt) == (7, _SALT)


@pytest.mark.parametrize(
    'salt',
    [None, '0123456789abcdef', b'', b'secret', bytes(17), bytearray(16), 5],
)
def test_a_wrong_salt_is_refused_without_repeating_it(salt):
  with pytest.raises(errors.SpecError, match=r'salt: .*16 bytes') as caught:
    seeding.SaltedSeed(7, salt)
  assert 'secret' not in str(caught.value)
  assert '0123' not in str(caught.value)


@pytest.mark.parametrize('seed', [-1, 1.5, True, 'x'])
def test_a_salted_seed_is_a_seed(seed):
  with pytest.raises(errors.SpecError, match='random: '):
    seeding.SaltedSeed(seed, _SALT)


# Environments.


def _first(seed, **kwargs):
  env = suite.load(*_WORLD, {'random': seed}, **kwargs)
  observation = env.reset().observation
  env.close()
  return {name: value.tobytes() for name, value in observation.items()}


def test_an_environment_begins_by_its_salt():
  first = _first(_SALTED)
  assert first == _first(seeding.SaltedSeed(7, _SALT))
  assert first != _first(7)
  assert first != _first(seeding.SaltedSeed(7, _OTHER_SALT))


def test_every_world_of_a_batch_and_of_a_fork_has_the_salt():
  with_salt = {'random': _SALTED}
  batch = suite.load_batch(*_WORLD, with_salt, num_envs=3)
  single = suite.load(*_WORLD, with_salt)
  forks = [
      suite.fork(batch, 2, world=1),
      suite.fork(single, 2),
      forking.fork(suite.fork(single, 2), 2, world=0),
  ]
  for seeds in (batch._seeds, *(fork._seeds for fork in forks)):
    assert [seed.salt for seed in seeds] == [_SALT] * len(seeds)
  first = batch.reset()
  for world in range(3):
    alone = _first(_SALTED, environment_kwargs={'world': world})
    found = {k: v[world].tobytes() for k, v in first.observation.items()}
    assert found == alone
