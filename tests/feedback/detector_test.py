"""Detectors see registers that were moved, if they are in sight.

The room has a supervisor at (-3.5, 1.2) that looks to the east, and a screen of
0.5 m at x = -1.2, from y = 0.5 to 2.1. A block is pushed by 5 cm to the north.
"""

from typing import Any

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.feedback import specs
from tests.config import refusals
from tests.feedback import metered

_WORLD = 'supervised_room', 'standard'
_EYES: dict[str, Any] = {'eye': 'supervisor'}
_OPEN, _HIDDEN = [-2.2, 1.2], [-0.1, 1.3]


def _design(
    place: Any, sight: Any = None, of: Any = ('reward',), **register: Any
) -> dict[str, Any]:
  measures = {'kind': 'detector', 'of': [*of]}
  if sight is not None:
    measures['sight'] = sight
  return metered.design(
      measures, place=place, range=[0, 1], scale=0.1, **register
  )


def _load(design: Any, num_envs: int = 0) -> Any:
  """Returns a world, or several, with all things in a corner."""
  arguments = (*_WORLD, {'random': 3})
  env = (
      suite.load_batch(*arguments, num_envs=num_envs, design=design)
      if num_envs
      else suite.load(*arguments, design=design)
  )
  env.reset()
  leading = (num_envs,) if num_envs else ()
  for group in env.task._groups:
    group.place(env.physics, np.full((*leading, group.number, 2), 3.4))
  return env


def _push(env: Any, by: Any = 0.05, block: int = 0) -> None:
  """Moves a block of the reward to the north, in m."""
  one = env.mechanism.registers['reward'].blocks[block]
  position = np.array(one.position(env.physics))
  position[..., 1] += by
  one.put(env.physics, position, one.heading(env.physics))


# Place of the register, the sight, and whether the block is seen.
_SIGHTS: dict[str, tuple[Any, Any, bool]] = {
    'everything': (_HIDDEN, None, True),
    'before the supervisor': (_OPEN, _EYES, True),
    # The block is at (-2.2, 1.25): 1.3 m away.
    'in range': (_OPEN, {**_EYES, 'range': 1.4}, True),
    'out of range': (_OPEN, {**_EYES, 'range': 1.2}, False),
    'aside': (_OPEN, {**_EYES, 'heading': 66}, False),
    'on the other side': (_OPEN, {**_EYES, 'heading': -54}, True),
    'all around': (_OPEN, {**_EYES, 'heading': 180, 'angle': 360}, True),
    'behind the screen': (_HIDDEN, _EYES, False),
    # At the screen, the line of sight is 1.4 m, or 0.35 m high.
    'over the screen': (_HIDDEN, {'eye': [-2.5, 1.3, 3]}, True),
    'under its edge': (_HIDDEN, {'eye': [-2.5, 1.3, 0.6]}, False),
}  # fmt: skip


@pytest.mark.parametrize('name', _SIGHTS)
def test_a_block_that_moved_is_seen_if_it_is_in_sight(name: str):
  place, sight, is_seen = _SIGHTS[name]
  env = _load(_design(place, sight))
  assert metered.measure(env) == 0.0
  _push(env)
  assert metered.measure(env) == float(is_seen)
  content = env.mechanism.ports['score']
  assert float(content.applied(env.physics)) == float(is_seen)
  # What nothing obstructs.
  assert float(content.clean(env.physics)) == 1.0
  assert env.mechanism.obstructible == (['score'] if sight else [])
  env.close()


@pytest.mark.parametrize(
    ('by', 'expected'), [(0.009, 0.0), (0.011, 1.0), (0.7, 0.0)]
)
def test_what_was_carried_out_of_sight_is_not_seen(by: float, expected: float):
  # At (-2.2, 1.95), at 30 degrees, the block is beyond a sector of 40 degrees.
  env = _load(_design(_OPEN, {**_EYES, 'angle': 40}))
  _push(env, by)
  assert metered.measure(env) == expected
  env.close()


def test_a_detector_watches_several_registers():
  env = _load(_design(_OPEN, of=['reward', 'score']))
  assert metered.measure(env) == 0.0
  block = env.mechanism.registers['score'].blocks[1]
  block.put(env.physics, np.add(block.position(env.physics), (0, 0.1, 0)))
  assert metered.measure(env) == 1.0
  env.close()


def test_who_turns_the_supervisor_turns_the_view():
  env = _load(_design(_OPEN, _EYES))
  _push(env)
  eyes = env.task._eyes.block
  for heading, expected in ((0.0, 1.0), (3.0, 0.0), (-0.9, 1.0)):
    eyes.put(env.physics, eyes.position(env.physics), heading)
    assert metered.measure(env) == expected
  env.close()


def test_worlds_of_a_batch_are_seen_as_each_alone():
  pushes = np.array([0.0, 0.05, -0.3, 0.9])
  design = _design(_OPEN, {**_EYES, 'angle': 60}, dof='planar')
  batch = _load(design, len(pushes))
  _push(batch, pushes)
  found = metered.measure(batch)
  batch.close()
  np.testing.assert_array_equal(found, [0.0, 1.0, 1.0, 0.0])


def test_the_eye_may_be_on_a_body_that_code_moves():
  # The door of `unlock_door` is in the north wall, at (0, 4.1).
  found = {}
  for heading in (-90, 90):
    design = _design([0.8, 0.0], {'eye': 'door', 'heading': heading})
    env = suite.load('unlock_door', 'standard', {'random': 3}, design=design)
    env.reset()
    _push(env, block=1)  # The other one is behind it.
    found[heading] = float(metered.measure(env))
    env.close()
  assert found == {-90: 1.0, 90: 0.0}


_CANNOT = 'cannot be measured in this world; must be one of ['
_MISFITS = {
    'of: [rewards]': "of: 'rewards' cannot be measured in this world; did you",
    # What is no register has no place that a write has given it.
    'of: [reward, avatar]': f"of: 'avatar' {_CANNOT}'reward', 'score']",
    'of: [reward], sight: {eye: guard}':
        f"sight.eye: 'guard' {_CANNOT}'avatar'",
}  # fmt: skip


@pytest.mark.parametrize('options', _MISFITS)
def test_a_detector_that_does_not_fit_the_world_is_refused(options: str):
  override = f'meters.0.measures={{kind: detector, {options}}}'
  design = specs.load(_design(_OPEN), [override])
  text = refusals.refusal(suite.load, *_WORLD, design=design)
  assert text.startswith(f"design 'd': meters[0].measures.{_MISFITS[options]}")
