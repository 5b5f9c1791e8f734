"""Benchmark of a batch of worlds against MuJoCo's own batch engine.

`python -m benchmarks.batch` steps 256 worlds of Unlock Door with two free
two-block registers, rays, a ledger and random actions that use the hand, on all
processors. MuJoCo's `Batch` replays the steps from a copy of the state: the
same substeps, the same writes as assignments to whole arrays, and one update of
poses and the same rays by a second `Batch` without contacts. Both have to end
in the same state, bit for bit, in every round.

The stock contestant is a `composer.Environment` of dm_control with the same
world and registers. It compiles the model for each episode, the avatar's senses
are observables, and the task writes both registers after each step. It has no
ledger.

The benchmark is repeated with planar registers and with blocks that sleep, each
against a stock environment with registers of the same kind. The target for the
fastest of them, planar blocks that sleep, is 15 times the throughput of the
stock environment.

A third of the rounds measures how costs grow with the numbers of worlds and
registers.
"""

from collections.abc import Callable, Mapping, Sequence
import copy
import dataclasses
import functools
import time
from typing import Any, final
from unittest import mock

from dm_control import composer
from dm_control.composer.observation import observable
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from benchmarks import batch_growth
from benchmarks import recorded
from benchmarks import timing
from benchmarks import worlds
from realab_suite.engine import batch_environment
from realab_suite.engine import seeding
from realab_suite.entities import avatars
from realab_suite.feedback import assembly
from realab_suite.feedback import specs
from realab_suite.tasks import apple_rooms
from realab_suite.tasks import unlock_door

_STEPS = 20
_STOCK_STEPS = 100
_ROUNDS = 8

# Degrees of freedom of the blocks, and whether they sleep, by label.
_KINDS = {
    'free': ('free', False),
    'free, asleep': ('free', True),
    'planar': ('planar', False),
    'planar, asleep': ('planar', True),
}
_FASTEST = 'planar, asleep'

# At least 0.85 of the throughput of the raw engine.
_MAX_LOST = 15.0
# At least 15 times the throughput of stock Composer.
_MAX_OF_STOCK = 100 / 15
_RESET_TARGET_MS = 0.2

_STAGE = int(mujoco.mjtStage.mjSTAGE_POS)

Rays = tuple[np.ndarray, np.ndarray, int]
"""Origins, directions and the body that rays pass through."""


@final
@dataclasses.dataclass(frozen=True)
class RawSteps:
  """Recorded steps of a batch, which the raw engine replays.

  Attributes:
    batch: Batch that steps the worlds; the views in `steps` are of its arrays.
    ray_batch: Batch without contacts and constraints, for poses and rays.
    start: State before the first step.
    steps: Phases of each control step.
    rays: Rays at the end of each control step.
  """

  batch: mujoco_batch.Batch
  ray_batch: mujoco_batch.Batch
  start: np.ndarray
  steps: list[list[recorded.Phase]]
  rays: list[Rays]

  def replay(self) -> float:
    """Runs the steps and returns the seconds per control step."""
    batch, ray_batch = self.batch, self.ray_batch
    batch.state[:] = self.start
    began = time.perf_counter()
    for phases, (origins, directions, carrier) in zip(
        self.steps, self.rays, strict=True
    ):
      for writes, num_substeps in phases:
        for view, value in writes:
          view[:] = value
        batch.step(nstep=num_substeps)
      ray_batch.state[:] = batch.state
      ray_batch.forward(stage=_STAGE)
      ray_batch.ray(origins, directions, bodyexclude=carrier)
    return (time.perf_counter() - began) / len(self.steps)


def _sense(avatar: avatars.Avatar, name: str) -> Callable[[Any], np.ndarray]:
  """Returns a function of the physics that computes one sense."""
  return lambda physics: avatar.senses(physics, [name], (1, 1))[name]


@final
class StockTask(composer.Task):
  """Unlock Door with two registers, as a task for stock Composer."""

  def __init__(self, dof: str) -> None:
    self._world = unlock_door.UnlockDoor()
    design = specs.load('instantaneous_reward', (f'dof={dof}',))
    arena = self._world.root_entity
    self._registers = {}
    for name, spec in design.registers.items():
      register = assembly.make_register(name, spec, design)
      place = assembly.find_place(name, spec.place, arena.places)
      assembly.attach(register, arena, place)
      self._registers[name] = register
    avatar = self._world.avatar
    avatar.make_graspable(
        [b for register in self._registers.values() for b in register.blocks]
    )
    self._senses = {
        name: observable.Generic(_sense(avatar, name))
        for name in (*avatars.PROPRIOCEPTION, 'ray_distances', 'ray_classes')
    }
    reading = self._registers['reward'].observables.reading
    for part in (reading, *self._senses.values()):
      part.enabled = True
    self.control_timestep = self._world.control_timestep

  @property
  def root_entity(self) -> composer.Entity:
    return self._world.root_entity

  @property
  def task_observables(self) -> Any:
    return self._senses

  def action_spec(self, physics: Any) -> Any:
    return self._world.action_spec(physics)

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self._world.initialize_episode(physics, random_state)

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    self._world.before_step(physics, action, random_state)

  def after_step(self, physics: Any, random_state: Any) -> None:
    self._world.after_step(physics, random_state)
    self._registers['score'].write(physics, self._world.score(physics))
    self._registers['reward'].write(physics, self._world.get_reward(physics))

  def get_reward(self, physics: Any) -> Any:
    return self._world.get_reward(physics)

  def should_terminate_episode(self, physics: Any) -> bool:
    return bool(self._world.should_terminate_episode(physics))


@final
class _Stock:
  """Contestant with one world in a stock `composer.Environment`."""

  def __init__(self, dof: str) -> None:
    self._env = composer.Environment(StockTask(dof), random_state=worlds.SEED)
    spec = self._env.action_spec()
    self._actions = np.random.default_rng(worlds.SEED).uniform(
        spec.minimum, spec.maximum, (_STOCK_STEPS, *spec.shape)
    )

  def reset(self) -> float:
    """Begins an episode and returns the seconds that it takes."""
    began = time.perf_counter()
    self._env.reset()
    return time.perf_counter() - began

  def step(self) -> float:
    """Plays an episode and returns the seconds per step."""
    self._env.reset()
    began = time.perf_counter()
    for action in self._actions:
      self._env.step(action)
    return (time.perf_counter() - began) / len(self._actions)


def _reset(env: batch_environment.BatchEnvironment) -> float:
  """Begins new episodes and returns the seconds that this takes."""
  began = time.perf_counter()
  env.reset()
  return time.perf_counter() - began


def _record(
    env: batch_environment.BatchEnvironment, actions: np.ndarray
) -> RawSteps:
  """Plays the first episodes and records them for the raw engine."""
  env._episodes[:] = -1
  env.reset()
  physics = env.physics
  model, true = physics.model.ptr, physics._batch
  still = copy.copy(physics.model)
  still.opt.disableflags = physics._poses.model.opt.disableflags
  raw, ray_batch = (
      mujoco_batch.Batch(each, env.num_envs, true.nthread)
      for each in (model, still.ptr)
  )
  start = true.state.copy()
  raw.state[:] = start
  rays: list[Rays] = []
  cast = physics.cast_rays

  def cast_both(origins: Any, directions: Any, carrier: int) -> Any:
    rays.append((origins[:, np.newaxis, :].copy(), directions.copy(), carrier))
    return cast(origins, directions, carrier)

  with mock.patch.object(physics, 'cast_rays', cast_both):
    steps = recorded.record(
        env,
        actions,
        raw.bind,
        true.bind,
        lambda num_substeps: raw.step(nstep=num_substeps),
    )
  return RawSteps(raw, ray_batch, start, steps, rays)


def _check_same(env: batch_environment.BatchEnvironment, raw: RawSteps) -> None:
  """Raises an error if the raw engine has reached another state."""
  for name in ('qpos', 'qvel', 'time', 'qacc_warmstart'):
    true, other = env.physics._batch.bind(name), raw.batch.bind(name)
    if true.tobytes() != other.tobytes():
      raise RuntimeError(
          f'the raw engine and the environment differ in {name}, so their times'
          ' cannot be compared'
      )


def _break_down_step(
    env: batch_environment.BatchEnvironment,
    actions: np.ndarray,
    raw_us: float,
) -> list[timing.Figure]:
  """Returns the time of each part of a step, including the timers."""
  task, phases, physics = env.task, env.mechanism.phases, env.physics
  parts = (
      ('substeps', physics, 'advance'),
      ('poses', physics, 'forward'),
      ('motors and hand', task.avatar, 'apply_action'),
      ('events of the world', task, 'latch_events'),
      ('meters', phases, 'update_meters'),
      ('providers', phases, 'update_providers'),
      ("agent's reads", phases, 'read_for_agent'),
      ('casting rays', physics, 'cast_rays'),
      ('the rest of rays', task.avatar.rays, 'sense'),
      ('other senses', task, 'senses'),
      ('ledger', env, '_notify'),
      ('the rest', env, 'step'),
  )
  env._episodes[:] = -1
  env.reset()

  def play() -> None:
    for action in actions:
      env.step(action)

  split = timing.split(parts, play)
  unit = len(actions) * env.num_envs
  return [
      timing.Figure(
          f'  {label}, {calls / len(actions):g} a step',
          np.array([1e6 * seconds / unit]),
          'us',
          ratios=np.array([1e6 * seconds / unit / raw_us]),
      )
      for label, (seconds, calls) in split.items()
  ]


def _break_down_reset(
    env: batch_environment.BatchEnvironment,
) -> list[timing.Figure]:
  """Returns the time of each part of a reset, including the timers."""
  task = env.task
  parts = (
      ('resetting the state', env.physics, 'reset'),
      ('random states', seeding, 'random_state'),
      ('keys of providers', seeding, 'episode_key'),
      ('positions of apples', apple_rooms.Variation, 'scatter'),
      ('placing the avatar', task, 'place_avatar'),
      ('the rest of the world', task, 'initialize_episode'),
      ('registers', env, '_initialize'),
      ('observations', env, '_observe'),
      ('the rest', env, 'reset'),
  )
  split = timing.split(parts, env.reset)
  return [
      timing.Figure(
          f'  {label}', np.array([1e3 * seconds / env.num_envs]), 'ms'
      )
      for label, (seconds, _) in split.items()
  ]


def _compare_to_stock(
    seconds: Mapping[str, np.ndarray],
) -> list[timing.Figure]:
  """Compares the worlds of each batch with a stock environment."""
  figures = []
  for label, (dof, _) in _KINDS.items():
    stock = seconds[f'stock, {dof}']
    taken = seconds[f'batch, {label}'] / worlds.NUM_ENVS
    if label == _FASTEST:
      figures.append(
          timing.Figure(
              "a world's step, of a stock step",
              100 * taken / stock,
              '%',
              round(_MAX_OF_STOCK, 2),
          )
      )
    figures += [
        timing.Figure(f'to one of stock, {label}', stock / taken, 'x'),
        timing.Figure(f'steps, {label}', 1e-3 / taken, '/ms'),
    ]
  return figures + [
      timing.Figure(f'stock step, {dof}', 1e6 * seconds[f'stock, {dof}'], 'us')
      for dof in dict.fromkeys(dof for dof, _ in _KINDS.values())
  ]


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  memory = batch_growth.measure_memory()
  envs = {
      label: worlds.load(worlds.NUM_ENVS, dof=dof, sleep=sleep)
      for label, (dof, sleep) in _KINDS.items()
  }
  stocks = {dof: _Stock(dof) for dof, _ in _KINDS.values()}
  env = envs['free']
  actions = worlds.draw(env, _STEPS)
  raw = _record(env, actions)

  def replay() -> float:
    seconds = raw.replay()
    _check_same(env, raw)
    return seconds

  seconds = timing.time_rounds(
      {
          'batch, free': lambda: worlds.play(env, actions),
          'raw': replay,
          'reset': lambda: _reset(env),
          **{
              f'batch, {label}': functools.partial(worlds.play, other, actions)
              for label, other in envs.items()
              if other is not env
          },
          'stock reset': stocks['free'].reset,
          **{f'stock, {dof}': stock.step for dof, stock in stocks.items()},
      },
      rounds,
  )
  us, raw_us, reset_us = (
      1e6 * seconds[name] / worlds.NUM_ENVS
      for name in ('batch, free', 'raw', 'reset')
  )
  timing.report([
      timing.Figure(
          'throughput lost to raw engine', 100 * (1 - raw_us / us), '%',
          _MAX_LOST, ratios=us / raw_us,
      ),
      timing.Figure("a world's step", us, 'us', ratios=us / raw_us),
      timing.Figure('raw step', raw_us, 'us'),
      *_compare_to_stock(seconds),
      timing.Figure("a world's reset", reset_us / 1e3, 'ms', _RESET_TARGET_MS),
      timing.Figure('stock reset', 1e3 * seconds['stock reset'], 'ms'),
      *_break_down_step(env, actions, float(np.median(raw_us))),
      *_break_down_reset(env),
      *memory,
      *batch_growth.grow_worlds(max(1, rounds // 3)),
      *batch_growth.grow_registers(max(1, rounds // 3)),
  ])  # fmt: skip
  for each in envs.values():
    each.close()


if __name__ == '__main__':
  main()
