"""Foreign Composer tasks with feedback, and what they share with Composer."""

import copy
from typing import Any

from dm_control import composer
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.walkers import jumping_ball
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests.engine import helpers


def _go_to_target() -> composer.Task:
  return go_to_target.GoToTarget(
      jumping_ball.RollingBallWithHead(),
      floors.Floor(size=(8.0, 8.0)),
      walker_spawn_position=(0.0, 0.0),
      target_spawn_position=(0.3, 0.0),
  )


def test_a_task_of_dm_controls_gets_feedback_and_hides_its_reward():
  stock = composer.Environment(_go_to_target(), random_state=0)
  expected = set(stock.observation_spec())
  control_spec = stock.action_spec()
  env, sink = helpers.embed(_go_to_target(), helpers.SCORED, max_steps=8)
  assert set(env.observation_spec()) == {
      *(f'senses/{name}' for name in expected),
      'senses/time_left',
      'registers/reward',
  }
  assert env.action_spec().shape == control_spec.shape
  assert env.action_spec().name == control_spec.name
  keys = list(env.observation_spec())
  time_steps = [env.reset()]
  for _ in range(8):
    action = np.zeros(control_spec.shape)
    time_steps.append(env.step(action))
  assert time_steps[-1].last()
  for time_step in time_steps:
    assert list(time_step.observation) == keys
    for value in time_step.observation.values():
      assert value.base is None
      assert np.isfinite(value).all()
  assert {step.reward for step in time_steps[1:]} == {0.0}
  # It stands on its target from the start, and earns 1 in every step.
  assert [float(step.true_reward) for step in sink.steps] == [1.0] * 8
  # The mechanism keeps the score, up to the step before.
  measured = [
      float(w.requested) for w in sink.records(registers.Write, 'score')
  ]
  assert measured == [float(i) for i in range(8)]
  observed = [float(s.observation['registers/reward']) for s in time_steps]
  np.testing.assert_allclose(observed, [0, 0] + [1] * 7, atol=1e-6)


def test_an_embedded_task_may_offer_measurements():
  task = helpers.PointTask()
  design = copy.deepcopy(helpers.SCORED)
  design['meters'][0]['measures'] = 'time'
  env, sink = helpers.embed(
      task, design, measurements={'time': lambda physics: physics.time()}
  )
  env.reset()
  env.step([0.0])
  (written,) = sink.records(registers.Write, 'score')
  # After a third of the five substeps of 10 ms.
  np.testing.assert_allclose(written.requested, 0.01)


def test_rewards_that_are_no_finite_numbers_are_not_in_the_score():
  task = helpers.PointTask()
  paid = iter([1.0, np.nan, 'not a number', np.inf, 2.0, 0.0])
  task.reward = lambda physics: next(paid)
  env, sink = helpers.embed(task, helpers.SCORED)
  env.reset()
  for _ in range(6):
    env.step([0.0])
  assert sink.requested('score') == [0.0, 1.0, 1.0, 1.0, 1.0, 3.0]


def test_positions_written_in_substeps_act_as_without_registers():
  def play(design: Any) -> list[float]:
    task = helpers.PointTask()
    task.joint.stiffness = 30.0

    def write(physics: Any, action: Any, random_state: Any) -> None:
      physics.bind(task.joint).qpos = 0.9 * physics.bind(task.joint).qpos

    task.before_substep = write
    env, _ = helpers.embed(task, design)
    env.reset()
    steps = [env.step([1.0]) for _ in range(20)]
    return [float(step.observation['senses/bead'][0]) for step in steps]

  bare, beside = play('none'), play(helpers.SCORED)
  assert np.ptp(bare) > 1e-4
  np.testing.assert_allclose(beside, bare, rtol=1e-9)


def test_a_sense_that_is_called_like_one_of_ours_is_refused():
  class Clashing(helpers.PointTask):

    @property
    def task_observables(self) -> Any:
      return {'time_left': self.bead}

  with pytest.raises(errors.RealabError, match='time_left'):
    helpers.embed(Clashing(), max_steps=5)
  helpers.embed(Clashing(), max_steps=None)  # Nothing clashes.


class _WithAvatar(composer.Task):
  """A task of another package that uses the avatar of this one."""

  def __init__(self) -> None:
    self._arena = floors.Floor(size=(8.0, 8.0))
    self.avatar = avatars.Avatar()
    self._arena.attach(self.avatar)
    self.set_timesteps(control_timestep=0.1, physics_timestep=0.01)

  @property
  def root_entity(self) -> composer.Entity:
    return self._arena

  def action_spec(self, physics: Any) -> Any:
    return self.avatar.action_spec

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.avatar.place(physics, (0.0, 0.0), 0.0)

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    self.avatar.apply_action(physics, action)

  def get_reward(self, physics: Any) -> float:
    return 0.0


@pytest.mark.parametrize('grasp', [0.0, 1.0])
def test_the_avatar_carries_a_register_in_the_arena_of_another_package(
    grasp: float,
):
  register = {
      'kind': 'block_position', 'role': 'feedback', 'place': [0.7, 0.0],
      'range': [-20, 20], 'dof': 'planar',
  }  # fmt: skip
  design = {
      'schema': 1,
      'name': 'd',
      'registers': {'r': register},
      'providers': [
          {'kind': 'constant', 'writes': ['r'], 'value': 0.0, 'every': 1000}
      ],
  }
  task = _WithAvatar()
  # A design that is refused leaves nothing in the hand.
  with pytest.raises(errors.SpecError):
    helpers.embed(task, design | {'schedule': {'meter_substep': 90}})
  env, _ = helpers.embed(task, design, max_steps=None)
  env.reset()
  names = env.action_spec().name.split('\t')
  for forward in [0.0] * 3 + [-1.0] * 15:
    action = np.zeros(len(names))
    action[[n.endswith('forward') for n in names]] = forward
    action[[n.endswith('grasp') for n in names]] = grasp
    time_step = env.step(action)
  moved = float(time_step.observation['registers/r']) * 0.1
  np.testing.assert_equal(moved < -0.3, bool(grasp))
  assert grasp or abs(moved) < 1e-3
