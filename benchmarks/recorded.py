"""Control steps of Unlock Door as the raw engine has to repeat them."""

from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np

# Fields that a world may write between substeps besides blocks and controls: of
# the door, eaten apples, the grip of the hand, and thrown blocks.
_OCCASIONAL = ('mocap_pos', 'eq_active', 'qvel')

Phase = tuple[list[tuple[np.ndarray, np.ndarray]], int]
"""Writes, each a view and its new value, and the number of substeps after."""

_Arrays = Callable[[str], np.ndarray]


def record(
    env: Any,
    actions: np.ndarray,
    raw: _Arrays,
    true: _Arrays,
    advance_raw: Callable[[int], object],
) -> list[list[Phase]]:
  """Steps an environment, and the raw engine beside it.

  Args:
    env: One world or a batch, whose episodes have begun.
    actions: Action of each control step.
    raw: Returns an array of the raw engine's state, by name.
    true: Returns the same array of the environment.
    advance_raw: Makes a number of substeps of the raw engine.

  Returns:
    Phases of each control step.
  """
  physics = env.physics
  # The meter and the provider write the offset blocks.
  meter, provider = (env.mechanism.registers[n] for n in ('score', 'reward'))
  routine = [
      [(raw('ctrl'), true('ctrl'))],
      _pose_views(physics, meter, raw, true),
      _pose_views(physics, provider, raw, true),
  ]
  phases: list[Phase] = []
  advance = physics.advance

  def advance_both(num_substeps: int) -> None:
    writes = [(view, value.copy()) for view, value in routine[len(phases)]]
    for view, value in writes:
      view[:] = value
    for name in _OCCASIONAL:
      view, value = raw(name), true(name)
      if not np.array_equal(view, value):
        writes.append((view, value.copy()))
        view[:] = value
    phases.append((writes, num_substeps))
    advance_raw(num_substeps)
    advance(num_substeps)

  steps = []
  with mock.patch.object(physics, 'advance', advance_both):
    for action in actions:
      env.step(action)
      steps.append(phases.copy())
      phases.clear()
  return steps


def _pose_views(
    physics: Any, register: Any, raw: _Arrays, true: _Arrays
) -> list[tuple[np.ndarray, np.ndarray]]:
  """Returns views of the pose of a two-block register's offset block."""
  model = physics.model
  joints = physics.bind(register.blocks[1].body.joint).element_id
  first, last = min(joints), max(joints)
  views = []
  for name, starts, size in (
      ('qpos', model.jnt_qposadr, 4),
      ('qvel', model.jnt_dofadr, 3),
  ):
    part = slice(starts[first], starts[last] + size)  # The last one is a ball.
    views.append((raw(name)[..., part], true(name)[..., part]))
  return views
