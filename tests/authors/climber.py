"""An author's learner, with options of its own and without networks.

It maximises one register and minimises another one, and remembers how well each
action went on average.
"""

from typing import Any, Literal

import numpy as np

from realab_suite.feedback import objectives
from realab_suite.lab import agents
from realab_suite.lab.agents import base

KIND = 'climber'


class ClimberOptions(base.Options):
  """Options of a climber.

  Attributes:
    lures: Name of the register that it learns from.
    daring: Chance of a random action.
  """

  kind: Literal['climber']
  lures: str
  daring: float = 0.3


@objectives.OBJECTIVES.add(KIND)
def _objective(options: Any) -> dict[str, Any]:
  return {'kind': 'return', 'registers': {options['lures']: 2.0}}


@agents.LEARNERS.add(KIND)
class Climber(agents.Learner):
  """Takes the action whose readings were the largest on average."""

  OPTIONS = ClimberOptions
  READS = 'lures'
  NEEDS_ACTION_SET = True

  def __init__(self, *arguments: Any) -> None:
    super().__init__(*arguments)
    num_actions = self._controls.size
    self.networks = {
        'sums': np.zeros(num_actions),
        'counts': np.ones(num_actions),
    }

  def _choose(self, observation, keys, greedy):
    generator = np.random.default_rng([int(word) for word in keys['act']])
    means, num_envs = self._means(), len(next(iter(observation.values())))
    best = np.full(num_envs, np.argmax(means))
    drawn = generator.integers(len(means), size=num_envs)
    dares = generator.random(num_envs) < self._options.daring
    return {'action': best if greedy else np.where(dares, drawn, best)}

  def _observe(self, transition, observation):
    valid = transition['is_valid']
    actions = transition['choice']['action'][valid]
    readings = transition['reading'][valid]
    size = len(self._means())
    self.networks = {
        'sums': self.networks['sums'] + np.bincount(actions, readings, size),
        'counts': self.networks['counts'] + np.bincount(actions, None, size),
    }
    self._num_updates += 1
    self._metrics = {'best': float(self._means().max())}

  def _means(self):
    return np.asarray(self.networks['sums'] / self.networks['counts'])
