"""A write beside a wall is obstructed, equally in one world and in a batch."""

from typing import Any

import mujoco
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.entities import moving
from realab_suite.entities import registers
from realab_suite.entities import surroundings
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.tasks import collect_apples
from tests.evaluation import streams

_NUM_ENVS = 3
_MAX_STEPS = 6
# In steps 3 and 4, the blocks of this world are in the small room, which is too
# narrow for the value.
_OBSTRUCTED = 1
_STEPS = (3, 4)
_VALUE = 11.0
# Start of the registers; the small room extends from -1.3 to 1.3 m, and a block
# may be inside its wall by half its half edge length, free blocks a bit less.
_START = 1.0, 3.0
_OBSTRUCTION = (1.3 - 0.05 - _START[0]) / 0.1 - _VALUE


def _design(dof: str) -> dict[str, Any]:
  kinds = {'reward': 'two_block', 'bonus': 'block_position'}
  return {
      'schema': 1,
      'name': 'obstructed',
      'dof': dof,
      'registers': {
          name: {
              'kind': kind,
              'role': 'feedback',
              'initial': 0,
              'place': [_START[0], _START[1] - i],
              'range': [-2, 12],
          }
          for i, (name, kind) in enumerate(kinds.items())
      },
      'providers': [
          {'kind': 'constant', 'value': _VALUE, 'writes': [name]}
          for name in kinds
      ],
  }


def _move(env: Any, distance: Any) -> None:
  """Moves the written blocks away from their axis, `(...)`, in m."""
  for register in env.mechanism.registers.values():
    block = register.blocks[-1]
    position = np.array(block.position(env.physics))
    position[..., 0] = -0.5
    position[..., 1] += distance
    position[..., 2] = block.rest_height
    block.put(env.physics, position)


def _play(env: Any, distance: Any) -> None:
  """Plays an episode in which the base of the reward moves as well."""
  env.reset()
  for step in range(1, _MAX_STEPS + 1):
    if step == _STEPS[0]:
      _move(env, distance)
    if step == _STEPS[-1] + 1:
      _move(env, -distance)
    if step == _STEPS[-1]:
      base = env.mechanism.registers['reward'].blocks[0]
      position = np.array(base.position(env.physics))
      position[..., 0] -= 0.2
      base.put(env.physics, position)
    shape = np.shape(distance) + env.action_spec().shape
    env.step(np.zeros(shape, env.action_spec().dtype))
  env.close()


def _load(load: Any, dof: str, **options: Any) -> Any:
  world = {'world': options.pop('world')} if 'world' in options else {}
  return load(
      'unlock_door',
      'near',
      {'random': 3},
      {'max_steps': _MAX_STEPS, **world},
      design=_design(dof),
      **options,
  )


@pytest.mark.parametrize('dof', registers.DOFS)
def test_an_obstructed_write_is_a_part_of_the_corruption(dof):
  batch = _load(suite.load_batch, dof, num_envs=_NUM_ENVS, num_threads=1)
  together = ledgers.BatchLedger()
  monitor = monitors.BatchMonitor(batch)
  batch.add_sink(together)
  batch.add_sink(monitor)
  distances = np.zeros(_NUM_ENVS)
  distances[_OBSTRUCTED] = 2.5
  _play(batch, distances)
  figures = {one.world: one for one in monitor.take()}
  for world in range(_NUM_ENVS):
    env, ledger = _load(suite.load, dof, world=world), ledgers.Ledger()
    env.add_sink(ledger)
    _play(env, np.float64(distances[world]))
    [episode] = ledger.episodes
    assert episode.entries == together.episodes(world)[0].entries
    _check_parts(episode, is_obstructed=world == _OBSTRUCTED)
    for name, register in env.mechanism.registers.items():
      found = figures[world].registers[name].obstruction / register.scale
      # Of the reads after each step.
      share = len(_STEPS) / _MAX_STEPS * (world == _OBSTRUCTED)
      expected = share * abs(_OBSTRUCTION)
      assert found == pytest.approx(expected, abs=0.1)


def _check_parts(episode: ledgers.EpisodeLedger, is_obstructed: bool) -> None:
  for write, read in streams.pairs([episode]):
    corruption = read.obstruction + read.permanent + read.temporary
    assert read.reading - write.applied == pytest.approx(corruption, abs=1e-9)
    assert read.obstruction == write.obstruction
    expected = _OBSTRUCTION * (is_obstructed and read.step in _STEPS)
    assert read.obstruction == pytest.approx(expected, abs=0.1)
    if read.register == 'reward' and read.step >= _STEPS[-1]:
      assert read.permanent == pytest.approx(2.0, abs=0.1)
    assert write.requested == write.applied


def test_an_obstructed_block_leaves_the_wall_slowly():
  reward = {
      'kind': 'block_position',
      'role': 'feedback',
      'initial': 0,
      'place': [-2.3, -2.6],
      'range': [0, 35],
      'block_size': 0.4,
  }
  design = {'schema': 1, 'name': 'large', 'registers': {'reward': reward}}
  env = suite.load('unlock_door', 'standard', {'random': 1}, design=design)
  env.reset()
  register = env.mechanism.registers['reward']
  block = register.blocks[0]
  random = np.random.default_rng(0)
  for _ in range(20):
    # In the small room, which is too narrow for either value.
    position = np.array(block.position(env.physics))
    position[:] = 2.3 + random.uniform(-0.6, 0.6), 8.1, block.rest_height
    block.put(env.physics, position, random.choice([0.0, np.pi / 4, 0.5]))
    for value in random.choice([0.0, 35.0], size=4):
      register.write(env.physics, value)
      for _ in range(5):
        env.physics.advance(1)
        velocity = env.physics.bind(block.body.joint[:3]).qvel
        assert np.linalg.norm(velocity) < 2.0


# ---- Doors -------------------------------------------------------------------

# A register along the diagonal of the large room, and where its block meets the
# door: the coordinates along and beside its axis, in m.
_DIAGONAL = {
    'schema': 1,
    'name': 'diagonal',
    'registers': {
        'reward': {
            'kind': 'block_position',
            'role': 'feedback',
            'initial': 0,
            'place': {'position': [-3.0, -3.0], 'yaw': np.pi / 4},
            'range': [0, 80],
        }
    },
    'providers': [{'kind': 'constant', 'value': 71.4, 'writes': ['reward']}],
}
_BESIDE_THE_DOOR = 5.5, 2.9
_PAD = [0.0, 1.9]


def test_a_shut_door_obstructs_and_an_open_one_does_not():
  batch = suite.load_batch(
      'unlock_door', 'standard', {'random': 3}, num_envs=2, design=_DIAGONAL
  )
  batch.reset()
  (register,) = batch.mechanism.registers.values()
  (block,) = register.blocks
  # The pad is pressed in the second world.
  batch.task._pad.press(batch.physics, np.array([[99.0, 99.0], _PAD]))
  found = []
  for _ in range(12):
    place = np.array(block.position(batch.physics))
    place[..., :2] = _BESIDE_THE_DOOR
    block.put(batch.physics, place)
    batch.step(np.zeros((2, *batch.action_spec().shape)))
    found.append(np.array(register.obstruction(batch.physics)))
  # The leaf is 0.08 m wide, and a block may be 0.05 m inside.
  shut = -np.array([found[0][1], *np.array(found)[:, 0]])
  assert (shut > 1.0).all()
  assert (shut < 3.0).all()
  np.testing.assert_array_equal(np.array(found)[-3:, 1], 0.0)
  batch.close()


def _past_doors() -> tuple[list[bytes], int, int]:
  """Plays two episodes in which the doors of three worlds open in turn.

  Returns:
    The states and records of all steps, the number of searches for obstacles,
    and that of obstructed writes.
  """
  search, searches, obstructed, played = mujoco.mj_kinematics, [], 0, []
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(
        mujoco, 'mj_kinematics', lambda *data: searches.append(search(*data))
    )
    batch = suite.load_batch(
        'unlock_door',
        'standard',
        {'random': 3},
        num_envs=_NUM_ENVS,
        num_threads=1,
        design=_DIAGONAL,
    )
    ledger = ledgers.BatchLedger()
    batch.add_sink(ledger)
    (register,) = batch.mechanism.registers.values()
    for _ in range(2):
      batch.reset()
      for step in range(16):
        places = np.full((_NUM_ENVS, 2), 99.0)
        places[step // 2 : step // 2 + 1] = _PAD
        batch.task._pad.press(batch.physics, places)
        if step == 5:
          block = np.array(register.blocks[0].position(batch.physics))
          block[..., :2] = _BESIDE_THE_DOOR
          register.blocks[0].put(batch.physics, block)
        batch.step(np.zeros((_NUM_ENVS, *batch.action_spec().shape)))
        obstructed += np.count_nonzero(register.obstruction(batch.physics))
        played.append(batch.save().to_bytes())
    played += [repr(ledger.episodes(i)).encode() for i in range(_NUM_ENVS)]
    batch.close()
  return played, len(searches), obstructed


def test_corridors_beside_doors_are_remembered(monkeypatch):
  played, searches, obstructed = _past_doors()
  monkeypatch.setattr(surroundings, '_MOST_REMEMBERED', 2)
  kind = surroundings.Surroundings
  with_few = _past_doors()
  monkeypatch.setattr(kind, '_recall_corridor', kind._corridor_in)
  without = _past_doors()
  assert with_few[0] == without[0] == played
  assert obstructed > 0
  assert searches + 40 < with_few[1] < without[1]


def test_corridors_are_forgotten_when_a_register_is_moved():
  reward = {'place': [-0.5, -3.0], 'range': [0, 5]}
  registers_ = {'reward': _DIAGONAL['registers']['reward'] | reward}
  design = {**_DIAGONAL, 'registers': registers_, 'providers': []}
  env = suite.load('unlock_door', 'standard', {'random': 3}, design=design)
  env.reset()
  (block,) = env.mechanism.registers['reward'].blocks
  here = np.array(block.position(env.physics))
  beyond = here + np.array([0.0, 8.5, 0.0])
  for is_moved in (False, True, False):
    block.surroundings.shift(np.array([0.0, 8.5 * is_moved]))
    assert block.surroundings.are_far(env.physics, here) != is_moved
    assert block.surroundings.are_far(env.physics, beyond) == is_moved
  env.close()


@pytest.mark.parametrize(('turn', 'yaw'), [(0.0, np.pi / 4), (0.6, 0.0)])
def test_a_block_is_put_beside_a_wall_that_was_moved(turn, yaw):
  task = collect_apples.CollectApples()
  wall = moving.MovingPart('wall', [{'type': 'box', 'size': (0.5, 0.2, 0.5)}])
  wall.attach_to(task.root_entity, (0.0, 0.0, -3.0))
  place = {'position': [-3.0, -3.0], 'yaw': yaw}
  reward = _DIAGONAL['registers']['reward'] | {'place': place, 'range': [0, 60]}
  design = {**_DIAGONAL, 'registers': {'reward': reward}, 'providers': []}
  env = suite.embed(task, design, random=0)
  env.reset()
  (register,) = env.mechanism.registers.values()
  (block,) = register.blocks
  geoms = [env.physics.bind(g).element_id for g in (block.geom, wall.geoms[0])]
  for aside in (1.5, 1.9):
    along = 4.5
    place = np.array([along - 2.0, aside, 0.1])
    block.put(env.physics, place)
    # The middle of the wall, in the world.
    cos, sin = np.cos(yaw), np.sin(yaw)
    middle = np.array([[cos, -sin], [sin, cos]]) @ [along, aside] - 3.0
    for height, is_in_the_way in ((-3.0, False), (0.5, True), (3.0, False)):
      quaternion = [np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]
      moving.move(env.physics, wall.frame, [*middle, height], quaternion)
      register.write(env.physics, along / 0.1)
      obstruction = float(register.obstruction(env.physics))
      assert (abs(obstruction) > 1.0) == is_in_the_way
      assert (obstruction != 0.0) == is_in_the_way
      env.physics.forward()
      distance = mujoco.mj_geomDistance(
          env.physics.model.ptr, env.physics.data.ptr, *geoms, 1.0, None
      )
      # Contacts push out a block whose sides are at most 0.05 m inside, and
      # its corners 0.07 m.
      assert -0.075 < distance < 0.0 or not is_in_the_way
      block.put(env.physics, place)
  env.close()
