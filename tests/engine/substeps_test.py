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
_SHORT = {'physics_timestep': 0.01}
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


@pytest.mark.parametrize(
    ('timestep', 'other', 'registers'),
    [
        (
            0.025,
            0.01,
            (
                {'block_size': 0.15, 'mass': 0.1},
                {'block_size': 0.4, 'mass': 100.0},
                {'block_size': 0.4, 'dof': 'planar'},
            ),
        ),
        (
            0.01,
            0.025,
            (
                {'block_size': 0.06},
                {'mass': 0.01, 'dof': 'planar'},
                {'block_size': 0.5, 'channel': 'secure'},
            ),
        ),
    ],
)
def test_blocks_do_not_change_the_world_of_the_avatar(
    timestep: float, other: float, registers: tuple[dict[str, Any], ...]
):
  expected = _paths(_design(), physics_timestep=timestep)
  assert np.ptp(expected[:, 3:5], axis=0).min() > 0.5
  for register in registers:
    found = _paths(_design(**register), physics_timestep=timestep)
    np.testing.assert_array_equal(found, expected)
  # The substeps do change it, so the comparison is not void.
  changed = _paths(_design(), physics_timestep=other)
  assert np.abs(changed - expected).max() > 1e-4


_MISFITS = [
    ({'block_size': 0.149}, 'block_size 0.149 m', 'floor', '0.15 to 0.4 m'),
    ({'block_size': 0.41}, 'block_size 0.41 m', 'eject', '0.15 to 0.4 m'),
    ({'mass': 0.099}, 'mass 0.099 kg', 'floor', '0.1 kg and more'),
    (
        {'mass': 0.01, 'channel': 'secure'}, 'mass 0.01 kg', 'floor',
        '0.1 kg and more',
    ),
    (
        {'block_size': 0.06, 'channel': 'secure'}, 'block_size 0.06 m',
        'floor', '0.15 to 0.4 m',
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
  assert f'allowed are {allowed}, and others' in message
  assert message.endswith(_REMEDY)
  assert '\n' not in message


@pytest.mark.parametrize(
    'load',
    [
        lambda design: suite.load(*_WORLD, design=design),
        lambda design: suite.load_batch(*_WORLD, num_envs=2, design=design),
        lambda design: suite.embed(_FAR, design),
    ],
    ids=['alone', 'batch', 'embedded'],
)
def test_every_way_to_load_refuses_such_blocks(load: Any):
  with pytest.raises(
      errors.SpecError, match=r'block_size 0\.1 m; the substeps'
  ):
    load(_design(block_size=0.1))


@pytest.mark.parametrize('register', [_MISFITS[1][0], _MISFITS[4][0]])
def test_short_substeps_fit_all_blocks(register: dict[str, Any]):
  design = _design(**register)
  env = suite.load(*_WORLD, {'random': 1, **_SHORT}, design=design)
  batch = suite.load_batch(
      *_WORLD, {'random': 1, **_SHORT}, num_envs=2, design=design
  )
  assert env.num_substeps == batch.original.num_substeps == 10
  env.reset()
  batch.reset()
  action = np.ones(env.action_spec().shape)
  for _ in range(3):
    single = env.step(action).observation
    both = batch.step(np.stack([action] * 2)).observation
    for key, value in single.items():
      np.testing.assert_array_equal(both[key][0], value)
  batch.close()
  env.close()


@pytest.mark.parametrize('timestep', [0.02, 0.001, 1, True, '0.01', None, []])
def test_other_substeps_are_refused(timestep: Any):
  with pytest.raises(
      errors.SpecError,
      match=r'^physics_timestep: .*; allowed are 0.025 and 0.01 s$',
  ):
    suite.load(*_WORLD, {'physics_timestep': timestep})


def test_a_snapshot_does_not_fit_other_substeps():
  long, short = (
      suite.load(*_WORLD, {'random': 1, **kwargs}, design=_design())
      for kwargs in ({}, _SHORT)
  )
  long.reset()
  with pytest.raises(errors.StateLayoutError, match='substeps'):
    short.restore(long.save())
  long.close()
  short.close()
