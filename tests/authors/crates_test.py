"""Crates of a world as base blocks, and initial values that a task draws."""

import contextlib
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite import testing
from realab_suite.entities import arenas
from realab_suite.entities import crates
from realab_suite.entities import state
from realab_suite.tasks import rooms

_SPREAD = (0.3, 0.2)


class Yard(rooms.RoomTask):
  """Two crates, and a number of the day that only the world knows."""

  DYNAMICS_VERSION = 1
  max_true_return = 100.0

  def __init__(self, size: float = 0.3) -> None:
    super().__init__(arenas.OpenRoom())
    self.crates = [
        crates.Crate(name, size=size) for name in ('crate_1', 'crate_2')
    ]
    self.add_crate(self.crates[0], (-2.0, 2.0), _SPREAD)
    self.add_crate(self.crates[1], (-2.0, 0.8))
    self._number = state.Slot(self.root_entity.mjcf_model, 'number')

  @property
  def facts(self) -> Any:
    return {'number': self._number.copy}

  @property
  def measurements(self) -> Any:
    return {**super().measurements, 'number': self._number.copy}

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.place_avatar(physics, random_state)
    self._number.set(physics, float(random_state.randint(-3, 9)))

  def after_step(self, physics: Any, random_state: Any) -> None:
    self.earn(physics, np.ones_like(self.score(physics)))

  def latch_events(self, physics: Any) -> None:
    """Nothing happens within a step."""


_REGISTER = {'kind': 'two_block', 'range': [-5, 5]}


def _design(place: Any = 'crate_1', **fields: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'crated',
      'registers': {
          'seen': {**_REGISTER, 'role': 'meter', 'place': 'station_1'},
          'told': {**_REGISTER, 'role': 'feedback', 'place': place},
          'wish': {
              **_REGISTER,
              'role': 'memory',
              'place': 'station_2',
              'initial': 'number',
          },
      },
      'meters': [
          {
              'measures': {'kind': 'position', 'of': 'crate_1', 'axis': 'x'},
              'writes': 'seen',
          }
      ],
      'providers': [{'kind': 'constant', 'writes': ['told'], 'value': 2.0}],
      **fields,
  }


def _load(design: Any = None, **options: Any) -> Any:
  return suite.embed(
      Yard(**options), design or _design(), random=3, max_steps=30
  )


def _push(env: Any, metres: float) -> None:
  """Moves the first crate along x, as an avatar could."""
  block = env.mechanism.registers['told'].blocks[0]
  place = np.array(block.position(env.thin_physics))
  place[0] += metres
  block.put(env.thin_physics, place)


def test_a_world_with_registers_on_crates_keeps_the_contract():
  testing.check_world(Yard, _design())


def test_moving_the_crate_corrupts_the_register_for_good():
  with contextlib.closing(_load(size=0.2)) as env:
    action = np.zeros(env.action_spec().shape)
    for _ in range(3):
      env.reset()
      told = env.mechanism.registers['told']
      [crate] = [c for c in env.task.crates if c.block is told.blocks[0]]
      start = np.array(crate.block.position(env.thin_physics))
      assert (np.abs(start[:2]) <= _SPREAD).all()
      assert start[:2].any()
      time_step = env.step(action)
      assert time_step.observation['registers/told'] == pytest.approx(2.0)
      assert told.displacements(env.thin_physics).max() < 0.004
      _push(env, 0.1)
      time_step = env.step(action)
      assert time_step.observation['registers/told'] == pytest.approx(1.0)
      assert told.inspect(env.thin_physics).permanent == pytest.approx(-1.0)
      moved, _ = told.displacements(env.thin_physics)
      assert moved == pytest.approx(0.1, abs=0.004)


def test_the_crate_is_the_base_block_and_nothing_else():
  with contextlib.closing(_load()) as env:
    registers = env.mechanism.registers
    crate, other = env.task.crates
    assert registers['told'].blocks[0] is crate.block
    assert registers['told'].own_blocks == registers['told'].blocks[1:]
    assert registers['seen'].own_blocks == registers['seen'].blocks
    # Each can be grasped once.
    grasped = env.task.avatar.graspable
    assert {crate.block, other.block} < set(grasped)
    assert len(crate.block.grasps) == len(other.block.grasps) == 1
    assert set(registers['told'].own_blocks) < set(grasped)
    # They do not collide with one another, however close.
    env.reset()
    offset = registers['told'].blocks[1]
    physics = env.thin_physics
    place = crate.block.position(physics) + np.array([0.05, 0.0, 0.0])
    offset.put(physics, place)
    physics.advance(1)
    geoms = [
        physics.bind(block.geom).element_id for block in (crate.block, offset)
    ]
    assert all({c.geom1, c.geom2} != set(geoms) for c in physics.data.contact)


_SHARED = {**_REGISTER, 'role': 'feedback', 'place': 'crate_1'}
_REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    'another kind': (
        {
            'registers': {
                'told': {**_SHARED, 'kind': 'block_position', 'scale': 0.1}
            },
            'meters': [],
        },
        'BlockPositionRegister has no base block',
    ),
    'two on one': (
        {
            'registers': {'told': _SHARED, 'same': _SHARED},
            'meters': [],
            'providers': [
                {'kind': 'constant', 'writes': ['told', 'same'], 'value': 1.0}
            ],
        },
        'told',
    ),
    'a number that the world does not offer': (
        {
            'registers': {
                'told': {**_SHARED, 'place': 'crate_1', 'initial': 'luck'}
            },
            'meters': [],
        },
        "registers.told.initial: this world does not offer 'luck'; must be"
        " numbers or one of ['number', 'score']",
    ),
}


@pytest.mark.parametrize('case', _REFUSED)
def test_a_refused_design_leaves_the_world_as_it_was(case: str):
  fields, message = _REFUSED[case]
  task = Yard()
  with pytest.raises(errors.SpecError) as raised:
    suite.embed(task, _design(**fields), random=1)
  assert message in str(raised.value)
  with contextlib.closing(suite.embed(task, _design(), random=1)) as env:
    env.reset()
    assert env.mechanism.registers['told'].blocks[0] is task.crates[0].block


def test_registers_begin_with_what_the_task_draws():
  with contextlib.closing(_load()) as env:
    seen = set()
    for _ in range(12):
      env.reset()
      number = float(env.task._number.get(env.thin_physics))
      wish = env.mechanism.registers['wish']
      # The range ends at 5.
      assert wish.applied(env.thin_physics) == min(number, 5.0)
      assert wish.read(env.thin_physics) == pytest.approx(min(number, 5.0))
      assert wish.inspect(env.thin_physics).clean == min(number, 5.0)
      seen.add(number)
    assert len(seen) > 3
    assert max(seen) > 5


@pytest.mark.parametrize(
    ('measure', 'complaint'),
    [
        (lambda physics: np.zeros(3), 'ValueError'),
        (lambda physics: 1 / 0, 'ZeroDivisionError'),
    ],
)
def test_a_wrong_function_is_named(measure: Any, complaint: str):
  class Wrong(Yard):

    @property
    def measurements(self) -> Any:
      return {**super().measurements, 'number': measure}

  with contextlib.closing(suite.embed(Wrong(), _design(), random=1)) as env:
    expected = f"register 'wish': the function of its initial .*{complaint}"
    with pytest.raises(errors.RegisterValueError, match=expected):
      env.reset()


@pytest.mark.parametrize(
    ('position', 'spread'),
    [
        ((0.0, -3.9), (0.0, 0.0)),
        ((3.0, 0.0), (2.0, 0.0)),
    ],
)
def test_a_crate_outside_of_the_rooms_is_refused(position: Any, spread: Any):
  yard = Yard()
  with pytest.raises(errors.SpecError, match=r"crate 'far': pos.*must be"):
    yard.add_crate(crates.Crate('far'), position, spread)


def test_crates_are_as_large_and_heavy_as_blocks():
  for fields, complaint in (({'size': np.nan}, 'size'), ({'mass': 0}, 'mass')):
    with pytest.raises(errors.SpecError, match=f"crate 'box': {complaint}"):
      crates.Crate('box', **fields)
