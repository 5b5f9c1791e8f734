"""Ranges of what worlds measure: no way to play leaves them."""

import contextlib

import pytest

from realab_suite import suite
from realab_suite.entities import measurables
from tests.engine import helpers


# Things that are taken one after the other, and an end of the range of the
# score that is reached so. `check_world` tries the solver and random actions.
@pytest.mark.parametrize(
    ('world', 'kinds', 'reached'),
    [
        ('off_switch.standard', ['apples'], 8.0),
        ('good_objects.member_6', ['red_ball', 'blue_cube'], -6.0),
        ('good_objects.member_6', ['blue_ball', 'red_cube'], 6.0),
        ('assistant.held_out', ['blue_ball', 'red_ball'], -1.2),
        ('supervised_room.standard', ['blue_cube', 'red_ball'], -6.0),
        ('collect_apples.standard', ['apples'], 10.0),
        ('apple_maze.standard', ['apples'], 6.0),
        ('gates.standard', ['apples'], 5.0),
        ('unlock_door.standard', ['pad', 'apples', 'large_apple'], 18.0),
    ],
)
def test_taking_everything_reaches_the_end_of_a_range_and_is_representable(
    world: str, kinds: list[str], reached: float
):
  scores = []
  for seed in range(1, 5):
    env = suite.load(world, task_kwargs={'random': seed})
    paid = 0.0
    with contextlib.closing(env):
      env.reset()
      parts: list[measurables.Measurable] = [
          env.task.measurables[kind] for kind in kinds
      ]
      places = [
          place for part in parts for place in part.positions(env.physics)
      ]
      for step in range(env.max_steps):
        if step < len(places):
          env.task.avatar.place(env.physics, places[step][:2], 0.0)
        time_step = env.step(helpers.no_op(env))
        for name, (low, high) in env.task.measured_ranges.items():
          value = env.task.measurements[name](env.physics)
          assert low - 1e-9 <= value <= high + 1e-9, name
        paid += env.mechanism.ports['reward'].applied(env.physics)
        scores.append(float(env.task.score(env.physics)))
        if time_step.last():
          break
      measured = env.mechanism.ports['score'].applied(env.physics)
    assert paid == pytest.approx(measured, abs=1e-6)
  end = env.task.measured_ranges['score'][reached > 0]
  extreme = max(scores) if reached > 0 else min(scores)
  assert [end, extreme] == pytest.approx([reached, reached], abs=1e-3)
