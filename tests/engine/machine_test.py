"""Campaign C28 in small, and that it can fail."""

from collections.abc import Callable
from typing import Any

from dm_control.rl import control
import dm_env
import pytest

from campaigns import machine_campaign
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers

pytestmark = pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')


def test_whatever_order_things_happen_in_an_environment_stays_whole():
  machine_campaign.COUNTS.clear()
  assert not machine_campaign.run(50, seed=3)
  assert machine_campaign.COUNTS['sequences'] >= 50
  for name in machine_campaign.REACHED:
    assert machine_campaign.COUNTS[name], name


_Step = Callable[[Any, Any], dm_env.TimeStep]


def _escapes(step: _Step) -> _Step:
  def planted(self: Any, action: Any) -> dm_env.TimeStep:
    time_step = step(self, action)
    if self._sinks[-1].last.end is events.End.DIVERGENCE:
      raise control.PhysicsError('it diverged')
    return time_step

  return planted


def _goes_on(step: _Step) -> _Step:
  def planted(self: Any, action: Any) -> dm_env.TimeStep:
    time_step = step(self, action)
    self._reset_next_step &= not time_step.last()
    return time_step

  return planted


def _clamps(step: _Step) -> _Step:
  def planted(self: Any, action: Any) -> dm_env.TimeStep:
    if isinstance(action, list) and len(action) == 7:
      action = [0.0] * 7
    return step(self, action)

  return planted


@pytest.mark.parametrize('plant', [_escapes, _goes_on, _clamps])
def test_a_step_that_does_otherwise_is_found(
    monkeypatch: pytest.MonkeyPatch, plant: Callable[[_Step], _Step]
):
  step = plant(environment.Environment.step)
  monkeypatch.setattr(environment.Environment, 'step', step)
  assert machine_campaign.run(60, seed=3)


def test_a_restored_world_that_is_not_the_saved_one_is_found(
    monkeypatch: pytest.MonkeyPatch,
):
  restore = environment.Environment.restore

  def planted(self: Any, snapshot: Any) -> None:
    restore(self, snapshot)
    self._episode += 1

  monkeypatch.setattr(environment.Environment, 'restore', planted)
  assert machine_campaign.run(60, seed=3)


def test_a_reading_that_does_not_add_up_is_found(
    monkeypatch: pytest.MonkeyPatch,
):
  inspect = registers.Register.inspect

  def planted(self: Any, *arguments: Any) -> Any:
    found = inspect(self, *arguments)
    return found._replace(reading=found.reading + 1e-6)

  monkeypatch.setattr(registers.Register, 'inspect', planted)
  assert machine_campaign.run(60, seed=3)
