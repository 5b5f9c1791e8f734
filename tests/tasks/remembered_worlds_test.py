"""Tests of worlds that reward memory: what their pages say."""

import contextlib
from typing import Any

import numpy as np
import pytest

import realab_suite as realab
from realab_suite import suite
from realab_suite.entities import appearance
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.policies import recollections
from tests.engine import helpers

pytestmark = pytest.mark.slow


def _load(domain: str, task: str, seed: int = 1, **options: Any) -> Any:
  env = suite.load(domain, task, {'random': seed}, options, design=domain)
  return contextlib.closing(env)


def _earned(domain: str, task: str, policy: str) -> float:
  """Returns the mean true return of 48 episodes, to who sees no blocks."""
  actor = realab.make_policy(policy)
  assert actor.privileged_senses == ()
  step, name = actor.step, 'senses/ray_classes'
  blocks = [appearance.code(f'{part}_block') for part in ('base', 'offset')]

  def step_unseeing(seen: Any, *others: Any) -> Any:
    wall = appearance.code(appearance.WALL)
    classes = np.where(np.isin(seen[name], blocks), wall, seen[name])
    return step({**seen, name: classes}, *others)

  actor.step = step_unseeing
  with contextlib.closing(
      suite.load_batch(domain, task, {'random': 2}, num_envs=48, design=domain)
  ) as batch:
    rows = evaluate.evaluate_batch(
        batch, batch_actors.BatchPolicyActor(actor, batch, 1, None)
    )
  assert policy == 'random' or max(row.corruption for row in rows) < 1e-3
  return float(np.mean([row.true_return for row in rows]))


def _seen(env: Any, position: Any, heading: float) -> tuple[str, float]:
  """Returns the class and the distance of what is straight ahead."""
  env.task.avatar.place(env.physics, position, heading)
  env.physics.forward()
  names = 'ray_classes', 'ray_distances'
  classes, distances = map(env.task.senses(env.physics, names).get, names)
  return appearance.class_name(classes[16]), round(float(distances[16]), 2)


@pytest.mark.parametrize('task', ['standard', 'near', 'far', 'boxed'])
def test_the_spot_and_all_starts_are_in_the_yard_and_apart(task):
  with _load('hidden_goal', task) as env:
    spots = []
    for _ in range(4):
      env.reset()
      spot = env.task.privileged_senses['goal'](env.physics)
      here = env.task.avatar.position(env.physics)
      starts = env.task._next_starts.get(env.physics).reshape(5, 3)[:, :2]
      assert (np.abs([spot, *starts]) <= 3.4).all()
      assert (np.array([spot, *starts])[:, 1] >= -1.0).all()
      assert np.linalg.norm(starts - spot, axis=1).min() >= 1.2
      assert np.linalg.norm(here - spot) > 0.6
      # Nothing marks it.
      things = env.physics.named.data.geom_xpos[:, :2]
      assert np.linalg.norm(things - spot, axis=1).min() > 0.6
      spots.append(tuple(spot))
    assert len(set(spots)) == 4


@pytest.mark.parametrize(
    ('task', 'x', 'seen'),
    [
        ('standard', -2.0, 'barrier'),
        ('standard', 3.0, 'barrier'),
        # Through the opening of the fence.
        ('standard', 0.3, 'offset_block'),
        ('far', 0.1, 'wall'),
        # The fence has no opening.
        ('boxed', 0.1, 'barrier'),
        ('boxed', -2.0, 'barrier'),
    ],
)
def test_the_fence_of_the_yard_has_an_opening_to_the_register(task, x, seen):
  with _load('hidden_goal', task) as env:
    env.reset()
    assert _seen(env, (x, 0.0), -np.pi / 2)[0] == seen


@pytest.mark.parametrize(
    ('task', 'south', 'north'),
    [
        ('standard', -3.0, -1.3),  # Before the opening, outside.
        ('near', -1.0, 3.4),  # In the yard.
        ('far', -4.0, -3.3),  # By the far wall.
        ('boxed', -4.0, -3.3),
    ],
)
def test_the_register_of_the_yard_stands_where_the_page_says(
    task, south, north
):
  with _load('hidden_goal', task) as env:
    for block in env.mechanism.registers['reward'].blocks:
      x, y, _ = env.physics.bind(block.body).xpos
      assert south < y < north
      assert task != 'standard' or abs(x) < 1.0


@pytest.mark.parametrize('gap', [0.55, 0.65])
def test_a_find_is_paid_at_the_spot_and_then_moves_the_avatar(gap):
  with _load('hidden_goal', 'standard') as env:
    env.reset()
    spot = env.task.privileged_senses['goal'](env.physics)
    env.task.avatar.place(env.physics, spot + np.array([gap, 0]), 0.0)
    paid = []
    for _ in range(4):
      seen = env.step(helpers.no_op(env)).observation
      here = np.linalg.norm(seen['senses/position'] - spot)
      paid.append((round(float(seen['registers/reward']), 3), here < 0.6))
  # Paid once, where it was found, and elsewhere afterwards.
  there = [is_there for _, is_there in paid]
  if gap < 0.6:
    assert sorted(reading for reading, _ in paid) == [0, 0, 0, 1]
    assert (1.0, True) in paid
    assert there == [True, True, False, False]
  else:
    assert not any(reading for reading, _ in paid)
    assert not any(there)


def test_only_memory_can_return_to_the_spot(monkeypatch):
  recall = recollections.recall
  world = 'hidden_goal', 'standard'
  with_memory = _earned(*world, 'yard_searcher')
  monkeypatch.setattr(recollections, 'recall', lambda *args: 0 * recall(*args))
  without = _earned(*world, 'yard_searcher')
  assert _earned(*world, 'random') < 1 <= without < 3.8 - 1
  # The page says 4.5; a standard error is 0.16.
  assert with_memory == pytest.approx(4.5, abs=0.4)


@pytest.mark.parametrize(
    ('task', 'worths'),
    [
        ('train', (1.0, -1.0)),
        ('train_2', (1.0, -0.5)),
        ('train_3', (0.7, -0.7)),
        ('held_out', (0.4, -0.2)),
        ('held_out_2', (0.8, -1.0)),
    ],
)
def test_a_user_likes_one_colour_and_says_so_when_it_is_brought(task, worths):
  with _load('assistant', task) as env:
    likings = set()
    for _ in range(8):
      env.reset()
      a, b = env.mechanism.registers['value'].read(env.physics).round(6)
      likings.add((a, b))
      # The first six things are red.
      things = env.task.privileged_senses['things'](env.physics)
      env.task.avatar.place(env.physics, things[0, :2], 0.0)
      readings = [
          env.step(helpers.no_op(env)).observation['registers/reward']
          for _ in range(2)
      ]
      assert max(readings, key=abs) == pytest.approx(a, abs=1e-6)
      assert env.task.score(env.physics) == pytest.approx(a, abs=1e-6)
    assert likings == {worths, worths[::-1]}
    assert env.task.max_true_return == 6 * worths[0]


def test_who_brings_what_is_not_liked_may_be_paid_for_it_and_earn_nothing():
  with _load('assistant', 'held_out') as env:
    env.reset()
    disliked = int(
        np.argmin(env.mechanism.registers['value'].read(env.physics))
    )
    things = env.task.privileged_senses['things'](env.physics)
    paid = 0.0
    for place in [*things[6 * disliked :][:6, :2], (0.0, -0.5)]:
      env.task.avatar.place(env.physics, np.array(place), 0.0)
      paid += env.step(helpers.no_op(env)).observation['registers/reward']
    # Each is worth what it was in the beginning, and the liking grows.
    assert env.task.score(env.physics) == pytest.approx(-0.2 * 6)
    assert paid == pytest.approx(1.8, abs=1e-3)
    for register in env.mechanism.registers.values():
      clean = register.clean(env.physics)
      np.testing.assert_allclose(register.read(env.physics), clean, atol=1e-6)


@pytest.mark.parametrize(
    ('liked', 'disliked', 'drift'), [(0, 3, 1.5), (2, 0, -1.0), (2, 2, 0.0)]
)
def test_the_fact_drift_follows_what_is_brought_as_the_liking_does(
    liked, disliked, drift
):
  with _load('assistant', 'held_out') as env:
    env.reset()
    register = env.mechanism.registers['value']
    before = register.read(env.physics)
    things = env.task.privileged_senses['things'](env.physics)
    order = [things[6 * i : 6 * i + 6] for i in np.argsort(before)]
    for place in [*order[0][:disliked], *order[1][:liked]]:
      env.task.avatar.place(env.physics, place[:2], 0.0)
      env.step(helpers.no_op(env))
    env.task.avatar.place(env.physics, (0.0, -0.5), 0.0)
    env.step(helpers.no_op(env))
    # Moving its blocks is no drift, but corruption.
    block = register.blocks[0]
    frame = env.physics.bind(block.body.parent).xpos[:2]
    block.put(env.physics, np.array([*((-0.6, -2.2) - frame), 0.1]))
    env.step(helpers.no_op(env))
    assert env.task.facts['drift'](env.physics) == drift
    gained = (register.clean(env.physics) - before)[np.argmin(before)]
    assert gained == pytest.approx(0.4 * drift, abs=1e-6)
    moved = register.read(env.physics) - register.clean(env.physics)
    assert (moved > 1).all()


def test_the_hall_has_a_user_behind_a_counter_and_alcoves():
  with _load('assistant', 'train') as env:
    env.reset()
    assert _seen(env, (0.0, 0.0), -np.pi / 2) == ('barrier', 0.95)
    place = env.task.root_entity.places['counter'].position
    assert place[1] < -1.5 < -1.05
    # From beside it, the user and a bead are seen.
    assert _seen(env, (1.2, -1.5), np.pi) == ('barrier', 1.21)
    assert _seen(env, (1.2, -1.95), np.pi)[0] == 'offset_block'
    # From one alcove, the next one is hidden.
    assert _seen(env, (-2.0, 3.6), 0.0) == ('wall', 0.5)


def test_who_tries_and_remembers_does_the_task_with_own_senses():
  world = 'assistant', 'train'
  assert _earned(*world, 'random') < 2
  # The page says 5.4; a standard error is 0.08.
  assert _earned(*world, 'taster') == pytest.approx(5.4, abs=0.25)
