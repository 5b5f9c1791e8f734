"""Tests for plans of macro-actions."""

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import episodes
from realab_suite.lab.audit import macros

_KEY = np.zeros(2, np.uint64)
_DESIGN = 'instantaneous_reward'
_STEPS = 60


def _world(world=0, variation='near'):
  env = suite.load(
      'unlock_door', variation, {'random': 4}, {'world': world}, design=_DESIGN
  )
  env.reset()
  return env, aiming.targets(env, ['reward', 'score'])


def _policy(plan, env, blocks):
  return episodes.policy_of(plan, env, blocks, 'apple_seeker')


def _positions(env, blocks):
  return aiming.positions(
      env.physics, [block.block_in(env) for block in blocks]
  )


def _actions(env, policy, num_steps=_STEPS):
  """Plays a policy; returns its actions and the observations."""
  env.rewind(0)
  time_step, state, taken, seen = env.reset(), policy.initial_state(()), [], []
  controls = policy.action_set.table(
      tuple(n.rpartition('/')[2] for n in env.action_spec().name.split('\t'))
  )
  for step in range(num_steps):
    action, state = policy.step(
        time_step.observation, np.asarray(step == 0), _KEY, state
    )
    seen.append(time_step.observation)
    taken.append(int(action))
    time_step = env.step(controls[int(action)])
  return taken, seen


@pytest.mark.parametrize(
    ('verb', 'saboteur'),
    [
        ('carry', 'carrying_saboteur'),
        ('throw', 'throwing_saboteur'),
        ('push', 'pushing_saboteur'),
    ],
)
def test_a_plan_of_one_macro_action_is_a_saboteur(verb, saboteur):
  env, blocks = _world()
  plan = macros.of_saboteur(verb, 0, np.pi)
  own, _ = _actions(env, _policy(plan, env, blocks))
  env.rewind(0)
  env.reset()
  x, y = _positions(env, blocks[:1])[0]
  other = policies.make(
      saboteur, target=(float(x), float(y)), direction=(-1.0, 0.0)
  )
  assert own == _actions(env, other)[0]
  assert len(set(own)) > 2


def test_worlds_of_a_batch_follow_their_own_plans():
  plans = [
      macros.Plan(
          np.array([2, 4]), np.array([1, 0]), np.array([0.3, 0.0]),
          np.array([0.5, 0.0]), np.array([4, 20]),
      ),
      macros.of_saboteur('throw', 0, np.pi),
      macros.Plan(
          np.array([1, 0]), np.array([0, 3]), np.array([1.0, 0.0]),
          np.zeros(2), np.array([3, 5]),
      ),
  ]  # fmt: skip
  alone, observed, starts = [], [], []
  for i, plan in enumerate(plans):
    env, blocks = _world(i)
    starts.append(_positions(env, blocks))
    taken, seen = _actions(env, _policy(plan, env, blocks))
    alone.append(taken)
    observed.append(seen)
  together = macros.MacroPolicy(
      macros.stack(plans),
      np.stack(starts),
      np.array([block.code for block in blocks]),
      policies.make('apple_seeker'),
  )
  state = together.initial_state((3,))
  for step in range(_STEPS):
    seen = {
        key: np.stack([world[step][key] for world in observed])
        for key in observed[0][step]
    }
    action, state = together.step(
        seen, np.full(3, step == 0), np.stack([_KEY] * 3), state
    )
    assert action.tolist() == [taken[step] for taken in alone]
  assert all(len(set(taken)) > 2 for taken in alone)


def test_a_throw_ends_with_the_release_and_other_blocks_are_let_go():
  env, blocks = _world()
  plan = macros.Plan(
      np.array([2, 2]), np.array([0, 1]), np.array([np.pi, 0.0]),
      np.zeros(2), np.array([3, macros.FOREVER]),
  )  # fmt: skip
  taken, seen = _actions(env, _policy(plan, env, blocks), 120)
  holds = [float(one['senses/holding'][0]) > 0 for one in seen]
  names = [policies.make('no_op').action_set.actions[i][0] for i in taken]
  dropped = names.index('let_go')
  assert sum(holds[: dropped + 1]) == 4
  assert True in holds[dropped + 2 :]
  assert plan.words(['a', 'b']) == [
      'carry a towards 180 degrees for 3 steps',
      'carry b towards 0 degrees',
  ]


def test_a_block_is_moved_before_the_task_is_done():
  env, blocks = _world()
  plan = macros.then_solve(macros.of_saboteur('carry', 0, np.pi), 5)
  taken, seen = _actions(env, _policy(plan, env, blocks), 90)
  holds = [float(one['senses/holding'][0]) > 0 for one in seen]
  names = [policies.make('no_op').action_set.actions[i][0] for i in taken]
  assert sum(holds[: names.index('let_go') + 1]) == 6
  assert not any(holds[names.index('let_go') + 1 :])
  assert plan.words(['a']) == [
      'carry a towards 180 degrees for 5 steps',
      'do the task',
  ]
