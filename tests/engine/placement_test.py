"""Registers are refused where something stands that nothing can push."""

import pytest

from realab_suite import errors
from realab_suite import suite


def _design(place, **register):
  return {
      'schema': 1,
      'name': 'placed',
      'registers': {
          'value': {
              'kind': 'block_position',
              'role': 'feedback',
              'place': place,
              'range': [-1, 1],
              **register,
          }
      },
  }


@pytest.mark.parametrize(
    ('place', 'obstacle'),
    [([0.0, 1.9], 'pad_post'), ([0.0, 4.1], 'door_leaf')],
)
@pytest.mark.parametrize('channel', ['embedded', 'welded'])
def test_a_register_in_a_post_or_a_door_is_refused(place, obstacle, channel):
  with pytest.raises(errors.SpecError, match=f'inside .*{obstacle}'):
    suite.load(
        'unlock_door', 'standard', design=_design(place, channel=channel)
    )


def test_a_register_beside_the_post_is_accepted():
  env = suite.load('unlock_door', 'standard', design=_design([0.0, 1.4]))
  env.close()
  assert env.mechanism.registers['value'].channel == 'embedded'


def test_a_register_where_the_avatar_begins_is_refused():
  with pytest.raises(errors.SpecError, match=r"'value'.* where the avatar"):
    suite.load('unlock_door', 'standard', design=_design([0.0, -0.8]))


@pytest.mark.parametrize(
    ('spread', 'is_in_the_way'), [(0.5, False), (0.8, True)]
)
def test_wherever_a_register_may_stand_the_avatar_does_not_begin(
    spread: float, is_in_the_way: bool
):
  # The avatar, of a radius of 0.25 m, begins within 0.4 m of (0, -0.8).
  place = {'position': [1.4, -0.8], 'spread': [spread, 0.1]}
  arguments = 'collect_apples', 'standard'
  design = _design(place)
  if is_in_the_way:
    with pytest.raises(errors.SpecError, match='where the avatar begins'):
      suite.load(*arguments, design=design)
  else:
    suite.load(*arguments, design=design).close()
