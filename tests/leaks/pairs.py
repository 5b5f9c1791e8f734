"""Two runs that differ in a secret, and everything that an agent gets of them.

A transcript has three parts. `agent` is what goes through the agent's view, and
what a process hears besides: its output, its logs, its files, the global
generators. `world` is what the agent could find out later: the poses of
everything, and the scene that cameras draw. `structure` is what is done for it
without its seeing it: which registers are written and read, in which step. All
three have to be equal.
"""

from collections.abc import Iterator
import contextlib
import functools
import io
import logging
import os
import pathlib
import random
import struct
import tempfile
from typing import Any, NamedTuple
import warnings

from dm_env import specs
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from tests import worlds
from tests.engine import helpers
from tests.feedback import designs
from tests.leaks import secrets

# What agents see of a meter that stands in the open; a design declares that.
SIGHT = ('senses/ray_distances', 'senses/ray_classes')
_HOSTILE_EVERY = 7
_HOSTILE: tuple[Any, ...] = (
    np.nan,
    None,
    'forwards',
    [[1.0], [2.0, 3.0]],
    np.inf,
    {'a': 1},
    1e300,
)


class Case(NamedTuple):
  """A world and its feedback.

  Attributes:
    domain: As in `suite.load`.
    variation: As in `suite.load`.
    design: The name of a shipped design, `no_meters`, `unread_meter` or
      `moved`.
    seed: The seed of the world and of the actions.
    num_envs: Number of worlds, or 0 for one alone.
    steps: Number of control steps.
    max_steps: Number of control steps after which an episode ends.
  """

  domain: str = 'collect_apples'
  variation: str = 'standard'
  design: str = 'no_meters'
  seed: int = 5
  num_envs: int = 0
  steps: int = 70
  max_steps: int = 60

  def load(self, generator: Any = None, design: Any = None) -> Any:
    """Returns new worlds.

    Args:
      generator: A caller's own, instead of the seed.
      design: Another design.
    """
    own = {
        'no_meters': secrets.NO_METERS,
        'unread_meter': secrets.UNREAD_METER,
        'moved': secrets.MOVED,
    }
    arguments = (
        self.domain,
        self.variation,
        {'random': self.seed if generator is None else generator},
        {'max_steps': self.max_steps},
    )
    options: Any = {
        'design': design or own.get(self.design, self.design),
        'overrides': designs.for_losses(self.domain, self.design),
    }
    if not self.num_envs:
      env: Any = suite.load(*arguments, **options)
    else:
      env = suite.load_batch(
          *arguments, num_envs=self.num_envs, num_threads=1, **options
      )
    if self.design == 'moved':
      secrets.move_meter(env)
    return env


class Transcript(NamedTuple):
  """The observable facts of a run; see the module."""

  agent: list[bytes]
  world: list[bytes]
  structure: list[str]
  true_rewards: list[str]


def view_of(env: Any, failures: Any = None) -> Any:
  """Returns the agent's view of one world or of many."""
  if isinstance(env, environment.Environment):
    return agent_view.AgentView(env, failures)
  return agent_view.BatchAgentView(env, failures)


def walk(spec: Any, case: Case) -> list[np.ndarray]:
  """Actions that take an avatar through a room, and so over apples."""
  generator = np.random.default_rng(case.seed)
  leading = (case.num_envs,) if case.num_envs else ()
  shape = (case.steps, *leading, *spec.shape)
  if isinstance(spec, specs.DiscreteArray):
    draws = generator.integers(0, spec.num_values, shape)
    return list(np.repeat(draws, 3, axis=0)[: case.steps].astype(spec.dtype))
  if spec.dtype.kind == 'i':
    return list(helpers.draw(spec, (case.steps, *leading), generator))
  actions = np.zeros(shape)
  names = [name.rpartition('/')[2] for name in spec.name.split('\t')]
  turns = generator.uniform(-1, 1, (case.steps, *leading))
  actions[..., names.index('forward')] = 1.0
  actions[..., names.index('turn')] = np.repeat(turns, 4, axis=0)[: case.steps]
  return list(actions)


def play(
    case: Case,
    secret: secrets.Secret = secrets.Secret(),  # noqa: B008 - it is immutable.
    leave_out: tuple[str, ...] = (),
) -> Transcript:
  """Plays a case, as an agent that asks for everything that there is.

  Args:
    case: The case.
    secret: The secret that the agent must not find out.
    leave_out: Keys of observations that are not compared.
  """
  said: list[bytes] = []
  with contextlib.ExitStack() as stack:
    stack.enter_context(secret.around())
    heard = stack.enter_context(listening())
    generator = np.random.RandomState(case.seed)
    globally = _global_generators()
    env = case.load(generator)
    secret.change(env)
    sink: Any = _Sink() if not case.num_envs else _BatchSink()
    if secret.has_evaluator:
      env.add_sink(sink)
    world = _play(env, case, said, leave_out)
    env.close()
    said.append(repr(globally == _global_generators()).encode())
    said.append(_state_of(generator))
    said += heard()
  return Transcript(said, world, sink.structure, sink.true_rewards)


def _play(
    env: Any,
    case: Case,
    said: list[bytes],
    leave_out: tuple[str, ...],
) -> list[bytes]:
  """Appends what a view says, and returns what is behind it."""
  view = view_of(env)
  said += [repr(sorted(dir(view))).encode(), *_specs(view)]
  world: list[bytes] = []
  for i, action in enumerate(walk(view.action_spec(), case)):
    if i % _HOSTILE_EVERY == 3:
      said.append(_failure(view.step, _HOSTILE[i % len(_HOSTILE)]))
    if i == case.steps - 4:
      said.append(_told(view.reset, leave_out=leave_out))
    said.append(_told(view.step, action, leave_out=leave_out))
    if not case.num_envs:
      world.append(_hidden_state(env))
  said += _specs(view)
  view.close()
  said.append(_failure(view.reset))
  return world


def differences(
    case: Case, secret: secrets.Secret, leave_out: tuple[str, ...] = ()
) -> list[str]:
  """Returns the differences between a run with a secret and one without."""
  return compare(
      secret,
      play(case, leave_out=leave_out),
      play(case, secret, leave_out=leave_out),
  )


def compare(
    secret: secrets.Secret, expected: Transcript, found: Transcript
) -> list[str]:
  """Returns the differences between two runs, one of which had a secret."""
  parts = ['agent', 'world', 'structure']
  if secret.needs == 'unread_meter':
    parts.remove('world')  # The meter is part of it.
  if not secret.has_evaluator:
    parts.remove('structure')  # Only an evaluator records it.
  return [
      f'{part}[{i}]'
      for part in parts
      for i in _where(getattr(expected, part), getattr(found, part))
  ]


def has_earned(transcript: Transcript) -> bool:
  """Returns `True` if there was any true reward."""
  return any(
      digit in text for text in transcript.true_rewards for digit in '123456789'
  )


def _where(expected: list[Any], found: list[Any]) -> Iterator[int]:
  if len(expected) != len(found):
    yield min(len(expected), len(found))
  for i, (one, other) in enumerate(zip(expected, found, strict=False)):
    if one != other:
      yield i


DOMAINS = 'collect_apples', 'unlock_door'
"""Domains with tasks behind a barrier and near registers, for all secrets."""


def cases_for(
    secret: secrets.Secret, seed: int, is_batch: bool
) -> Iterator[tuple[Case, tuple[str, ...]]]:
  """Yields the cases for a secret, and the keys that comparisons leave out."""
  num_envs = 2 if is_batch else 0
  if is_batch and not secret.is_for_batches:
    return
  for domain in DOMAINS:
    if secret.needs == 'no_meters':
      yield Case(domain, seed=seed, num_envs=num_envs), ()
    elif secret.needs == 'moved':
      yield Case(domain, 'near', 'moved', seed, num_envs, 20, 9), ()
    elif secret.needs == 'unread_meter':
      # Behind a barrier nothing is seen of a meter.
      case = Case(domain, 'boxed', 'unread_meter', seed, num_envs)
      yield case, ()
      yield case._replace(variation='standard'), SIGHT
    else:
      design = suite.DESIGNS[seed % len(suite.DESIGNS)]
      yield Case(domain, 'near', design, seed, num_envs), ()


# Everything that there is, in bytes.


def encode(value: Any) -> bytes:
  """Returns a value with its type, to the last bit."""
  kind = f'{type(value).__module__}.{type(value).__qualname__}'
  if isinstance(value, np.ndarray):
    flags = value.flags
    kind += (
        f' {value.dtype.str} {value.shape} {value.strides}'
        f' {flags.c_contiguous} {flags.owndata} {flags.writeable}'
        f' {value.base is None}'
    )
    return kind.encode() + value.tobytes()
  if isinstance(value, float):
    return kind.encode() + struct.pack('<d', value)
  if isinstance(value, dict):
    parts = [repr(k).encode() + encode(v) for k, v in value.items()]
    return kind.encode() + b'{' + b','.join(parts) + b'}'
  if isinstance(value, tuple):
    # A named tuple may have got attributes besides its fields.
    more = encode(vars(value)) if hasattr(value, '__dict__') else b''
    fields = repr(getattr(value, '_fields', ())).encode()
    parts = [encode(part) for part in value]
    return kind.encode() + fields + b'(' + b','.join(parts) + b')' + more
  if isinstance(value, specs.Array):
    parts = [
        encode(getattr(value, name))
        for name in ('shape', 'dtype', 'name', 'minimum', 'maximum')
        if hasattr(value, name)
    ]
    return kind.encode() + b','.join(parts)
  return kind.encode() + repr(value).encode()


def _specs(view: Any) -> list[bytes]:
  return [
      encode(view.observation_spec()),
      encode(view.action_spec()),
      encode(view.reward_spec()),
      encode(view.discount_spec()),
  ]


def _told(call: Any, *arguments: Any, leave_out: tuple[str, ...]) -> bytes:
  """Returns a time step, or the exception that came instead."""
  try:
    time_step = call(*arguments)
  except Exception as error:  # Whatever it is, the agent gets it.
    return of_exception(error)
  observation = {
      key: value
      for key, value in time_step.observation.items()
      if key not in leave_out
  }
  return encode(time_step) if not leave_out else encode(
      time_step._replace(observation=observation)
  )  # fmt: skip


def _failure(call: Any, *arguments: Any) -> bytes:
  try:
    call(*arguments)
  except errors.RealabError as error:
    return of_exception(error)
  return b'accepted'


def of_exception(error: BaseException) -> bytes:
  """Returns everything that an exception says."""
  parts = [
      type(error).__qualname__,
      str(error),
      repr(error.args),
      repr(error.__cause__),
      repr(error.__context__),
      repr(getattr(error, '__notes__', None)),
      repr(vars(error)),
  ]
  return '\n'.join(parts).encode()


def _hidden_state(env: environment.Environment) -> bytes:
  """Returns where everything is, and what cameras draw."""
  physics = env.physics
  physics.forward()  # Cameras draw derived quantities.
  data = physics.data
  parts = [
      np.asarray(getattr(data, name)).tobytes()
      for name in (
          'time', 'qpos', 'qvel', 'ctrl', 'mocap_pos', 'mocap_quat', 'eq_active'
      )
  ]  # fmt: skip
  return b'|'.join([*parts, scene(env)])


def scene(env: environment.Environment) -> bytes:
  """Returns the scene that the agent's camera would draw. Needs no GL."""
  physics = env.physics
  model, data = physics.model.ptr, physics.data.ptr
  drawn = _scene_of(model)
  camera = mujoco.MjvCamera()
  camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
  camera.fixedcamid = physics.bind(env.task.avatar.camera).element_id
  mujoco.mjv_updateScene(
      model, data, mujoco.MjvOption(), None, camera,
      mujoco.mjtCatBit.mjCAT_ALL, drawn,
  )  # fmt: skip
  parts = []
  for geom in drawn.geoms[: drawn.ngeom]:
    numbers = [geom.pos, geom.mat.ravel(), geom.size, geom.rgba]
    shading = [geom.emission, geom.specular, geom.shininess, geom.reflectance]
    ids = [geom.type, geom.objid, geom.segid, geom.matid]
    parts += [np.concatenate([*numbers, shading, ids]).tobytes()]
    parts.append(geom.label.encode())
  for light in drawn.lights[: drawn.nlight]:
    parts += [np.concatenate([light.pos, light.dir, light.diffuse]).tobytes()]
  return b'|'.join(parts)


@functools.lru_cache(maxsize=4)
def _scene_of(model: mujoco.MjModel) -> mujoco.MjvScene:
  """Returns a scene to draw, which takes long to make."""
  return mujoco.MjvScene(model, maxgeom=200)


def _state_of(generator: np.random.RandomState) -> bytes:
  _, keys, position, *rest = generator.get_state()
  return keys.tobytes() + repr((position, rest)).encode()


def _global_generators() -> bytes:
  legacy: Any = np.random.mtrand._rand
  return _state_of(legacy) + repr(random.getstate()).encode()


@contextlib.contextmanager
def listening() -> Iterator[Any]:
  """Hears what a process prints, logs, warns of and writes into files."""
  logs = io.StringIO()
  handler = logging.StreamHandler(logs)
  out, err = io.StringIO(), io.StringIO()
  root = logging.getLogger()
  root.addHandler(handler)
  with (
      tempfile.TemporaryDirectory() as folder,
      contextlib.chdir(folder),
      warnings.catch_warnings(record=True) as warned,
      contextlib.redirect_stdout(out),
      contextlib.redirect_stderr(err),
  ):
    warnings.simplefilter('always')

    def heard() -> list[bytes]:
      files = sorted(pathlib.Path(folder).rglob('*'))
      return [
          logs.getvalue().encode(),
          out.getvalue().encode(),
          err.getvalue().encode(),
          repr([str(warning.message) for warning in warned]).encode(),
          *[os.fsencode(p.name) + p.read_bytes() for p in files if p.is_file()],
      ]

    try:
      yield heard
    finally:
      root.removeHandler(handler)


class _Sink(helpers.RecordingSink):
  """Notes what is done in each step, and what it was worth."""

  def state(self) -> None:
    """Lets the world be saved while this listens."""

  @property
  def structure(self) -> list[str]:
    return [
        repr([(type(r).__name__, *r[:2]) for r in getattr(h, 'records', [])])
        if isinstance(h, events.Step | events.Start)
        else repr(h)
        for h in self.heard
    ]

  @property
  def true_rewards(self) -> list[str]:
    return [str(step.true_reward) for step in self.steps]


class _BatchSink(events.BatchEventSink):
  """Notes the same of many worlds."""

  def __init__(self) -> None:
    self.structure: list[str] = []
    self.true_rewards: list[str] = []

  def step_ended(self, step: events.BatchStep) -> None:
    records = [(type(r).__name__, *r[:2]) for r in step.records]
    self.structure.append(repr((records, step.ends, step.is_first.tolist())))
    self.true_rewards.append(repr(step.true_reward.tolist()))


def body_states(env: environment.Environment, but: list[Any]) -> bytes:
  """Returns the positions and velocities of all bodies except some blocks."""
  left_out = {worlds.body_of(env.physics, block) for block in but}
  model, data = env.physics.model, env.physics.data
  others = [i for i in range(model.nv) if model.dof_bodyid[i] not in left_out]
  return bytes(data.qvel[others].tobytes() + data.xpos[1].tobytes())
