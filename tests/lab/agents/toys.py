"""Toy environments of many worlds, with specs of their own."""

import dataclasses
from typing import Any, NamedTuple

from dm_env import specs
import numpy as np


class ToyStep(NamedTuple):
  step_type: np.ndarray
  discount: np.ndarray
  observation: dict[str, np.ndarray]


@dataclasses.dataclass
class Bandit:
  """Shows one of three things; the best action is the one of that number.

  `feedback` is the value of a register after a step. `drift` is added to it
  from step to step, in standard deviations, as if its base block moved all the
  time. With `is_delayed`, the feedback comes one step later; the first step of
  an episode shows `NO_FEEDBACK`. Episodes have `length` steps, the one that
  begins them not counted; 0 for one without end.
  """

  NO_FEEDBACK = -9.0

  num_envs: int
  num_actions: int = 3
  seed: int = 0
  queries: tuple[str, ...] = ()
  shows: str = 'reward'
  drift: float = 0.0
  is_delayed: bool = False
  length: int = 0

  def __post_init__(self) -> None:
    self._generator = np.random.default_rng(self.seed)
    self.scores: list[float] = []
    self.feedback: list[float] = []
    self._offset = np.zeros(self.num_envs)
    self._num_steps = 0
    self._waiting = np.full(self.num_envs, self.NO_FEEDBACK)

  def observation_spec(self) -> dict[str, specs.Array]:
    return {
        'thing': specs.BoundedArray((), np.int32, 0, self.num_actions - 1),
        'registers/feedback': specs.Array((), np.float64),
    }

  def action_spec(self) -> specs.Array:
    if not self.queries:
      return specs.DiscreteArray(self.num_actions)
    size = len(self.queries) + 1
    names = [*(f'query/{name}' for name in self.queries), 'dmlab_like/v1']
    return specs.BoundedArray(
        (size,), np.float64, 0.0, self.num_actions - 1.0, '\t'.join(names)
    )

  def reset(self) -> ToyStep:
    self._num_steps = 0
    self._waiting = np.full(self.num_envs, self.NO_FEEDBACK)
    return self._show(np.zeros(self.num_envs), 0)

  def step(self, actions: Any) -> ToyStep:
    actions = np.asarray(actions)
    if self.length and self._num_steps == self.length:
      return self.reset()
    self._num_steps += 1
    spec = self.action_spec()
    assert actions.shape == (self.num_envs, *spec.shape)
    assert actions.dtype == spec.dtype
    taken = actions if not self.queries else actions[:, -1]
    asked = actions[:, np.newaxis] if not self.queries else actions
    self.scores.append(float(np.mean(taken == self._thing)))
    good = asked == self._thing[:, np.newaxis]
    feedback = good[:, 0].astype(float)
    if len(self.queries) == 2:
      feedback -= good[:, 1]
    if self.shows == 'demonstration':
      # A register is never read exactly.
      error = self._generator.uniform(-0.4, 0.4, self.num_envs)
      feedback = self._thing + error
    if self.is_delayed:
      feedback, self._waiting = self._waiting, feedback
    self.feedback.append(float(feedback.mean()))
    if self.drift:
      self._offset += self._generator.normal(0.0, self.drift, self.num_envs)
    is_last = self.length and self._num_steps == self.length
    return self._show(feedback + self._offset, 2 if is_last else 1)

  def _show(self, feedback: np.ndarray, step_type: int) -> ToyStep:
    self._thing = self._generator.integers(self.num_actions, size=len(feedback))
    return ToyStep(
        np.full(self.num_envs, step_type),
        np.ones(self.num_envs),
        {'thing': self._thing.astype(np.int32), 'registers/feedback': feedback},
    )


@dataclasses.dataclass
class Aim:
  """Shows a number; feedback falls with the distance of the action from it."""

  num_envs: int
  as_pixels: bool = False

  def __post_init__(self) -> None:
    self._generator = np.random.default_rng(0)
    self.scores: list[float] = []

  def observation_spec(self) -> dict[str, specs.Array]:
    spec: dict[str, specs.Array] = {'reward': specs.Array((), np.float64)}
    if self.as_pixels:
      spec['camera'] = specs.BoundedArray((4, 4, 3), np.uint8, 0, 255)
    else:
      spec['number'] = specs.BoundedArray((1,), np.float32, -1.0, 1.0)
    return spec

  def action_spec(self) -> specs.Array:
    return specs.BoundedArray((1,), np.float64, 0.0, 10.0, 'where')

  def reset(self) -> ToyStep:
    return self._show(np.zeros(self.num_envs), 0)

  def step(self, actions: np.ndarray) -> ToyStep:
    assert (actions >= 0.0).all()
    assert (actions <= 10.0).all()
    feedback = -np.abs(actions[:, 0] - 5.0 - 4.0 * self._number)
    self.scores.append(float(feedback.mean()))
    return self._show(feedback, 1)

  def _show(self, feedback: np.ndarray, step_type: int) -> ToyStep:
    self._number = self._generator.uniform(-1.0, 1.0, len(feedback))
    observation = {'reward': feedback}
    if self.as_pixels:
      gray = (127.5 + 127.5 * self._number).astype(np.uint8)
      observation['camera'] = np.broadcast_to(
          gray[:, np.newaxis, np.newaxis, np.newaxis], (len(gray), 4, 4, 3)
      )
    else:
      observation['number'] = self._number[:, np.newaxis].astype(np.float32)
    return ToyStep(
        np.full(self.num_envs, step_type), np.ones(self.num_envs), observation
    )
