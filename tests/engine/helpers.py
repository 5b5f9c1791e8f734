"""Helpers for tests of a running environment; see `worlds` for physics."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import copy
import struct
from typing import Any

from dm_control import composer
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite import suite
from realab_suite.config import registry
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers

# For tasks that have none of the places or measurements of this suite.
SCORED: dict[str, Any] = {
    'schema': 1,
    'name': 'scored',
    'registers': {
        'reward': {
            'kind': 'two_block', 'role': 'feedback', 'place': [2, 2],
            'range': [-2, 12],
        },
        'score': {
            'kind': 'two_block', 'role': 'meter', 'place': [2, -3],
            'range': [-20, 20], 'scale': 0.05,
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
}  # fmt: skip


def one_register(
    name: str, providers: Any = (), place: Any = 'station_1', **register: Any
) -> dict[str, Any]:
  """Returns a design with one two-block register."""
  return {
      'schema': 1,
      'name': 'one_register',
      'registers': {
          name: {
              'kind': 'two_block',
              'place': place,
              'initial': 0,
              **register,
          }
      },
      'providers': list(providers),
  }


def load_apples(
    design: Any = 'instantaneous_reward', seed: int = 7, max_steps: int = 40
) -> environment.Environment:
  """Loads Collect Apples."""
  return suite.load(
      'collect_apples', 'standard', {'random': seed}, {'max_steps': max_steps},
      design=design,
  )  # fmt: skip


def embed(
    task: composer.Task, design: Any = 'none', **kwargs: Any
) -> tuple[environment.Environment, 'RecordingSink']:
  """Embeds a task; returns the environment and what it reports."""
  env, sink = suite.embed(task, design, random=7, **kwargs), RecordingSink()
  env.add_sink(sink)
  return env, sink


class RecordingSink(events.EventSink):
  """Keeps what the engine says, in order."""

  def __init__(self) -> None:
    self.heard: list[Any] = []

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self.heard.append(copy.deepcopy(start))

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self.heard.append(copy.deepcopy(step))

  def episode_ended(self, end: events.End) -> None:
    self.heard.append(end)

  @property
  def starts(self) -> list[events.Start]:
    return [h for h in self.heard if isinstance(h, events.Start)]

  @property
  def steps(self) -> list[events.Step]:
    return [h for h in self.heard if isinstance(h, events.Step)]

  @property
  def ends(self) -> list[events.End]:
    return [h for h in self.heard if isinstance(h, events.End)]

  def true_return(self) -> float:
    return float(sum(step.true_reward for step in self.steps))

  def records(self, kind: type[Any], register: str) -> list[Any]:
    """Every `Write` to or `Read` of a register, in order."""
    return [
        record
        for step in self.steps
        for record in step.records
        if isinstance(record, kind) and record.register == register
    ]

  def requested(self, register: str) -> list[float]:
    """Returns the values requested for a register, in order."""
    written = self.records(registers.Write, register)
    return [float(write.requested) for write in written]

  def read(self, register: str, reader: str = registers.AGENT) -> list[float]:
    """Returns the readings of a register by one reader, in order."""
    reads = self.records(registers.Read, register)
    return [float(read.reading) for read in reads if read.reader == reader]


class PointTask(composer.Task):
  """A task from outside the package: a bead on a wire, over a bare floor.

  Every hook that a test may want to misbehave is an attribute.
  """

  def __init__(self) -> None:
    self._arena = composer.Arena()
    root = self._arena.mjcf_model
    body = root.worldbody.add('body', name='bead', pos=(0, 0, 1))
    self.joint = body.add('joint', name='wire', type='slide', axis=(1, 0, 0))
    body.add('geom', type='sphere', size=(0.1,), mass=1.0)
    root.actuator.add(
        'motor', name='push', joint=self.joint, ctrllimited='true',
        ctrlrange=(-1, 1),
    )  # fmt: skip
    self.bead = observable.MJCFFeature('qpos', self.joint)
    self.bead.enabled = True
    self.secret = observable.MJCFFeature('qvel', self.joint)
    self.set_timesteps(control_timestep=0.05, physics_timestep=0.01)
    self.reward: Callable[[Any], Any] = self._bead_position
    self.begin: Callable[[Any, Any], None] = lambda physics, random: None
    self.end_step: Callable[[Any, Any], None] = lambda physics, random: None

  def _bead_position(self, physics: Any) -> float:
    return float(physics.bind(self.joint).qpos[0])

  @property
  def root_entity(self) -> composer.Arena:
    return self._arena

  @property
  def task_observables(self) -> Mapping[str, observable.Observable]:
    return {'bead': self.bead, 'secret': self.secret}

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    physics.bind(self.joint).qpos = random_state.uniform(-0.1, 0.1)
    self.begin(physics, random_state)

  def after_step(self, physics: Any, random_state: Any) -> None:
    self.end_step(physics, random_state)

  def get_reward(self, physics: Any) -> Any:
    return self.reward(physics)


@contextlib.contextmanager
def registered(
    names: registry.Registry[Any], name: str, entry: Any
) -> Iterator[None]:
  """Registers something for as long as the context lasts."""
  names.add(name)(entry)
  try:
    yield
  finally:
    del names._entries[name]


def to_bytes(time_step: Any, leave_out: tuple[str, ...] = ()) -> bytes:
  """Returns everything that an agent gets in a time step, canonically."""
  parts = [repr((int(time_step.step_type), type(time_step.reward))).encode()]
  for number in (time_step.reward, time_step.discount):
    parts.append(b'-' if number is None else struct.pack('<d', number))
  for key, value in time_step.observation.items():
    if key not in leave_out:
      parts.append(f'{key} {value.dtype.str} {value.shape}'.encode())
      parts.append(value.tobytes())
  return b'\n'.join(parts)


def spec_text(env: Any) -> str:
  """Returns every spec that an agent can ask for, canonically."""
  return repr(
      [
          env.observation_spec(),
          env.action_spec(),
          env.reward_spec(),
          env.discount_spec(),
      ]
  )


def random_actions(env: Any, number: int, seed: int = 0) -> list[np.ndarray]:
  """Draws actions that fit an environment's spec."""
  generator = np.random.default_rng(seed)
  return list(draw(env.action_spec(), (number,), generator))


def draw(
    spec: specs.BoundedArray, leading: tuple[int, ...], generator: Any
) -> np.ndarray:
  """Draws actions that satisfy a spec, `(*leading, *spec.shape)`."""
  size = (*leading, *spec.shape)
  if spec.dtype.kind == 'i':
    high = np.asarray(spec.maximum) + 1
    return generator.integers(spec.minimum, high, size).astype(spec.dtype)
  return generator.uniform(spec.minimum, spec.maximum, size)


def last_observation(env: Any) -> dict[str, np.ndarray]:
  """Returns the observation that an environment or a batch keeps."""
  observation: dict[str, np.ndarray] = env._observation
  return observation


def no_op(env: Any) -> np.ndarray:
  """Returns the action that does nothing, where 0 is one."""
  return np.zeros(env.action_spec().shape, env.action_spec().dtype)
