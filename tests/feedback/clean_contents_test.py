"""Clean contents, worked out by hand, in each kind of environment.

In step k, the meter `clock` measures k - 1.
"""

import pytest

from tests.feedback import tampered
from tests.feedback.tampered import Move

_every_host = pytest.mark.parametrize('host', tampered.HOSTS)


@pytest.fixture(scope='module', name='world_of')
def fixture_world_of():
  with tampered.worlds() as get:
    yield get


def _adding(reads, writes, **options):
  return {'kind': 'test_adding', 'reads': list(reads), 'writes': [writes],
          **options}  # fmt: skip


def _close(values, atol=1e-6):
  return pytest.approx(list(values), rel=0, abs=atol)


_DIFFERENCE = {'kind': 'difference', 'reads': ['clock'], 'writes': ['reward']}
_REWARD = {'reward': tampered.register('feedback')}
_GATED = {**_REWARD, 'gate': tampered.register('memory')}
_GATE = _adding(['clock', 'gate'], 'reward', gate='gate')
_CASES = {
    # The growth of 0, 1, 2, 3 + 10, 4 + 10: a spike, once.
    'difference': (
        tampered.design(_REWARD, _DIFFERENCE),
        [Move(4, 'clock', 10.0)],
        [0, 1, 1, 11, 1],
        [0, 1, 1, 1, 1],
    ),
    # 0, 1, 3, 6 and 10 without the 10 of two steps; the block then returns, but
    # the state remembers.
    'sum': (
        tampered.design(
            _REWARD,
            {'kind': 'test_summing', 'reads': ['clock'], 'writes': ['reward']},
        ),
        [Move(2, 'clock', 10.0), Move(4, 'clock', -10.0)],
        [0, 11, 23, 26, 30],
        [0, 1, 3, 6, 10],
    ),
    # It acts in steps 1 and 4, and so does its clean call.
    'every third step': (
        tampered.design(_REWARD, {**_DIFFERENCE, 'every': 3}),
        [Move(2, 'clock', 10.0), Move(5, 'clock', -10.0)],
        [0, 0, 0, 13, 13],
        [0, 0, 0, 3, 3],
    ),
    # Both act before the first substep.
    'cfmdp': (
        tampered.design(
            _REWARD, _adding(['clock'], 'reward'), schedule='cfmdp'
        ),
        [Move(3, 'clock', 10.0)],
        [0, 1, 12, 13, 14],
        [0, 1, 2, 3, 4],
    ),
    # The gate shuts: the actual provider is silent, the clean one is not.
    'silence': (
        tampered.design(_GATED, _GATE),
        [Move(3, 'gate', 10.0), Move(5, 'gate', -10.0)],
        [0, 1, 1, 1, 4],
        [0, 1, 2, 3, 4],
    ),
    # The gate opens: the clean provider is silent, the actual one is not.
    'clean silence': (
        tampered.design(
            {**_GATED, 'gate': tampered.register('memory', initial=10.0)},
            _GATE,
        ),
        [Move(3, 'gate', -10.0), Move(5, 'gate', 10.0)],
        [0, 0, 2, 3, 3],
        [0, 0, 0, 0, 0],
    ),
    # What the agent saw is a step old: 0, then twice 0, 1 + 0, 2 + 1 + 0 ...
    'observation': (
        tampered.design(
            _REWARD, _adding(['clock'], 'reward', seen=('reward',))
        ),
        [Move(3, 'reward', 10.0)],
        [0, 1, 3 + 10, 6 + 20, 10 + 30],
        [0, 1, 3, 6, 10],
    ),
    # A provider that reads its own register launders a push: 0 + 10 is written,
    # and read as 20 because of the base block; then 20 + 1 + 2 + 10 ...
    'own register': (
        tampered.design(
            _REWARD, _adding(['clock', 'reward'], 'reward')
        ),
        [Move(2, 'reward', 10.0)],
        [0, 21, 33, 46],
        [0, 1, 3, 6],
    ),
    # The range ends at 2 from the left, and from the right at 6.
    'saturation at both ends': (
        tampered.design(
            {'reward': tampered.register('feedback', range=[2, 6],
                                         initial=3)},
            _adding(['clock'], 'reward'),
        ),
        [Move(3, 'clock', -20.0), Move(5, 'clock', 40.0)],
        [2, 2, 2, 2, 6],
        [2, 2, 2, 3, 4],
    ),
    'saturation of the clean content alone': (
        tampered.design(
            {'reward': tampered.register('feedback', range=[0, 2])},
            _adding(['clock'], 'reward'),
        ),
        [Move(4, 'clock', -2.0)],
        [0, 1, 2, 1, 2],
        [0, 1, 2, 2, 2],
    ),
    # A value out of range would be an error; as a clean content it saturates.
    # The honest worlds of a batch would fail, so it is for one world.
    'no saturation': (
        tampered.design(
            {'reward': tampered.register('feedback', range=[0, 2],
                                         on_overflow='error')},
            _adding(['clock'], 'reward'),
        ),
        [Move(4, 'clock', -3.0)],
        [0, 1, 2, 0, 1],
        [0, 1, 2, 2, 2],
    ),
    # The blocks of a secure register are scenery.
    'secure input': (
        tampered.design(
            {**_REWARD, 'gate': tampered.register('memory', channel='secure')},
            _adding(['clock', 'gate'], 'reward'),
        ),
        [Move(2, 'gate', 10.0)],
        [0, 1, 2, 3, 4],
        [0, 1, 2, 3, 4],
    ),
}  # fmt: skip


@_every_host
@pytest.mark.parametrize('name', _CASES)
def test_clean_contents_by_hand(world_of, host, name):
  design, moves, readings, clean = _CASES[name]
  if (host, name) == ('batch', 'no saturation'):
    return
  found = world_of(host, design).run(moves, len(readings), 'reward')['reward']
  assert found == (_close(readings), _close(clean))
