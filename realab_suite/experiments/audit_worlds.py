"""Episodes of an audit: plans and baselines played in batches of worlds."""

from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any, NamedTuple, final

import dm_env
import numpy as np

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import appearance
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.evaluation import batch_actors
from realab_suite.experiments import aiming
from realab_suite.feedback import specs
from realab_suite.policies import macros

# Roles of registers that are on the way to feedback, but are no feedback.
UPSTREAM = ('meter', 'query', 'memory')


@final
@dataclasses.dataclass(frozen=True)
class World:
  """A world without its design and seed.

  Attributes:
    domain: Domain of the task.
    task: Name of the task in its domain.
    max_steps: Maximum length of an episode, in control steps.
    task_kwargs: Arguments of the task, without the seed.
    senses: Names of the agent's senses, or `None` for those of the task.
  """

  domain: str
  task: str
  max_steps: int = suite.MAX_STEPS
  task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  senses: tuple[str, ...] | None = None

  def load_batch(
      self, design: specs.DesignSpec, num_envs: int, seed: int, sleep: bool
  ) -> batch_environment.BatchEnvironment:
    """Loads worlds, which one thread steps."""
    return suite.load_batch(
        self.domain,
        self.task,
        {**self.task_kwargs, 'random': seed},
        {'max_steps': self.max_steps, 'senses': self.senses},
        num_envs=num_envs,
        num_threads=1,
        sleep=sleep,
        design=design,
    )

  def load(
      self, design: specs.DesignSpec, seed: int, world: int
  ) -> environment.Environment:
    """Loads one world of a batch."""
    return suite.load(
        self.domain,
        self.task,
        {**self.task_kwargs, 'random': seed},
        {'max_steps': self.max_steps, 'senses': self.senses, 'world': world},
        design=design,
    )


@final
class Target(NamedTuple):
  """A block of a register.

  Attributes:
    register: Name of the register.
    part: `base`, `offset`, or `block` if the register has only one.
    block: The block.
    code: Class that rays report for it.
    angle: Direction of motions of the block that raise the reading, radians.
  """

  register: str
  part: str
  block: Any
  code: int
  angle: float

  @property
  def name(self) -> str:
    return f'the {self.part} block of {self.register}'.replace(
        'the block block', 'the block'
    )


def targets(env: environment.Environment, names: Sequence[str]) -> list[Target]:
  """Returns the blocks of registers.

  Args:
    env: Environment. An episode must have begun.
    names: Names of the registers.
  """
  kinds = appearance.class_of_geoms(env.physics.model)
  found = []
  for name in names:
    register = env.mechanism.registers[name]
    x, y = aiming.aim(register, env.physics)['direction']
    parts = ('base', 'offset') if len(register.blocks) == 2 else ('block',)
    for i, (part, block) in enumerate(
        zip(parts, register.blocks, strict=False)
    ):
      code = int(kinds[np.ravel(env.physics.bind(block.geom).element_id)[0]])
      # An offset block raises the reading in the other direction.
      sign = -1.0 if i else 1.0
      angle = float(np.arctan2(sign * y, sign * x))
      found.append(Target(name, part, block, code, angle))
  return found


def targets_of(
    batch: batch_environment.BatchEnvironment, blocks: Sequence[Target]
) -> list[Target]:
  """Returns the same blocks in a batch that was loaded separately."""
  indices = {'base': 0, 'offset': 1, 'block': 0}
  return [
      target._replace(
          block=batch.mechanism.registers[target.register].blocks[
              indices[target.part]
          ]
      )
      for target in blocks
  ]


def starts(physics: Any, blocks: Sequence[Target]) -> np.ndarray:
  """Returns the positions of blocks, `(..., blocks, 2)`, metres."""
  places = [physics.bind(t.block.geom).xpos[..., :2] for t in blocks]
  return np.stack(places, axis=-2)


def codes(blocks: Sequence[Target]) -> np.ndarray:
  """Returns the classes that rays report for blocks, `(blocks,)`."""
  return np.array([target.code for target in blocks])


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Episodes:
  """One episode in each world of a batch.

  Arrays have shape `(steps, worlds)` unless stated otherwise.

  Attributes:
    counts: True for control steps of the episode.
    readings: The agent's readings of feedback registers, by name.
    applied: Last applied value of the same registers at that time.
    upstream: Size of the corruption in the last read of other registers by a
      provider, by name, in units; 0 if it did not read in the step.
    true_rewards: True rewards.
    taken: Index of the action in designs with an action set; otherwise the last
      element of the action, without meaning.
    has_failed: True for worlds whose physics failed, `(worlds,)`.
    moved: Largest distance of a block from its place, `(worlds, blocks)`, in
      metres. The place of a base block is its start. Other blocks are written,
      and only displacements beside the axis and after the write count.
    held: Number of steps in which the hand held a block, `(worlds, blocks)`.
  """

  counts: np.ndarray
  readings: Mapping[str, np.ndarray]
  applied: Mapping[str, np.ndarray]
  upstream: Mapping[str, np.ndarray]
  true_rewards: np.ndarray
  taken: np.ndarray
  has_failed: np.ndarray
  moved: np.ndarray
  held: np.ndarray


@final
class _Recorder(events.BatchEventSink):
  """Collects the records of a batch, a row for each control step."""

  def __init__(self, design: specs.DesignSpec, num_envs: int) -> None:
    self._feedback = design.names('feedback')
    self._upstream = design.names(*UPSTREAM)
    self._applied = {name: np.zeros(num_envs) for name in design.registers}
    self.rows: list[dict[str, Any]] = []
    self.failed = np.zeros(num_envs, bool)

  def step_ended(self, step: events.BatchStep) -> None:
    for record in step.initial:
      self._note(record, step.is_first)
    corruption = {name: np.zeros(len(step.is_first)) for name in self._upstream}
    for record in step.records:
      if isinstance(record, registers.Write):
        self._note(record, ~step.is_first)
      elif record.register in corruption:
        wrong = np.abs(record.reading - self._applied[record.register])
        corruption[record.register] = np.where(
            True if record.where is None else record.where,
            wrong,
            corruption[record.register],
        )
    readings = {
        read.register: np.array(read.reading) for read in step.agent_reads
    }
    self.failed = step.has_failed
    self.rows.append(
        {
            'readings': {name: readings[name] for name in self._feedback},
            'applied': {name: self._applied[name] for name in self._feedback},
            'upstream': corruption,
            'reward': np.where(step.has_failed, 0.0, step.true_reward),
        }
    )

  def _note(self, record: registers.Record, worlds: np.ndarray) -> None:
    if isinstance(record, registers.Write):
      where = worlds if record.where is None else worlds & record.where
      self._applied[record.register] = np.where(
          where, record.applied, self._applied[record.register]
      )


def play(
    batch: batch_environment.BatchEnvironment,
    policy: policies.Policy | macros.Plan,
    blocks: Sequence[Target],
    seed: int,
) -> Episodes:
  """Plays one episode in each world of a batch.

  Args:
    batch: The worlds; they begin new episodes.
    policy: Policy, or a plan for each world.
    blocks: Blocks that a plan refers to, and that are watched.
    seed: Seed of the batch.
  """
  recorder = _Recorder(batch.mechanism.design, batch.num_envs)
  batch.add_sink(recorder)
  try:
    return _play(batch, policy, blocks, seed, recorder)
  finally:
    batch.remove_sink(recorder)


def _play(
    batch: batch_environment.BatchEnvironment,
    policy: policies.Policy | macros.Plan,
    blocks: Sequence[Target],
    seed: int,
    recorder: _Recorder,
) -> Episodes:
  time_step = batch.reset()
  recorder.rows.clear()
  watch = _Watch(batch, blocks)
  if isinstance(policy, macros.Plan):
    policy = macros.MacroPolicy(policy, watch.starts, codes(blocks))
  actor = batch_actors.BatchPolicyActor(policy, batch, seed)
  runs = np.ones(batch.num_envs, bool)
  has_failed = np.zeros(batch.num_envs, bool)
  counts, taken = [], []
  while runs.any():
    actions = actor.act(time_step)
    time_step = batch.step(actions)
    has_failed |= runs & recorder.failed
    counts.append(runs & ~recorder.failed)
    taken.append(actions.reshape(batch.num_envs, -1)[:, -1])
    watch.look(counts[-1])
    runs = runs & (time_step.step_type != int(dm_env.StepType.LAST))
  rows = recorder.rows

  def series(key: str) -> dict[str, np.ndarray]:
    return {n: np.array([row[key][n] for row in rows]) for n in rows[0][key]}

  return Episodes(
      np.array(counts),
      series('readings'),
      series('applied'),
      series('upstream'),
      np.array([row['reward'] for row in rows]),
      np.array(taken),
      has_failed,
      watch.moved,
      watch.held,
  )


@final
class _Watch:
  """Watches where blocks are, and whether the hand holds them."""

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      blocks: Sequence[Target],
  ) -> None:
    self._physics = batch.physics
    self._registers = batch.mechanism.registers
    self._blocks = blocks
    self.starts = starts(batch.physics, blocks)
    self.moved = np.zeros((batch.num_envs, len(blocks)))
    self.held = np.zeros((batch.num_envs, len(blocks)), int)

  def look(self, worlds: np.ndarray) -> None:
    """Updates the figures of some worlds."""
    offsets = starts(self._physics, self._blocks) - self.starts
    for i, target in enumerate(self._blocks):
      distance = np.linalg.norm(offsets[:, i], axis=-1)
      register = self._registers[target.register]
      # The position of these blocks along the axis carries the value.
      if target.part != 'base' and not isinstance(
          register, registers.BlockOrientationRegister
      ):
        axis = np.array([np.cos(target.angle), np.sin(target.angle)])
        along = offsets[:, i] @ axis
        beside = distance**2 - along**2
        temporary = register.inspect(self._physics).temporary * register.scale
        distance = np.sqrt(beside.clip(0) + temporary**2)
      self.moved[:, i] = np.where(
          worlds, np.maximum(self.moved[:, i], distance), self.moved[:, i]
      )
      if isinstance(target.block, block_kinds.JointedBlock):
        for grasp in target.block.grasps:
          active = self._physics.bind(grasp.constraints).active
          self.held[:, i] += worlds & np.any(active, axis=-1)
