"""A fast learner whose actions depend on everything it has seen.

Every observation changes all later actions, so a run that does not resume
exactly where it was gives other results. As a program, it is
`realab_suite.launchers.train` with this learner.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.lab.experiments import training
from realab_suite.launchers import program
from realab_suite.launchers import train


class FakeLearner:
  """Acts on a blend of all that it has seen."""

  largest_credit = None

  def __init__(self, spec: Any, action_spec: Any, num_envs: int, seed: int):
    options = spec.model_extra or {}
    if options.get('fails'):
      raise errors.SpecError('learner.fails: as it was told to')
    self._action_spec = action_spec
    self._num_envs = num_envs
    self._seed = seed
    self._num_steps = 0
    self._blend = np.zeros(num_envs)
    self.on_step: Callable[[int], None] = lambda step: None
    self.step_types: list[np.ndarray] = []

  def step(self, time_step: Any) -> np.ndarray:
    self.on_step(self._num_steps)
    self._num_steps += 1
    self.step_types.append(np.array(time_step.step_type))
    seen = [
        np.arcsinh(value.reshape(self._num_envs, -1).astype(float)).sum(1)
        for value in time_step.observation.values()
    ]
    self._blend = np.sin(0.7 * self._blend + np.sum(seen, axis=0))
    rng = np.random.default_rng((self._seed, self._num_steps))
    return self._actions(rng.uniform(size=self._num_envs) + self._blend)

  def stack(self, time_step: Any, earlier: Any) -> Any:
    return time_step.observation

  def act(self, observation: Any, key: np.ndarray, greedy: bool) -> np.ndarray:
    count = len(next(iter(observation.values())))
    rng = np.random.default_rng(key)
    noise = 0.0 if greedy else rng.uniform(size=count)
    return self._actions(np.full(count, self._blend.mean()) + noise)

  def settings(self) -> dict[str, Any]:
    return {}

  def metrics(self) -> dict[str, float]:
    return {'blend': float(self._blend.mean()), 'unknown': float('nan')}

  def state(self) -> dict[str, Any]:
    return {'num_steps': self._num_steps, 'blend': self._blend.copy()}

  def set_state(self, state: Any) -> None:
    self._num_steps, self._blend = state['num_steps'], np.array(state['blend'])

  def _actions(self, value: np.ndarray) -> np.ndarray:
    spec = self._action_spec
    if not spec.shape:
      return (abs(value * 1e3).astype(int) % spec.num_values).astype(spec.dtype)
    low, high = np.maximum(spec.minimum, -1.0), np.minimum(spec.maximum, 13.0)
    share = np.abs(np.sin(np.outer(value, 1.0 + np.arange(spec.shape[0]))))
    return (low + (high - low) * share).astype(spec.dtype)


def make(job: Any, batch: Any) -> FakeLearner:
  """Stands in for `training.make_learner`."""
  return FakeLearner(
      job.design.learner, batch.action_spec(), batch.num_envs, job.seed
  )


if __name__ == '__main__':
  training.make_learner = make
  # Its options are not those of its kind.
  training.check_learners = lambda *unused: None
  program.start(train.main)
