"""Tests that the task, and not the design, decides on the substeps."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.tasks import collect_apples
from tests.engine import helpers

_WORLD = 'unlock_door', 'far'
# Every design of a test but the last is refused.
_FAR = collect_apples.CollectApples('far')
_REMEDY = "task_kwargs={'physics_timestep': 0.01}"


def _design(**register: Any) -> dict[str, Any]:
  """Returns a design with blocks out of the avatar's way."""
  return helpers.one_register(
      'reward', role='feedback', range=[0, 3], **register
  )


def _paths(design: Any, **kwargs: Any) -> np.ndarray:
  """Returns the state of the avatar after each step, `(steps, 9)`."""
  env = suite.load(*_WORLD, {'random': 5, **kwargs}, design=design)
  env.reset()
  rng = np.random.default_rng(0)
  states = []
  for step in range(60):
    if step % 10 == 0:
      action = rng.uniform(-1.0, 1.0, env.action_spec().shape)
      action[4:] = 0.0
    env.step(action)
    states.append(env.task.avatar.proprioception(env.physics).copy())
  env.close()
  return np.array(states)


def test_blocks_do_not_change_the_world_of_the_avatar():
  expected = _paths(_design())
  assert np.ptp(expected[:, 3:5], axis=0).min() > 0.5
  for register in (
      {'block_size': 0.15, 'mass': 0.1},
      {'block_size': 0.4, 'dof': 'planar'},
  ):
    np.testing.assert_array_equal(_paths(_design(**register)), expected)
  # The substeps do change it, so the comparison is not void.
  changed = _paths(_design(block_size=0.06), physics_timestep=0.01)
  assert np.abs(changed - expected).max() > 1e-4


_MISFITS = [
    ({'block_size': 0.149}, 'block_size 0.149 m', 'floor', '0.15 to 0.4 m'),
    ({'block_size': 0.41}, 'block_size 0.41 m', 'eject', '0.15 to 0.4 m'),
    (
        {'mass': 0.01, 'channel': 'secure'}, 'mass 0.01 kg', 'floor',
        '0.1 kg and more',
    ),
]  # fmt: skip


@pytest.mark.parametrize(('register', 'given', 'effect', 'allowed'), _MISFITS)
def test_blocks_that_the_substeps_do_not_fit_are_refused(
    register: dict[str, Any], given: str, effect: str, allowed: str
):
  with pytest.raises(errors.SpecError) as refusal:
    suite.embed(_FAR, _design(**register))
  message = str(refusal.value)
  assert message.startswith(f"register 'reward': {given}; the substeps of 25")
  assert effect in message
  assert f'must be {allowed}, or others' in message
  assert message.endswith(_REMEDY)
  assert '\n' not in message


@pytest.mark.parametrize('timestep', [0.02, True, '0.01'])
def test_other_substeps_are_refused(timestep: Any):
  with pytest.raises(
      errors.SpecError,
      match=r'^physics_timestep: .*; must be 0.025 or 0.01 s$',
  ):
    suite.load(*_WORLD, {'physics_timestep': timestep})
