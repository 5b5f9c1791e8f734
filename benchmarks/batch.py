"""Benchmark of a batch of worlds against MuJoCo's own batch engine.

`python -m benchmarks.batch` steps 256 worlds of Unlock Door with two free
two-block registers, rays, a ledger and random actions that use the hand, on all
processors. MuJoCo's `Batch` replays the steps from a copy of the state: the
same substeps, the same writes as assignments to whole arrays, one update of
derived quantities, and the same rays cast by a second `Batch`. Both have to end
in the same state, bit for bit, in every round.

The stock contestant is a `composer.Environment` of dm_control with the same
world and registers. It compiles the model for each episode, the avatar's senses
are observables, and the task writes both registers after each step. It has no
ledger.

The benchmark is repeated with planar registers and with blocks that sleep, each
against a stock environment with registers of the same kind. The target for the
fastest of them, planar blocks that sleep, is 15 times the throughput of the
stock environment.

A third of the rounds measures how costs grow with the numbers of worlds,
registers and apples.
"""

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import functools
import os
import pathlib
import subprocess
import sys
import time
from typing import Any, final
from unittest import mock

from dm_control import composer
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from benchmarks import timing
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_physics
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.tasks import unlock_door

_WORLDS = 256
_STEPS = 20
_STOCK_STEPS = 100
_ROUNDS = 8
_SEED = 0
# Numbers of steps by numbers of worlds, to measure how throughput grows.
_SIZES = {1: 64, 16: 16, 64: 8, 256: 4, 1024: 4}
_REGISTERS = (1, 2, 4)
_REGISTER_STEPS = 4
_APPLES = (4, 8, 16)
_MEMORY_WORLDS = 1024

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
_MEMORY_TARGET_MIB = 1.0

# Fields that a world may write between substeps besides blocks and controls: of
# the door, eaten apples, the grip of the hand, and thrown blocks.
_OCCASIONAL = ('mocap_pos', 'eq_active', 'qvel')
_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)

Phase = tuple[list[tuple[np.ndarray, np.ndarray]], int]
"""Writes, each a view and its new value, and the number of substeps after."""

Rays = tuple[np.ndarray, np.ndarray, int]
"""Origins, directions and the body that rays pass through."""


@final
@dataclasses.dataclass(frozen=True)
class RawSteps:
  """Recorded steps of a batch, which the raw engine replays.

  Attributes:
    batch: Batch that steps the worlds; the views in `steps` are of its arrays.
    ray_batch: Batch that casts the rays.
    start: State before the first step.
    steps: Phases of each control step.
    rays: Rays at the end of each control step.
  """

  batch: mujoco_batch.Batch
  ray_batch: mujoco_batch.Batch
  start: np.ndarray
  steps: list[list[Phase]]
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
      batch.forward(stage=_STAGE)
      ray_batch.state[:] = batch.state
      ray_batch.ray(origins, directions, bodyexclude=carrier)
    return (time.perf_counter() - began) / len(self.steps)


@final
class StockTask(composer.Task):
  """Unlock Door with two registers, as a task for stock Composer."""

  def __init__(self, dof: str) -> None:
    self._world = unlock_door.UnlockDoor()
    mechanism = mechanisms.FeedbackMechanism(
        specs.load('instantaneous_reward', (f'dof={dof}',))
    )
    mechanism.attach_to(self._world.root_entity)
    self._registers = mechanism.registers
    avatar = self._world.avatar
    avatar.make_graspable(
        [b for register in self._registers.values() for b in register.blocks]
    )
    for part in (
        *avatar.observables.proprioception,
        avatar.rays.observables.distances,
        avatar.rays.observables.classes,
        self._registers['reward'].observables.reading,
    ):
      part.enabled = True
    self.control_timestep = self._world.control_timestep

  @property
  def root_entity(self) -> composer.Entity:
    return self._world.root_entity

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
    self._env = composer.Environment(StockTask(dof), random_state=_SEED)
    spec = self._env.action_spec()
    self._actions = np.random.default_rng(_SEED).uniform(
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


def _load(
    num_envs: int,
    design: str | Mapping[str, Any] = 'instantaneous_reward',
    dof: str = 'free',
    sleep: bool = False,
) -> batch_environment.BatchEnvironment:
  """Loads a batch with a ledger."""
  env = suite.load_batch(
      'unlock_door',
      'standard',
      {'random': _SEED},
      num_envs=num_envs,
      sleep=sleep,
      design=design,
      overrides=(f'dof={dof}',),
  )
  env.add_sink(ledgers.BatchLedger())
  return env


def _draw(
    env: batch_environment.BatchEnvironment, num_steps: int
) -> np.ndarray:
  spec = env.action_spec()
  return np.random.default_rng(_SEED).uniform(
      spec.minimum, spec.maximum, (num_steps, env.num_envs, *spec.shape)
  )


def _play(
    env: batch_environment.BatchEnvironment, actions: np.ndarray
) -> float:
  """Plays the first episodes and returns the seconds per step."""
  # `rewind` exists only for single environments.
  env._episodes[:] = -1
  env.reset()
  began = time.perf_counter()
  for action in actions:
    env.step(action)
  return (time.perf_counter() - began) / len(actions)


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
  raw, ray_batch = (
      mujoco_batch.Batch(model, env.num_envs, true.nthread) for _ in range(2)
  )
  start = true.state.copy()
  raw.state[:] = start
  # The meter and the provider write the offset blocks.
  meter, provider = (env.mechanism.registers[n] for n in ('score', 'reward'))
  routine = [
      [(raw.bind('ctrl'), true.bind('ctrl'))],
      _pose_views(physics, meter, raw, true),
      _pose_views(physics, provider, raw, true),
  ]
  phases: list[Phase] = []
  rays: list[Rays] = []
  advance, cast = physics.advance, physics.cast_rays

  def advance_both(num_substeps: int) -> None:
    writes = [(view, value.copy()) for view, value in routine[len(phases)]]
    for view, value in writes:
      view[:] = value
    for name in _OCCASIONAL:
      view, value = raw.bind(name), true.bind(name)
      if not np.array_equal(view, value):
        writes.append((view, value.copy()))
        view[:] = value
    phases.append((writes, num_substeps))
    raw.step(nstep=num_substeps)
    advance(num_substeps)

  def cast_both(origins: Any, directions: Any, carrier: int) -> Any:
    rays.append((origins[:, np.newaxis, :].copy(), directions.copy(), carrier))
    return cast(origins, directions, carrier)

  steps = []
  with (
      mock.patch.object(physics, 'advance', advance_both),
      mock.patch.object(physics, 'cast_rays', cast_both),
  ):
    for action in actions:
      env.step(action)
      steps.append(phases.copy())
      phases.clear()
  return RawSteps(raw, ray_batch, start, steps, rays)


def _pose_views(
    physics: batch_physics.BatchPhysics,
    register: Any,
    raw: mujoco_batch.Batch,
    true: mujoco_batch.Batch,
) -> list[tuple[np.ndarray, np.ndarray]]:
  """Returns views of the pose of a two-block register's offset block."""
  model = physics.model
  joints = physics.bind(register.blocks[1].body.joint).element_id
  first, last = min(joints), max(joints)
  views = []
  for name, starts, size in (
      ('qpos', model.jnt_qposadr, 4),
      ('qvel', model.jnt_dofadr, 3),
  ):
    part = slice(starts[first], starts[last] + size)  # The last one is a ball.
    views.append((raw.bind(name)[:, part], true.bind(name)[:, part]))
  return views


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
  task, mechanism, physics = env.task, env.mechanism, env.physics
  parts = (
      ('substeps', physics, 'advance'),
      ('derived quantities', physics, 'forward'),
      ('motors and hand', task.avatar, 'apply_action'),
      ('events of the world', task, 'latch_events'),
      ('meters', mechanism, 'update_meters'),
      ('providers', mechanism, 'update_providers'),
      ("agent's reads", mechanism, 'read_for_agent'),
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

  split = _split(parts, play)
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
      ('positions of apples', task, '_scatter'),
      ('placing the avatar', task, '_place_avatar'),
      ('the rest of the world', task, 'initialize_episode'),
      ('registers', env, '_initialize'),
      ('observations', env, '_observe'),
      ('the rest', env, 'reset'),
  )
  split = _split(parts, env.reset)
  return [
      timing.Figure(
          f'  {label}', np.array([1e3 * seconds / env.num_envs]), 'ms'
      )
      for label, (seconds, _) in split.items()
  ]


def _split(
    parts: Sequence[tuple[str, Any, str]], work: Any
) -> dict[str, tuple[float, int]]:
  """Returns the seconds and the number of calls of each part, by label.

  Args:
    parts: Label, owner and name of each method.
    work: Function to time.
  """
  watch = timing.Stopwatch()
  with contextlib.ExitStack() as stack:
    for label, owner, name in parts:
      timed = watch.watch(label, getattr(owner, name))
      stack.enter_context(mock.patch.object(owner, name, timed))
    work()
  return {label: (s, watch.calls[label]) for label, s in watch.seconds.items()}


def _grow_worlds(rounds: int) -> list[timing.Figure]:
  """Measures how throughput grows with the number of worlds."""
  playing = {}
  for number, num_steps in _SIZES.items():
    env = _load(number)
    playing[number] = (env, _draw(env, num_steps))
  seconds = timing.time_rounds(
      {str(n): functools.partial(_play, *p) for n, p in playing.items()},
      rounds,
  )
  for env, _ in playing.values():
    env.close()
  return [
      timing.Figure(
          f'steps of {number} worlds',
          number / seconds[str(number)] / 1e3,
          '/ms',
      )
      for number in _SIZES
  ]


def _design(dof: str, number: int) -> dict[str, Any]:
  """Returns a design with registers that are written in each step."""
  names = [f'register_{i}' for i in range(1, number + 1)]
  return {
      'schema': 1,
      'name': f'{dof}_{number}',
      'dof': dof,
      'registers': {
          name: {
              'kind': 'two_block',
              'role': 'meter',
              'place': f'station_{i}',
              'range': [0, 20],
              'scale': 0.1,
          }
          for i, name in enumerate(names, start=1)
      },
      'meters': [{'measures': 'score', 'writes': name} for name in names],
  }


def _grow_registers(rounds: int) -> list[timing.Figure]:
  """Measures the cost of registers, which may grow linearly."""
  playing = {}
  for dof in ('free', 'planar'):
    for number in _REGISTERS:
      env = _load(_WORLDS, _design(dof, number), dof)
      playing[f'{number} {dof}'] = (env, _draw(env, _REGISTER_STEPS))
  seconds = timing.time_rounds(
      {name: functools.partial(_play, *p) for name, p in playing.items()},
      rounds,
  )
  for env, _ in playing.values():
    env.close()
  us = {name: 1e6 * taken / _WORLDS for name, taken in seconds.items()}
  figures = [
      timing.Figure(f'step, registers: {name}', taken, 'us')
      for name, taken in us.items()
  ]
  most, half = _REGISTERS[-1], _REGISTERS[-2]
  for dof in ('free', 'planar'):
    growth = us[f'{most} {dof}'] / us[f'{half} {dof}']
    figures.append(
        timing.Figure(
            f'{most} registers to {half}, {dof}', growth, 'x', most / half
        )
    )
  return figures


def _grow_apples(rounds: int) -> list[timing.Figure]:
  """Measures the cost of apples, whose state is read in each phase."""
  playing = {}
  for number in _APPLES:
    with mock.patch.object(unlock_door, '_NUM_APPLES', number):
      env = _load(_WORLDS)
      playing[number] = (env, _draw(env, _REGISTER_STEPS))

  def play(number: int) -> float:
    with mock.patch.object(unlock_door, '_NUM_APPLES', number):
      return _play(*playing[number])

  seconds = timing.time_rounds(
      {str(n): functools.partial(play, n) for n in playing}, rounds
  )
  for env, _ in playing.values():
    env.close()
  most, half = _APPLES[-1], _APPLES[-2]
  return [
      *(
          timing.Figure(
              f'step, small apples: {n}', 1e6 * seconds[str(n)] / _WORLDS, 'us'
          )
          for n in _APPLES
      ),
      timing.Figure(
          f'{most} apples to {half}',
          seconds[str(most)] / seconds[str(half)],
          'x',
          most / half,
      ),
  ]


def _resident_mib() -> float:
  """Returns the resident memory of this process on Linux, in MiB."""
  pages = int(pathlib.Path('/proc/self/statm').read_text().split()[1])
  return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


def measure_memory(num_envs: int, sleep: bool) -> None:
  """Prints the memory without a batch, with one world and with `num_envs`."""
  single = suite.load(
      'unlock_door', 'standard', {'random': _SEED},
      design='instantaneous_reward',
  )  # fmt: skip
  before = _resident_mib()
  single.close()
  readings = [before]
  for number in (1, num_envs):
    env = _load(number, sleep=sleep)
    env.reset()
    env.step(_draw(env, 1)[0])
    readings.append(_resident_mib())
  print(*readings)


def _measure_memory() -> list[timing.Figure]:
  """Measures the memory of worlds in separate processes."""
  figures = []
  for sleep in (False, True):
    code = (
        'from benchmarks import batch;'
        f' batch.measure_memory({_MEMORY_WORLDS}, {sleep})'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    before, one, many = map(float, done.stdout.split())
    figures.append(
        timing.Figure(
            'memory where blocks sleep'
            if sleep
            else f'memory of one of {_MEMORY_WORLDS} worlds',
            np.array([(many - one) / _MEMORY_WORLDS]),
            'MiB',
            _MEMORY_TARGET_MIB,
        )
    )
  return [
      *figures,
      timing.Figure(
          'memory of model and threads', np.array([one - before]), 'MiB'
      ),
  ]


def _compare_to_stock(
    seconds: Mapping[str, np.ndarray],
) -> list[timing.Figure]:
  """Compares the worlds of each batch with a stock environment."""
  figures = []
  for label, (dof, _) in _KINDS.items():
    stock = seconds[f'stock, {dof}']
    taken = seconds[f'batch, {label}'] / _WORLDS
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
  memory = _measure_memory()
  envs = {
      label: _load(_WORLDS, dof=dof, sleep=sleep)
      for label, (dof, sleep) in _KINDS.items()
  }
  stocks = {dof: _Stock(dof) for dof, _ in _KINDS.values()}
  env = envs['free']
  actions = _draw(env, _STEPS)
  raw = _record(env, actions)

  def replay() -> float:
    seconds = raw.replay()
    _check_same(env, raw)
    return seconds

  seconds = timing.time_rounds(
      {
          'batch, free': lambda: _play(env, actions),
          'raw': replay,
          'reset': lambda: _reset(env),
          **{
              f'batch, {label}': functools.partial(_play, other, actions)
              for label, other in envs.items()
              if other is not env
          },
          'stock reset': stocks['free'].reset,
          **{f'stock, {dof}': stock.step for dof, stock in stocks.items()},
      },
      rounds,
  )
  us, raw_us, reset_us = (
      1e6 * seconds[name] / _WORLDS for name in ('batch, free', 'raw', 'reset')
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
      *_grow_worlds(max(1, rounds // 3)),
      *_grow_registers(max(1, rounds // 3)),
      *_grow_apples(max(1, rounds // 3)),
  ])  # fmt: skip
  for each in envs.values():
    each.close()


if __name__ == '__main__':
  main()
