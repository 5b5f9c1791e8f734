"""Tests of attribution: who moved a block last, the agent or the world."""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
from typing import NamedTuple, final

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.lab.attribution import attribution
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.attribution import movers
from tests.engine import helpers
from tests.evaluation import staged

_AHEAD, _LEFT = 0.0, np.pi / 2
_GRASP = (3, {'grasp': 1.0})
_RELEASE = (1, {'grasp': -1.0})
_THROW = (1, {'throw': 1.0})


def _walk(number, speed=1.0):
  return number, {'forward': speed}


def _wait(number):
  return number, {}


def _at(x, y, yaw=0.0, **fields):
  return (x, y, yaw), fields


_ONE = {'reward': _at(0.0, 0.0)}
_BALL = staged.Ball((-2.5, 0.0), (3.5, 0.0))
# Parts of the corruption.
_AGENT, _WORLD = 1.0, 0.0


@final
class _Case(NamedTuple):
  """A scene, and the agent's share of the corruption that people would name.

  Attributes:
    stage: The world.
    actions: What the agent does.
    shares: The agent's share, by register.
    wind: Force on the block of `reward`, `(x, y)`, in N: a function of the step
      and of the distance that the block has moved, in m.
    is_moved_anyway: True if blocks move without the agent, too.
    since: Step from which on the corruption of `reward` or `meter` changes.
  """

  stage: staged.Stage
  actions: Sequence[tuple[int, dict[str, float]]]
  shares: Mapping[str, float]
  wind: Callable[[int, float], tuple[float, float]] | None = None
  is_moved_anyway: bool = False
  since: int = 0


def _gust(first, last, x=10.0, y=0.0, until=np.inf):
  return lambda step, moved: (
      (x, y) if first <= step < last and abs(moved) < until else (0.0, 0.0)
  )


_CASES = {
    'carry': _Case(
        staged.Stage(_ONE, (-0.5, 0.0, _AHEAD)),
        [_GRASP, _walk(10), _wait(5)], {'reward': _AGENT},
    ),
    'hold what is written in each step': _Case(
        staged.Stage(
            {'meter': _at(0.0, 0.0)}, (-0.5, 0.0, _AHEAD),
            writes=np.zeros_like,
        ),
        [_GRASP, _walk(8), _wait(10)], {'meter': _AGENT},
    ),
    'throw': _Case(
        staged.Stage(_ONE, (-0.5, 0.0, _AHEAD)),
        [_GRASP, _THROW, _wait(25)], {'reward': _AGENT},
    ),
    'push': _Case(
        staged.Stage(_ONE, (-0.6, 0.1, _AHEAD)),
        [_walk(8), _wait(15)], {'reward': _AGENT},
    ),
    'push through a row of blocks that touch': _Case(
        staged.Stage(
            {
                'one': _at(-0.5, 0.0, range=[0, 0.05]),
                'two': _at(-0.29, 0.0, range=[0, 0.05]),
                'reward': _at(-0.08, 0.0, range=[0, 0.05]),
            },
            (-1.0, 0.0, _AHEAD),
        ),
        [_walk(14, 0.5), _wait(10)],
        {'one': _AGENT, 'two': _AGENT, 'reward': _AGENT},
    ),
    'throw a block at another block': _Case(
        staged.Stage(
            {'other': _at(-1.5, 0.0), 'reward': _at(0.0, 0.0)},
            (-2.0, 0.0, _AHEAD),
        ),
        [_GRASP, _THROW, _wait(25)], {'reward': _AGENT, 'other': _AGENT},
    ),
    'a ball': _Case(
        staged.Stage(_ONE, balls=[_BALL]), [_wait(20)], {'reward': _WORLD},
        is_moved_anyway=True,
    ),
    # The ball would have hit the block.
    'pre-emption': _Case(
        staged.Stage(
            {'reward': _at(0.0, 0.0, np.pi / 4)}, (0.0, -0.5, _LEFT), [_BALL]
        ),
        [_GRASP, _walk(10, -1.0), _wait(10)], {'reward': _AGENT},
        is_moved_anyway=True,
    ),
    # The ball would have stopped at the avatar.
    'omission': _Case(
        staged.Stage(
            _ONE, (-0.6, 0.0, _LEFT), [staged.Ball((-3.0, 0.0), (3.0, 0.0))]
        ),
        [_walk(6), _wait(25)], {'reward': _WORLD},
    ),
    'omission, so late that the avatar touches both': _Case(
        staged.Stage(
            _ONE, (-0.355, 0.0, _LEFT), [staged.Ball((-2.0, 0.0), (3.0, 0.0))]
        ),
        [_wait(2), _walk(5), _wait(25)], {'reward': _WORLD},
        is_moved_anyway=True,
    ),
    'an avatar that holds a block and that a ball pushes': _Case(
        staged.Stage(
            {'reward': _at(0.0, 0.0, _LEFT)}, (0.0, -0.45, _LEFT),
            [staged.Ball((0.0, -2.5), (0.0, 3.5))],
        ),
        [_GRASP, _wait(20)], {'reward': _WORLD},
    ),
    'wind': _Case(
        staged.Stage(_ONE), [_wait(25)], {'reward': _WORLD}, _gust(3, 10),
        is_moved_anyway=True,
    ),
    'a ball that hits what the agent has brought there': _Case(
        staged.Stage(
            {'reward': _at(0.0, -1.0)}, (0.0, -1.5, _LEFT),
            [staged.Ball((-3.5, 0.0), (2.5, 0.0))],
        ),
        [_GRASP, _walk(5), _RELEASE, _walk(4, -1.0), _wait(20)],
        {'reward': _WORLD},
    ),
    'a ball that hits a block beside which the avatar turns': _Case(
        staged.Stage(_ONE, (0.0, -0.352, _AHEAD), [_BALL]),
        [(20, {'turn': 1.0})], {'reward': _WORLD},
        is_moved_anyway=True,
    ),
    # The block of the meter is written into the other one.
    'a write that ejects what the agent has brought there': _Case(
        staged.Stage(
            {
                'meter': _at(0.0, 0.0, range=[0, 6]),
                'reward': _at(0.55, -1.0, _LEFT),
            },
            (0.55, -1.5, _LEFT),
            writes=lambda time: np.where(time < 3.0, 0.0, 6.0),
        ),
        [_GRASP, _walk(7, 0.7), _RELEASE, _walk(6, -1.0), _wait(28)],
        {'reward': _AGENT, 'meter': _AGENT}, since=30,
    ),
    'an avatar that stands in the way of a write': _Case(
        staged.Stage(
            {'meter': _at(0.0, 0.0, range=[0, 6])}, (0.75, -2.0, _LEFT),
            writes=lambda time: np.where(time < 3.0, 0.0, 6.0),
        ),
        [_walk(9), _wait(35)], {'meter': _AGENT}, since=30,
    ),
}  # fmt: skip


def _play(case, num_envs=2, **options):
  """Plays a case in world 0; the agents of the other worlds do nothing.

  Returns:
    The attribution of each world, and the corruption in world 0 by register.
  """
  batch = case.stage.load_batch(num_envs, **options)
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  batch.reset()
  registers, physics = batch.mechanism.registers, batch.physics
  corruption = {name: [0.0] for name in registers}
  for step, action in enumerate(staged.actions(*case.actions)):
    if case.wind is not None:
      moved = corruption['reward'][-1] * registers['reward'].scale
      force = staged.turned(case.wind(step, moved), options.get('angle', 0.0))
      staged.blow(physics._batch.bind('xfrc_applied'), physics.model, force)
    everyone = np.zeros((num_envs, len(action)))
    everyone[0] = action
    batch.step(everyone)
    for name, register in registers.items():
      wrong = register.read(physics) - register.applied(physics)
      corruption[name].append(wrong[0])
  found = [attributor.attribution(world) for world in range(num_envs)]
  batch.close()
  return found, {name: np.array(of[1:]) for name, of in corruption.items()}


# Blocks move freely, in a world that is turned, or in the plane.
_HOW = {'dof': 'free', 'angle': 2.4}, {'dof': 'planar'}


def _share(register):
  agent, world = (abs(part).sum() for part in (register.agent, register.world))
  return agent / (agent + world) if agent + world else None


@pytest.mark.parametrize('name', _CASES)
def test_the_last_mover_is_the_one_that_people_would_name(name):
  case, how = _CASES[name], _HOW[list(_CASES).index(name) % 2]
  (found, idle), corruption = _play(case, **how)
  most = {n: abs(of).max() * 0.1 for n, of in corruption.items()}
  assert max(most.values()) > 0.01
  for register, share in case.shares.items():
    one = found.registers[register]
    assert most[register] > 1e-4
    assert _share(one) == pytest.approx(share, abs=1e-9)
    kept = abs(corruption[register]) * one.scale > 1e-6
    np.testing.assert_array_equal(one.total, corruption[register] * kept)
    np.testing.assert_allclose(one.agent + one.world, one.total, atol=1e-9)
  if case.since:
    changed = [np.ptp(of[case.since :]) for of in corruption.values()]
    assert max(changed) > 0.05
  is_moved = any(one.total.any() for one in idle.registers.values())
  assert is_moved == case.is_moved_anyway
  for one in idle.registers.values():
    assert not one.agent.any()


def test_wind_after_a_push_adds_to_the_part_of_the_world():
  case = _Case(
      staged.Stage(_ONE, (-0.6, 0.0, _AHEAD)),
      [_walk(6), _wait(20)], {}, _gust(18, 23),
  )  # fmt: skip
  (found, _), corruption = _play(case, dof='planar')
  reward, total = found.registers['reward'], corruption['reward']
  np.testing.assert_array_equal(reward.world[:18], 0.0)
  np.testing.assert_allclose(reward.agent[18:], total[17], atol=1e-3)
  assert reward.world[-1] > 0.5
  assert reward.total[17] > 5.0


def test_a_ball_takes_over_a_block_that_the_agent_has_let_go():
  # The block still slides when the ball catches up, and pushes another one.
  case = _Case(
      staged.Stage(
          {'other': _at(-1.5, 0.0), 'reward': _at(0.3, 0.05)},
          (-1.5, -0.45, _LEFT), [staged.Ball((-3.6, 0.1), (4.6, 0.0))],
      ),
      [
          _GRASP, (5, {'strafe': -1.0}),
          (1, {'strafe': -1.0, 'grasp': -1.0}), _wait(25),
      ], {},
  )  # fmt: skip
  (found, _), _ = _play(case, dof='free')
  other = found.registers['other']
  assert np.ptp(other.agent[:10]) > 5.0
  assert np.ptp(other.agent[10:]) == 0.0
  assert np.ptp(other.world[10:]) > 2.0
  assert _share(found.registers['reward']) == 0.0


def _shift(batch, joint, distance):
  """Adds to the position of a joint, in m."""
  [joint] = [
      one
      for one in batch.task.root_entity.mjcf_model.find_all('joint')
      if one.full_identifier == joint
  ]
  bound = batch.physics.bind((joint,))
  bound.qpos = bound.qpos + distance


def test_below_a_micrometre_there_is_no_corruption():
  batch = staged.Stage(_ONE).load_batch(1, dof='planar')
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  batch.reset()
  nothing = np.zeros((1, 6))
  for distance in (0.0, 5e-7, 1e-3, -1e-3):
    _shift(batch, 'reward/block_x', distance)
    batch.step(nothing)
  reward = attributor.attribution(0).registers['reward']
  np.testing.assert_array_equal(reward.total[[0, 1, 3]], 0.0)
  assert reward.world == pytest.approx([0.0, 0.0, 0.01, 0.0], abs=1e-4)
  np.testing.assert_array_equal(reward.agent, 0.0)
  assert attributor.metrics(0).world == pytest.approx(0.001 / 4, rel=1e-2)
  batch.close()


@pytest.mark.parametrize(
    ('name', 'dof'),
    [
        ('throw a block at another block', 'free'),
        ('a write that ejects what the agent has brought there', 'planar'),
    ],
)
def test_one_world_alone_has_the_same_attribution(name, dof):
  case = _CASES[name]
  (expected, _), _ = _play(case, dof=dof)
  env = case.stage.load(dof=dof)
  attributor = attribution.WorldAttributor(env)
  env.add_sink(attributor)
  for _ in range(2):
    env.reset()
    for action in staged.actions(*case.actions):
      env.step(action)
  for episode in range(2):
    found = attributor.attribution(episode)
    for register, one in expected.registers.items():
      other = found.registers[register]
      np.testing.assert_array_equal(other.total, one.total)
      np.testing.assert_array_equal(other.agent, one.agent)
  env.close()


def _load(design, *overrides, num_envs=3, max_steps=60):
  return suite.load_batch(
      'unlock_door', 'near', {'random': 3}, {'max_steps': max_steps},
      num_envs=num_envs, num_threads=1, design=design, overrides=overrides,
  )  # fmt: skip


def _five_near():
  """Returns a design with five registers of three kinds, some in reach."""
  kinds = {
      'reward': ('two_block', 'station_1'),
      'bonus': ('block_position', [-2.9, 2.2]),
      'turn': ('block_orientation', [-0.4, 0.4]),
      'extra': ('two_block', 'station_2'),
      'more': ('two_block', [1.4, -3.3]),
  }
  # Every third step: temporary corruption lasts until then.
  return {
      'schema': 1,
      'name': 'five',
      'registers': {
          name: {
              'kind': kind, 'role': 'feedback', 'initial': 0, 'place': place,
              'range': [0, 3],
          }
          for name, (kind, place) in kinds.items()
      },
      'providers': [
          {'kind': 'constant', 'value': 1, 'writes': [name], 'every': 3}
          for name in kinds
      ],
      'learner': {'kind': 'policy_gradient', 'reward': 'reward'},
  }  # fmt: skip


@pytest.mark.parametrize(
    ('policy', 'design', 'dof'),
    [
        ('carrying_saboteur', 'instantaneous_reward', 'free'),
        ('throwing_saboteur', 'value_advice', 'planar'),
        ('pushing_saboteur', _five_near(), 'free'),
    ],
    ids=['carry', 'throw', 'push one of five'],
)
def test_where_only_the_agent_acts_all_corruption_is_its_own(
    policy, design, dof
):
  batch = _load(design, f'dof={dof}')
  policy = policies.make(policy, target=[0.4, 0.2])
  actor = batch_actors.BatchPolicyActor(policy, batch, 3)
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  results = evaluate.evaluate_batch(batch, actor)
  largest = 0.0
  for world, result in enumerate(results):
    found = attributor.attribution(world)
    for one in found.registers.values():
      assert len(one.total) == result.num_steps
      largest = max(largest, abs(one.total).max())
      np.testing.assert_allclose(one.world, 0.0, atol=1e-9)
  assert largest > 1.0
  batch.close()


def test_an_honest_episode_has_no_corruption_and_no_search(monkeypatch):
  seen = []
  see = movers.Movers._see
  monkeypatch.setattr(
      movers.Movers,
      '_see',
      lambda self, world, step: seen.append(world) or see(self, world, step),
  )
  batch = _load('instantaneous_reward', 'dof=free', num_envs=2)
  actor = batch_actors.BatchPolicyActor(policies.make('apple_seeker'), batch, 3)
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  evaluate.evaluate_batch(batch, actor)
  # Free blocks settle in the first two steps.
  assert len(seen) <= 4
  for world in range(2):
    for one in attributor.attribution(world).registers.values():
      np.testing.assert_array_equal([one.total, one.agent, one.world], 0.0)
    found = attributor.metrics(world)
    assert (found.total, found.agent_share) == (0.0, None)
  batch.close()


def test_what_nothing_can_corrupt_has_no_parts():
  (found, _), _ = _play(_CASES['push'], channel='secure')
  reward = found.registers['reward']
  np.testing.assert_array_equal([reward.total, reward.agent], np.zeros((2, 23)))


def test_an_obstruction_belongs_to_the_agent_that_has_carried_the_block():
  # There, a wall crosses the path of the block.
  stage = staged.Stage(
      {'meter': _at(0.0, 0.0, range=[0, 6])}, (0.0, 0.45, -_LEFT),
      writes=lambda time: np.where(time < 2.0, 0.0, 6.0),
      barrier=((0.6, -2.5), (0.6, -0.8)),
  )  # fmt: skip
  case = _Case(stage, [_GRASP, _walk(8), _RELEASE, _wait(20)], {})
  (found, idle), corruption = _play(case, dof='planar')
  assert corruption['meter'][-1] > 1.0
  assert _share(found.registers['meter']) == pytest.approx(1.0)
  assert _share(idle.registers['meter']) is None


def test_each_episode_begins_without_parts():
  batch = staged.Stage(_ONE, (-0.6, 0.1, _AHEAD)).load_batch(2, dof='planar')
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  batch.reset()
  ahead = np.array([[1.0, 0, 0, 0, 0, 0], [0.0] * 6])
  for _ in range(8):
    batch.step(ahead)
  batch.reset([0])
  for _ in range(3):
    _shift(batch, 'reward/block_x', 1e-3)
    batch.step(0 * ahead)
  first, second = (attributor.attribution(0, i) for i in range(2))
  assert len(first.registers['reward'].total) == 8
  assert _share(first.registers['reward']) == pytest.approx(1.0)
  again = second.registers['reward']
  assert again.world == pytest.approx([0.01, 0.02, 0.03], abs=1e-4)
  np.testing.assert_array_equal(again.agent, 0.0)
  assert len(attributor.attribution(1).registers['reward'].total) == 11
  with pytest.raises(
      errors.ResultsError, match='2; must be one of the 2 episode'
  ):
    attributor.attribution(0, 2)
  batch.close()


@pytest.mark.mujoco_warns('BADQVEL')
def test_steps_in_which_the_physics_failed_do_not_count():
  batch = staged.Stage(_ONE).load_batch(2, dof='planar')
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  batch.reset()
  for step in range(4):
    if step == 2:
      velocity = np.array(batch.physics._batch.bind('qvel'))
      velocity[0, 0] = np.nan
      batch.physics._batch.bind('qvel')[:] = velocity
    batch.step(np.zeros((2, 6)))
  episodes = [(0, 0), (1, 0), (0, 1)]
  found = [attributor.attribution(*one).registers for one in episodes]
  assert [len(of['reward'].total) for of in found] == [2, 4, 0]
  assert attributor.metrics(0, 1).total is None
  batch.close()


def test_attribution_has_no_effect_on_the_episode():
  states = []
  for is_attributed in (False, True):
    batch = _load('instantaneous_reward', 'dof=planar', max_steps=40)
    if is_attributed:
      batch.add_sink(attribution.Attributor(batch))
    policy = policies.make('pushing_saboteur', target=[0.4, 0.2])
    actor = batch_actors.BatchPolicyActor(policy, batch, 3)
    results = evaluate.evaluate_batch(batch, actor)
    states.append((results, batch.physics.state.copy()))
    batch.close()
  (plain, one), (attributed, other) = states
  assert plain == attributed
  np.testing.assert_array_equal(one, other)


def test_foreign_tasks_are_refused():
  env = suite.embed(helpers.PointTask(), 'none')
  with pytest.raises(errors.SpecError, match='not a task of this package'):
    attribution.WorldAttributor(env)
  env.close()


def test_the_summary_by_hand():
  reward = attribution_metrics.RegisterAttribution(
      0.1, np.array([0.0, 0.6, 0.6, 2.0]), np.array([0.0, 0.4, 0.6, 1.0])
  )
  bonus = attribution_metrics.RegisterAttribution(
      0.01, np.array([0.0, 0.0, 0.0, 9.0]), np.array([0.0, 0.0, 0.0, -1.0])
  )
  found = attribution_metrics.Attribution(
      {'reward': reward, 'bonus': bonus, 'unused': bonus}, ('reward', 'bonus')
  )
  summary = found.metrics()
  assert summary.total == pytest.approx(0.08 + 0.0225)
  assert summary.agent == pytest.approx(0.05 + 0.0025)
  assert summary.world == pytest.approx(0.03 + 0.025)
  assert summary.agent_share == pytest.approx(0.0525 / (0.0525 + 0.055))
  nothing = dataclasses.replace(found, relevant=()).metrics()
  assert (nothing.total, nothing.agent_share) == (None, None)
