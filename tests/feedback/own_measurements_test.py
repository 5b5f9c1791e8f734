"""Measurements of one's own, and what tasks and `suite.embed` offer (M1)."""

import copy
from typing import Any, Literal, final

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import measurables
from realab_suite.feedback import measurements
from realab_suite.tasks import collect_apples
from realab_suite.tasks import unlock_door
from tests import worlds
from tests.engine import helpers
from tests.feedback import metered


@final
class _Height(measurements.Measurement):
  """The height of a part, times a factor."""

  kind: Literal['test_height'] = 'test_height'
  of: str
  factor: float = 1.0

  def connect(self, world: measurements.World) -> measurements.Measure:
    if self.factor == 0.0:
      raise ZeroDivisionError('no factor')
    part = world.body('of', self.of)
    return lambda physics: self.factor * part.positions(physics)[..., 0, 2]


@pytest.mark.parametrize('num_envs', [None, 2])
def test_a_registered_measurement_is_usable_by_its_kind(num_envs: int | None):
  measures = {'kind': 'test_height', 'of': 'reward', 'factor': 10.0}
  with helpers.registered(measurements.MEASUREMENTS, 'test_height', _Height):
    design = metered.design(measures, dof='planar', block_size=0.3)
    if num_envs is None:
      env: Any = suite.load(*metered.TASK, {'random': 1}, design=design)
    else:
      env = suite.load_batch(
          *metered.TASK, {'random': 1}, num_envs=num_envs, design=design
      )
    env.reset()
    np.testing.assert_allclose(metered.measure(env), 1.54)
    assert np.shape(metered.measure(env)) == (() if num_envs is None else (2,))
    env.close()
    wrong = metered.design({**measures, 'factor': 0.0})
    with pytest.raises(errors.SpecError, match=r'measures: ZeroDivisionError'):
      suite.load(*metered.TASK, design=wrong)
  with pytest.raises(
      errors.SpecError, match=r'measures.kind: measurement kind'
  ):
    suite.load(*metered.TASK, design=design)


def test_a_task_may_declare_parts_of_its_own():

  class Furnished(collect_apples.CollectApples):
    """Has a ball that rolls."""

    def __init__(self) -> None:
      super().__init__()
      body = self._arena.mjcf_model.worldbody.add(
          'body', name='ball', pos=(1, 2, 0.2)
      )
      body.add('geom', type='sphere', size=(0.2,), mass=1.0)
      self.joints = [
          body.add('joint', type='slide', axis=axis) for axis in np.eye(3)[:2]
      ]
      self._ball = body

    @property
    def measurables(self) -> Any:
      ball = measurables.Measurable((self._ball,))
      return {**super().measurables, 'ball': ball}

  measures = {'kind': 'position', 'of': 'ball', 'axis': 'x'}
  env = suite.embed(Furnished(), metered.design(measures), random=1)
  env.reset()
  env.physics.bind(env.task.joints).qpos = [0.3, 0.4]
  assert metered.measure(env) == pytest.approx(1.3)
  env.close()


def test_a_function_may_not_replace_one_of_the_task():
  for name, task in (
      ('score', helpers.PointTask()),
      ('score', collect_apples.CollectApples()),
      ('door_unlocked', unlock_door.UnlockDoor()),
  ):
    with pytest.raises(errors.SpecError, match=f"measurements: '{name}' is me"):
      suite.embed(task, 'none', measurements={name: lambda physics: 1.0})


def test_bodies_of_foreign_tasks_are_named_by_their_identifiers():
  design = copy.deepcopy(helpers.SCORED)
  for measures, truth in (
      ({'kind': 'position', 'of': 'bead', 'axis': 'x'}, 'x'),
      ({'kind': 'distance', 'from': 'bead', 'to': 'score'}, None),
  ):
    design['meters'][0]['measures'] = measures
    env, _ = helpers.embed(helpers.PointTask(), design)
    env.reset()
    for _ in range(4):
      env.step([1.0])
    joint = env.physics.bind(env.task.joint)
    measured = metered.measure(env)
    if truth == 'x':
      assert measured == pytest.approx(float(joint.qpos[0]))
    else:
      blocks = env.mechanism.registers['score'].blocks
      centres = [worlds.world_position(env.physics, b) for b in blocks]
      away = [np.hypot(x - float(joint.qpos[0]), y) for x, y, _ in centres]
      assert measured == pytest.approx(min(away), abs=0.01)
    env.close()
  design['meters'][0]['measures'] = {
      'kind': 'position',
      'of': 'bed',
      'axis': 'x',
  }
  with pytest.raises(errors.SpecError, match=r"measures.of: 'bed'.*'bead'"):
    helpers.embed(helpers.PointTask(), design)
