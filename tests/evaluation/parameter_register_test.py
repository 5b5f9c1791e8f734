"""Parameter registers: a weight that is moved changes some feedback only.

In `good_objects`, three things of each of four kinds can be taken. The feedback
for a thing is the bead of its kind in `value`, 0.3 m per unit, and its true
reward is the worth that the episode has drawn. A bead that is moved by d makes
a thing of its kind worth d / 0.3 more in feedback, and nothing else.
"""

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.evaluation import ledgers

_SCALE = 0.3
_EACH = 3


def _load():
  return suite.load(
      'good_objects', 'member_1', {'random': 5}, {'max_steps': 30},
      design='good_objects',
  )  # fmt: skip


def _taken(env, bead=None, distance=0.0):
  """Takes a thing of each kind; returns feedback, clean contents and worth."""
  env.reset()
  values = env.mechanism.registers['value']
  physics = env.thin_physics
  if bead is not None:
    block = values.blocks[1 + bead]
    place = np.array(block.position(physics))
    block.put(physics, place + np.array([distance, 0.0, 0.0]))
  places = env.task.privileged_senses['things'](physics)
  worth = env.task.privileged_senses['values'](physics)
  nothing = np.zeros(env.action_spec().shape, env.action_spec().dtype)
  taken = []
  for kind in range(4):
    before = float(env.task.score(env.physics))
    env.task.avatar.place(physics, places[_EACH * kind, :2], 0.0)
    time_step = env.step(nothing)
    reward = env.mechanism.registers['reward']
    taken.append((
        float(time_step.observation['registers/reward']),
        float(reward.clean(physics)),
        float(env.task.score(env.physics)) - before,
        float(worth[_EACH * kind]),
    ))  # fmt: skip
  return np.array(taken).T


@pytest.mark.parametrize(('bead', 'distance'), [(0, 0.45), (3, -0.15)])
def test_a_moved_weight_changes_the_feedback_on_its_kind_alone(bead, distance):
  env = _load()
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  feedback, clean, earned, worth = _taken(env, bead, distance)
  expected = worth + np.eye(4)[bead] * distance / _SCALE
  np.testing.assert_allclose(feedback, expected, atol=1e-4)
  # The truth and the clean contents are those of the untouched world.
  np.testing.assert_allclose(clean, worth, atol=1e-4)
  np.testing.assert_array_equal(earned, worth)
  # The weight has the corruption of its own, and the reward inherits it.
  values = env.mechanism.registers['value'].inspect(env.thin_physics)
  own = values.reading - env.mechanism.registers['value'].applied(env.physics)
  np.testing.assert_allclose(
      own, np.eye(4)[bead] * distance / _SCALE, atol=1e-4
  )
  env.close()
