"""Benchmark of a control step of one world against raw MuJoCo.

`python -m benchmarks.step` plays an episode of Unlock Door with two free
two-block registers and random actions. The raw engine replays it on a copy of
the state: the same substeps, the same writes of controls and blocks, one update
of derived quantities at the end, and nothing else. Both have to end in the same
state, bit for bit, in every round.
"""

from collections.abc import Iterator, Sequence
import contextlib
import copy
import dataclasses
import itertools
import time
from typing import Any, final
from unittest import mock

import mujoco
import numpy as np

from benchmarks import recorded
from benchmarks import timing
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import rays

_STEPS = 200
_ROUNDS = 25
_SEED = 0
# Not reached yet; README.md lists the attempts.
_TARGET = 1.3


@final
@dataclasses.dataclass(frozen=True)
class RawEpisode:
  """A recorded episode, which the raw engine replays.

  Attributes:
    model: Compiled model of the environment.
    data: Copy of the state; the views in `steps` are of its arrays.
    start: State at the start of the episode.
    steps: Phases of each control step.
  """

  model: Any
  data: Any
  start: Any
  steps: list[list[recorded.Phase]]

  def replay(self) -> float:
    """Runs the episode and returns the seconds per control step."""
    model, data = self.model, self.data
    mujoco.mj_copyData(data, model, self.start)
    began = time.perf_counter()
    for phases in self.steps:
      for writes, num_substeps in phases:
        for view, value in writes:
          view[:] = value
        mujoco.mj_step(model, data, num_substeps)
      mujoco.mj_kinematics(model, data)
    return (time.perf_counter() - began) / len(self.steps)


def _play(env: environment.Environment, actions: np.ndarray) -> float:
  """Plays the first episode and returns the seconds per step."""
  env.rewind()
  env.reset()
  began = time.perf_counter()
  for action in actions:
    env.step(action)
  return (time.perf_counter() - began) / len(actions)


def _record(env: environment.Environment, actions: np.ndarray) -> RawEpisode:
  """Plays the first episode and records it for the raw engine."""
  env.rewind()
  env.reset()
  physics = env.physics
  model, true = physics.model.ptr, physics.data.ptr
  start = copy.copy(true)
  raw = copy.copy(true)
  steps = recorded.record(
      env,
      actions,
      lambda name: getattr(raw, name),
      lambda name: getattr(true, name),
      lambda num_substeps: mujoco.mj_step(model, raw, num_substeps),
  )
  return RawEpisode(model, raw, start, steps)


def _check_same(env: environment.Environment, raw: RawEpisode) -> None:
  """Raises an error if the raw engine has reached another state."""
  size = mujoco.mj_stateSize(raw.model, mujoco.mjtState.mjSTATE_PHYSICS)
  states = []
  for data in (env.physics.data.ptr, raw.data):
    state = np.empty(size)
    mujoco.mj_getState(raw.model, data, state, mujoco.mjtState.mjSTATE_PHYSICS)
    states.append(state.tobytes())
  if states[0] != states[1]:
    raise RuntimeError(
        'the raw engine and the environment differ in the final state, so their'
        ' times cannot be compared'
    )


@contextlib.contextmanager
def _no_rays(env: environment.Environment) -> Iterator[None]:
  """Returns a context in which the avatar's rays stay constant."""
  sense = env.task.avatar.rays
  sensed = sense.sense(env.physics)
  calls = itertools.count()

  def sense_same(physics: Any) -> Any:
    del physics
    next(calls)
    return sensed

  with mock.patch.object(sense, 'sense', sense_same):
    yield
  if not next(calls):
    raise RuntimeError('the avatar did not call its ray sense')


def _sense_rays(env: environment.Environment) -> float:
  """Casts the avatar's rays and returns the seconds per call."""
  sense = env.task.avatar.rays.sense
  began = time.perf_counter()
  for _ in range(_STEPS):
    sense(env.physics)
  return (time.perf_counter() - began) / _STEPS


def _cast_raw(env: environment.Environment) -> float:
  """Casts the same rays in raw MuJoCo and returns the seconds per call."""
  with mock.patch.object(rays, 'cast', wraps=rays.cast) as cast:
    env.task.avatar.rays.sense(env.physics)
  _, origin, directions, carrier = cast.call_args.args
  model, data = env.physics.model.ptr, env.physics.data.ptr
  number = len(directions)
  origin, directions = np.array(origin), directions.ravel()
  geoms, distances = np.empty(number, np.int32), np.empty(number)
  began = time.perf_counter()
  for _ in range(_STEPS):
    mujoco.mj_multiRay(
        model, data, origin, directions, None, 1, carrier, geoms, distances,
        None, number, mujoco.mjMAXVAL,
    )  # fmt: skip
  return (time.perf_counter() - began) / _STEPS


def _break_down(
    env: environment.Environment, actions: np.ndarray, raw_us: float
) -> list[timing.Figure]:
  """Returns the time of each part of a step, including the timers."""
  task, phases = env.task, env.mechanism.phases
  parts = (
      ('substeps', env.physics, 'advance'),
      ('poses', env.physics, 'update_poses'),
      ('motors and hand', task.avatar, 'apply_action'),
      ('events of the world', task, 'latch_events'),
      ('meters', phases, 'update_meters'),
      ('providers', phases, 'update_providers'),
      ("agent's reads", phases, 'read_for_agent'),
      ('rays', task.avatar.rays, 'sense'),
      ('other senses', task, 'senses'),
      ('the rest', env, 'step'),
  )
  env.rewind()
  env.reset()

  def play() -> None:
    for action in actions:
      env.step(action)

  figures = []
  for label, (seconds, number) in timing.split(parts, play).items():
    us = np.array([1e6 * seconds / len(actions)])
    calls = f'{number / len(actions):g} a step'
    figures.append(
        timing.Figure(f'  {label}, {calls}', us, 'us', ratios=us / raw_us)
    )
  return figures


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  env = suite.load(
      'unlock_door',
      'standard',
      {'random': _SEED},
      design='instantaneous_reward',
  )
  spec = env.action_spec()
  actions = np.random.default_rng(_SEED).uniform(
      spec.minimum, spec.maximum, (_STEPS, *spec.shape)
  )
  raw = _record(env, actions)

  def play_blind() -> float:
    with _no_rays(env):
      return _play(env, actions)

  def replay() -> float:
    seconds = raw.replay()
    _check_same(env, raw)
    return seconds

  seconds = timing.time_rounds(
      {
          'blind': play_blind,
          'raw': replay,
          'seeing': lambda: _play(env, actions),
          'rays': lambda: _sense_rays(env),
          'raw rays': lambda: _cast_raw(env),
      },
      rounds,
  )
  us = {name: 1e6 * taken for name, taken in seconds.items()}
  timing.report([
      timing.Figure(
          'control step, rays off', us['blind'], 'us', _TARGET, True,
          us['blind'] / us['raw'],
      ),
      timing.Figure(
          'control step, rays on', us['seeing'], 'us',
          ratios=us['seeing'] / (us['raw'] + us['raw rays']),
      ),
      timing.Figure(
          'rays alone', us['rays'], 'us', ratios=us['rays'] / us['raw rays']
      ),
      timing.Figure('raw control step', us['raw'], 'us'),
      timing.Figure('raw rays', us['raw rays'], 'us'),
      timing.Figure('control steps, rays off', 1e6 / us['blind'], '/s'),
      timing.Figure('control steps, rays on', 1e6 / us['seeing'], '/s'),
      *_break_down(env, actions, float(np.median(us['raw']))),
  ])  # fmt: skip
  env.close()


if __name__ == '__main__':
  main()
