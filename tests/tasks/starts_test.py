"""Starts of training: on the way, beside a register, or ordinary."""

import collections
import contextlib
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.tasks import starts

_ALL = [[0, 0.5, 1.0]]
# Every crate is the base block of a register.
_COUPLED = [f'registers.tidy_{i}.place=crate_{i}' for i in range(1, 5)]


def _load(domain: str = 'gates', overrides: Any = (), **kwargs: Any) -> Any:
  design = domain if domain == 'tidy_up' else 'instantaneous_reward'
  return contextlib.closing(
      suite.load(
          domain, 'standard', {'random': 3, **kwargs}, design=design,
          overrides=overrides,
      )
  )  # fmt: skip


def _crates(env: Any) -> np.ndarray:
  number = 4 if hasattr(env.task, '_crates') else 1
  return np.array(env.task._positions(env.physics))[:number]


def _starts(env: Any, number: int = 40) -> list[tuple[bytes, bytes]]:
  """Returns where crates and the avatar are when episodes begin."""
  places = []
  for _ in range(number):
    env.reset()
    avatar = env.task.avatar.position(env.physics)
    places.append((_crates(env).tobytes(), avatar.tobytes()))
  return places


def test_one_draw_decides_how_an_episode_begins():
  with _load() as env:
    ordinary = _starts(env)
  shares = {'starts_beside_registers': 0.5, 'starts_on_the_way': [[0, 0, 0.5]]}
  kinds = collections.Counter[str]()
  with _load(**shares) as env:
    for one, usual in zip(_starts(env), ordinary, strict=True):
      moved = one[0] != usual[0], one[1] != usual[1]
      kinds['ahead' if moved[0] else 'beside' if moved[1] else 'usual'] += 1
  # Of 40 episodes; three standard errors are 10. One is usual only where the
  # places beside a register that were drawn are all taken.
  assert abs(kinds['ahead'] - 20) < 10
  assert kinds['usual'] <= 2


def test_distance_and_share_depend_on_the_step_of_training_alone():
  schedule = starts.checked_schedule([[10, 0, 0.8], [20, 1, 0.8], [40, 1, 0]])
  expected = {0: (0, 0.8), 15: (0.5, 0.8), 30: (1, 0.4), 99: (1, 0)}
  for step, (distance, share) in expected.items():
    assert schedule.at(step) == pytest.approx((distance, share))
  with _load() as env:
    ordinary = _starts(env, 5)
  with _load(starts_on_the_way=[[0, 0, 1], [100, 0, 0]]) as env:
    assert not {*_starts(env, 5)} & {*ordinary}
    env.task.training_step = 100
    env.rewind()
    assert _starts(env, 5) == ordinary


@pytest.mark.parametrize(
    ('domain', 'goals', 'least', 'more'),
    [
        ('gates', [(-2.4, 3.2), (2.4, 3.2)], 0.0, None),
        ('tidy_up', [(-1.4, y) for y in (0.3, 1.3, 2.3, 3.3)], 0.37, 2.2),
    ],
)
def test_one_crate_is_as_far_from_its_goal_as_the_schedule_says(
    domain: str, goals: Any, least: float, more: float | None
):
  held = 0
  with _load(domain) as env:
    env.reset()
    usual = np.linalg.norm(_crates(env) - goals, axis=1)
  for distance in (0.0, 0.5, 1.0):
    schedule = [[0, distance, 1.0]]
    with _load(domain, starts_on_the_way=schedule) as env:
      for episode in range(16):
        env.reset()
        gaps = np.linalg.norm(_crates(env) - goals, axis=1)
        if more:
          assert np.abs(gaps - least - distance * more).min() < 1e-6
        elif not episode:
          assert np.abs(gaps - distance * usual).min() < 1e-6
        holds = env.task.avatar.holding(env.physics)[0] > 0
        held += holds
        if holds:
          # It is in the hand, and follows.
          position = env.task.avatar.position(env.physics)
          hand = np.linalg.norm(_crates(env) - position, axis=1).min()
          assert hand == pytest.approx(0.45, abs=1e-6)
  # A third of 16 different episodes, each at three distances.
  assert 3 <= held <= 33


def test_a_start_with_nothing_left_to_do_is_at_the_plate_or_before_the_gate():
  places = []
  with _load(starts_on_the_way=[[0, 0, 1]]) as env:
    for _ in range(20):
      env.reset()
      places.append(env.task.avatar.position(env.physics))
  plates, gates = [(-2.4, 3.2), (2.4, 3.2)], [(-3.4, 1.6), (3.4, 1.6)]
  near = [
      [np.linalg.norm(np.subtract(p, spot), axis=-1).min() for p in places]
      for spot in (plates, gates)
  ]
  is_before_gate = np.array(near[1]) < 1e-6
  assert 0 < is_before_gate.sum() < 20
  assert (np.array(near[0])[~is_before_gate] < 1.3).all()


def test_a_crate_that_is_a_block_begins_there_without_corruption():
  with _load('tidy_up', _COUPLED, starts_on_the_way=_ALL) as env:
    for _ in range(6):
      env.reset()
      for register in env.mechanism.registers.values():
        one = register.inspect(env.physics)
        assert one.permanent == pytest.approx(0, abs=1e-9)
        assert one.temporary == pytest.approx(0, abs=1e-9)


def test_worlds_of_a_batch_begin_as_single_ones_do():
  kwargs = {'random': 3, 'starts_on_the_way': [[0, 0, 0], [8, 1, 1]]}
  with contextlib.closing(
      suite.load_batch('gates', 'standard', kwargs, num_envs=5, num_threads=1)
  ) as batch:
    batch.task.training_step = 6
    batch.reset()
    crates = np.array(batch.task._positions(batch.physics))[:, :1]
    holds = batch.task.avatar.holding(batch.physics)
  for world in range(5):
    with contextlib.closing(
        suite.load('gates', 'standard', kwargs, {'world': world})
    ) as env:
      env.task.training_step = 6
      env.reset()
      np.testing.assert_array_equal(_crates(env), crates[world])
      held = env.task.avatar.holding(env.physics)
      np.testing.assert_array_equal(held, holds[world])


@pytest.mark.parametrize(
    ('domain', 'kwargs', 'message'),
    [
        ('hidden_goal', {}, r'share 1; must be 0, because this world has none'),
        ('gates', {'starts_beside_registers': 0.3}, 'must be at most 0.7,'),
        ('gates', {'starts_on_the_way': [[0, 0, 1.5]]}, 'must be a list'),
        ('gates', {'starts_on_the_way': [[5, 0, 1], [5, 0, 1]]}, 'must be a l'),
        ('gates', {'starts_on_the_way': [[0, 0]]}, 'must be a list'),
        ('gates', {'starts_on_the_way': [[float('inf'), 0, 1]]}, 'must be a'),
        ('gates', {'starts_on_the_way': [[0, 0, True]]}, 'must be a list'),
        ('gates', {'starts_on_the_way': [['0', 0, 1]]}, 'must be a list'),
        ('gates', {'starts_on_the_way': []}, 'must be a list'),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(
    domain: str, kwargs: Any, message: str
):
  with pytest.raises(errors.SpecError, match=f'starts_on_the_way: .*{message}'):
    suite.load(domain, 'standard', {'starts_on_the_way': _ALL, **kwargs})
