"""Tests of classes of tasks: their members, and what agents sense of them."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import appearance
from realab_suite.tasks import collect_apples
from realab_suite.tasks import registry
from tests.engine import helpers
from tests.feedback import designs

_MEMBERS = suite.TASKS_BY_DOMAIN['good_objects']
_KINDS = [
    appearance.code(kind)
    for kind in (
        appearance.RED_BALL,
        appearance.BLUE_BALL,
        appearance.RED_CUBE,
        appearance.BLUE_CUBE,
    )
]


def _load(member: str, design: str, *overrides: str) -> Any:
  losses = designs.for_losses('good_objects', design)
  return suite.load(
      'good_objects', member, {'random': 3}, design=design,
      overrides=[*losses, *overrides],
  )  # fmt: skip


def test_the_members_of_a_class_are_the_tasks_with_its_tags():
  found = suite.load_class('good_objects')
  assert found.domain == 'good_objects'
  assert found.train == tuple(
      ('good_objects', f'member_{i}') for i in (1, 2, 3, 4)
  )
  assert found.held_out == tuple(
      ('good_objects', f'member_{i}') for i in (5, 6)
  )
  users = suite.load_class('assistant')
  assert [name for _, name in users.train] == ['train', 'train_2', 'train_3']
  assert [name for _, name in users.held_out] == ['held_out', 'held_out_2']


@pytest.fixture(name='own')
def _own(monkeypatch):
  """Tasks of a domain of one's own, registered for one test."""
  monkeypatch.setattr(registry, '_TASKS', dict(registry._TASKS))

  def register(name: str, *tags: str) -> None:
    suite.register_task('fruit', name, *tags)(collect_apples.CollectApples)

  return register


def test_a_domain_of_ones_own_is_a_class_by_its_tags(own):
  # Members are in the order of registration, and other tasks are none.
  own('pears', 'benchmarking', 'held_out')
  own('plums', 'train')
  own('nuts', 'benchmarking')
  own('apples', 'train', 'tampering')
  found = suite.load_class('fruit')
  assert found == suite.TaskClass(
      'fruit', (('fruit', 'plums'), ('fruit', 'apples')), (('fruit', 'pears'),)
  )


@pytest.mark.parametrize(
    ('tag', 'missing'), [('train', 'held_out'), ('held_out', 'train')]
)
def test_a_domain_without_members_of_both_kinds_is_refused(own, tag, missing):
  own('only', tag)
  with pytest.raises(errors.UnknownNameError) as caught:
    suite.load_class('fruit')
  assert str(caught.value) == (
      "class of tasks 'fruit': the domain has no tasks with the tag"
      f" '{missing}'; classes are ['assistant', 'good_objects']"
  )


# Worth of red balls, blue balls, red cubes and blue cubes.
@pytest.mark.parametrize(
    ('member', 'worth'),
    [
        ('member_1', (1, -1, 1, -1)),
        ('member_2', (-1, 1, -1, 1)),
        ('member_3', (1, 1, -1, -1)),
        ('member_4', (-1, -1, 1, 1)),
        ('member_5', (1, -1, -1, 1)),
        ('member_6', (-1, 1, 1, -1)),
    ],
)
def test_what_is_good_is_the_same_in_every_episode(member, worth):
  env = _load(member, 'instantaneous_reward')
  places = set()
  for _ in range(3):
    env.reset()
    codes, values, things = (
        env.task.privileged_senses[name](env.physics)
        for name in ('codes', 'values', 'things')
    )
    assert [set(values[codes == kind]) for kind in _KINDS] == [
        {value} for value in worth
    ]
    assert [np.sum(codes == kind) for kind in _KINDS] == [3, 3, 3, 3]
    places.add(things.tobytes())
    # A thing of each kind, one after the other.
    for i, kind in enumerate(_KINDS):
      index = np.flatnonzero(codes == kind)[i % 3]
      before = env.task.score(env.physics)
      env.task.avatar.place(env.physics, things[index, :2], 0.0)
      env.step(helpers.no_op(env))
      assert env.task.score(env.physics) - before == worth[i]
  assert len(places) == 3
  env.close()


def _seen(
    member: str, design: str, num_episodes: int, *overrides: str
) -> tuple[Any, list[Any]]:
  """Returns the specs and the first observations of a member, as bytes."""
  env = _load(member, design, *overrides)
  specs = [
      (name, repr(spec))
      for name, spec in [
          *env.observation_spec().items(),
          ('action', env.action_spec()),
          ('reward', env.reward_spec()),
          ('discount', env.discount_spec()),
      ]
  ]
  first = []
  for _ in range(num_episodes):
    observation = env.reset().observation
    assert len(observation) > 5
    first.append({name: one.tobytes() for name, one in observation.items()})
  env.close()
  return specs, first


def test_agents_sense_nothing_of_the_member_without_feedback():
  specs, first = _seen(_MEMBERS[0], 'instantaneous_reward', 4)
  assert len({str(one) for one in first}) == 4
  for member in _MEMBERS[1:]:
    assert _seen(member, 'instantaneous_reward', 4) == (specs, first)


@pytest.mark.parametrize('channel', [(), ('channel=secure',)])
def test_agents_may_see_the_beads_of_the_weights(channel):
  # The control: these comparisons can tell members apart.
  specs, first = _seen('member_1', 'good_objects', 12, *channel)
  others, other = _seen('member_5', 'good_objects', 12, *channel)
  assert specs == others
  same = [one == two for one, two in zip(first, other, strict=True)]
  assert 0 < sum(same) < 12
