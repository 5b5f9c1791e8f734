"""Test that policies have a random stream of their own in each world."""

from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import actors


def _actions(world):
  env = suite.load(
      'collect_apples', 'standard', {'random': 0}, {'world': world}
  )
  actor = actors.make(policies.make('random'), env)
  actor.begin(0)
  time_step = env.reset()
  actions = [actor.act(time_step).tolist() for _ in range(20)]
  env.close()
  return actions


def test_the_actions_of_a_random_policy_follow_from_the_world():
  assert _actions(0) != _actions(1) == _actions(1)
