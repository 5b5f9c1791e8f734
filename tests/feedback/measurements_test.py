"""Meters measure the true state of the world, with options (M1, M3, M5)."""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import measurables
from tests.feedback import designs
from tests.feedback import metered

_NUM_STEPS = 8


def _actions(num_envs: int) -> np.ndarray:
  """Returns actions that walk to the register `reward` and beyond."""
  actions = np.zeros((_NUM_STEPS, num_envs, 6))
  actions[:, :, 0] = 1.0
  actions[4:, :, 2] = 0.3
  return actions


def _start(env: Any, world: int | None) -> None:
  """Puts the avatar in front of the register, at another place per world."""
  env.reset()
  starts = np.array([[0.85, -2.2], [1.0, -2.1], [0.5, -2.3]])
  headings = np.array([0.0, 0.1, -0.1])
  which = slice(None) if world is None else world
  env.task.avatar.place(env.physics, starts[which], headings[which])


def _centre(env: Any, name: str) -> np.ndarray:
  """Returns the true position of a body, by its MJCF name."""
  return np.array(env.physics.named.data.xpos[name])


def _nearest(env: Any, start: str, ends: list[str], axes: int = 2) -> float:
  here = _centre(env, start)[:axes]
  found = [_centre(env, end) for end in ends]
  # Eaten apples are far below the floor.
  return min(np.linalg.norm(here - p[:axes]) for p in found if p[2] > -1)


def _touches(env: Any) -> float:
  """Returns 1 if a block is within 5 mm of the avatar's body."""
  model, data = env.physics.model.ptr, env.physics.data.ptr
  names = [model.geom(geom).name for geom in range(model.ngeom)]
  torso = names.index('avatar/torso')
  return float(
      any(
          mujoco.mj_geomDistance(model, data, torso, geom, 1.0, None) <= 0.005
          for geom, name in enumerate(names)
          if name.startswith('reward/') and model.geom_contype[geom]
      )
  )


_BLOCKS = ['reward/base', 'reward/offset']
_TORSO = 'avatar/torso'
# Measurement, and the same from MuJoCo's own data.
_KINDS: dict[str, tuple[Any, Any]] = {
    'distance': (
        {'kind': 'distance', 'from': 'avatar', 'to': 'pad'},
        lambda env: _nearest(env, _TORSO, ['pad_post/']),
    ),
    'distance to the nearest apple': (
        {'kind': 'distance', 'from': 'avatar', 'to': 'apples'},
        lambda env: _nearest(env, _TORSO, [f'apples.{i}' for i in range(8)]),
    ),
    'distance in space': (
        {'kind': 'distance', 'from': 'reward', 'to': 'avatar', 'axes': 'xyz'},
        lambda env: _nearest(env, _TORSO, _BLOCKS, 3),
    ),
    'position': (
        {'kind': 'position', 'of': 'reward', 'axis': 'x'},
        lambda env: _centre(env, 'reward/base')[0],
    ),
    'position of a door': (
        {'kind': 'position', 'of': 'door', 'axis': 'z'},
        lambda env: _centre(env, 'door_leaf/')[2],
    ),
    'contacts': (
        {'kind': 'contacts', 'of': 'reward', 'with': 'avatar'}, _touches
    ),
    'time': ({'kind': 'time'}, lambda env: env.physics.data.time),
    'time by name': ('time', lambda env: env.physics.data.time),
}  # fmt: skip


def _all_kinds(dof: str) -> dict[str, Any]:
  """Returns a design with a meter of each kind, out of the avatar's way."""
  design = metered.design('score', dof=dof)
  design['meters'], design['providers'] = [], []
  for i, (measures, _) in enumerate(_KINDS.values()):
    design['registers'][f'meter_{i}'] = {
        **design['registers']['score'], 'kind': 'block_position',
        'place': [-3.6, -3.4 + 0.75 * i], 'channel': 'secure',
    }  # fmt: skip
    design['meters'].append({'measures': measures, 'writes': f'meter_{i}'})
  del design['registers']['score']
  return design


def _play(env: Any, world: int | None = None) -> Iterator[list[Any]]:
  """Yields the measurement of each meter after each step."""
  _start(env, world)
  for actions in _actions(3):
    env.step(actions if world is None else actions[world])
    writes = env.mechanism.phases.update_meters(env.physics)
    yield [write.requested for write in writes]


@pytest.fixture(scope='module', name='measured')
def fixture_measured() -> dict[str, Any]:
  """Measurements of a batch and of its last world, and the truth, by kind."""
  design = _all_kinds('planar')
  batch = suite.load_batch(
      *metered.TASK, {'random': 3}, num_envs=3, design=design
  )
  env = suite.load(*metered.TASK, {'random': 3}, {'world': 2}, design=design)
  found: dict[str, Any] = {name: ([], [], []) for name in _KINDS}
  for together, alone in zip(_play(batch), _play(env, 2), strict=True):
    measured = zip(found.items(), together, alone, strict=True)
    for (name, sides), in_batch, in_world in measured:
      values = in_batch, in_world, _KINDS[name][1](env)
      for side, value in zip(sides, values, strict=True):
        side.append(value)
  batch.close()
  env.close()
  return found


@pytest.mark.parametrize('name', _KINDS)
def test_a_meter_measures_what_mujoco_has_in_one_world_and_in_many(
    name: str, measured: dict[str, Any]
):
  in_batch, in_world, truth = measured[name]
  assert in_world == pytest.approx(truth, abs=1e-9)
  assert [found[2] for found in in_batch] == in_world
  assert np.ptp(in_batch) > 0 or 'door' in name


@pytest.mark.parametrize(
    ('kind', 'channel'),
    [
        ('two_block', 'secure'),
        ('block_orientation', 'embedded'),
    ],
)
def test_a_block_that_moved_in_any_direction_is_detected(
    kind: str, channel: str
):
  measures = {'kind': 'detector', 'of': ['reward'], 'tolerance': 0.05}
  design = metered.design(measures, kind=kind, channel=channel)
  env = suite.load(*metered.TASK, {'random': 3}, design=design)
  env.reset()
  register = env.mechanism.registers['reward']
  register.write(env.physics, 1.5)
  assert metered.measure(env) == 0.0
  for block in register.blocks:
    before = np.array(block.position(env.physics))
    heading = block.heading(env.physics)
    for axis in np.eye(3):
      for amount, expected in ((0.04, 0.0), (0.06, 1.0), (0.0, 0.0)):
        block.put(env.physics, before + amount * axis, heading)
        assert metered.measure(env) == expected
  if kind == 'block_orientation':
    # The sides of the block are 0.1 m from its centre.
    for angle, expected in ((0.4, 0.0), (0.6, 1.0)):
      block.put(env.physics, before, heading + angle)
      assert metered.measure(env) == expected
  env.close()


def test_eaten_apples_are_no_longer_near():
  measures = {'kind': 'distance', 'from': 'avatar', 'to': 'apples'}
  for absent in (100.0, 7.0):
    design = metered.design({**measures, 'absent': absent})
    env = suite.load('collect_apples', 'standard', {'random': 3}, design=design)
    env.reset()
    here = env.task.avatar.position(env.physics)
    near = metered.measure(env)
    apples = measurables.in_world(env.task.root_entity)['apples']
    (group,) = [
        e
        for e in env.task.root_entity.iter_entities()
        if e.mjcf_model.model == 'apples'
    ]
    group.eat(env.physics, here, near + 1e-6)
    assert near < metered.measure(env) < absent
    group.eat(env.physics, here, 50.0)
    assert metered.measure(env) == absent
    assert not apples.is_present(env.physics).any()
    env.close()


def test_all_meters_measure_before_one_writes():
  # The second meter measures a block that the first meter's write moves.
  design = metered.design({'kind': 'time'}, place='station_3')
  design['registers']['score'].update(scale=0.1, range=[0, 20])
  design['registers']['x'] = {
      **designs.SCORE, 'place': 'station_4', 'range': [-5, 5], 'scale': 0.1,
  }  # fmt: skip
  at = {'kind': 'position', 'of': 'score', 'axis': 'x'}
  design['registers']['score']['kind'] = 'block_position'
  design['meters'].append({'measures': at, 'writes': 'x'})
  env = suite.load(*metered.TASK, {'random': 3}, design=design)
  env.reset()
  env.step(np.zeros(6))
  before = _centre(env, 'score/block')[0]
  first, second = env.mechanism.phases.update_meters(env.physics)
  assert first.writer == 'meter:time'
  assert second.requested == before
  env.physics.forward()
  assert _centre(env, 'score/block')[0] > before + 0.002
  env.close()


# Names in the ledger, and the forms of a measurement.


_REFUSED = {
    'no such kind': (
        {'kind': 'distanse'}, r"kind: .* did you mean 'distance'",
    ),
    'unknown option': (
        {'kind': 'distance', 'from': 'avatar', 'two': 'pad'},
        r"measures: unknown key 'two'; .*allowed: kind, from, to",
    ),
    'needs options': ('distance', r"'distance' needs the options \['from', 't"),
    'no such name': (
        {'kind': 'distance', 'from': 'avatar', 'to': 'pda'},
        r"meters\[0\].measures.to: 'pda' .* one of \['apples', 'avatar'.*"
        r"'reward', 'score'\]",
    ),
    'a group': (
        {'kind': 'position', 'of': 'apples', 'axis': 'x'},
        r"measures.of: 'apples' has 8 bodies; must be .*'avatar'",
    ),
    'nothing to touch': (
        {'kind': 'contacts', 'of': 'avatar', 'with': 'apples'},
        r"measures.with: .*'apples'; must be one of \['avatar', 'door'",
    ),
    'not collected': (
        {'kind': 'collected', 'of': 'pad'},
        r"measures.of: 'pad' .*must be one of \['apples', 'large_apple'\]",
    ),
    'no register': (
        {'kind': 'detector', 'of': ['pad']},
        r"measures.of: 'pad' .*must be one of \['reward', 'score'\]",
    ),
}  # fmt: skip


@pytest.mark.parametrize(('measures', 'text'), _REFUSED.values(), ids=_REFUSED)
def test_a_wrong_measurement_is_refused_with_what_is_allowed(
    measures: Any, text: str
):
  with pytest.raises(errors.SpecError, match=text) as caught:
    suite.load(*metered.TASK, design=metered.design(measures))
  assert '\n' not in str(caught.value)
