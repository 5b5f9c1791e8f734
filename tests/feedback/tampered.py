"""Worlds whose blocks a test moves, in each kind of environment.

The meter `clock` measures the number of completed control steps, so everything
that follows from it can be worked out by hand.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from typing import Any, Literal, final

import numpy as np

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.feedback import providers
from realab_suite.feedback.providers import base
from realab_suite.policies import random_keys
from tests.engine import helpers
from tests.evaluation import rooms

HOSTS = ('single', 'batch', 'embedded')
NUM_ENVS = 3
# In a batch, this world has the moves of the script, the others are honest.
TAMPERED = 1
_PLACES = ([2, 2], [2, -3], [-3, 2.5], [-3, -3], [2, 0.5], [-3, 0])


@final
class Adding(providers.Provider):
  """Adds readings, what the agent saw in a register, and noise.

  Attributes:
    seen: Names of registers whose readings in the observation count, too.
    gate: Name of a register in `reads` whose reading does not count, but which
      silences the provider while it is above 5.
    noise: Size of the noise.
    most: Largest sum of readings that the provider accepts.
  """

  kind: Literal['test_adding'] = 'test_adding'
  seen: base.Names = ()
  gate: str = ''
  noise: float = 0.0
  most: float = 1e9

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:  # fmt: skip
    CALLS.append(np.shape(episode_start))
    counted = [r for name, r in readings.items() if name != self.gate]
    if np.any(sum(counted) > self.most):
      raise ValueError('the readings are too large')
    value = self.noise * random_keys.uniform(key) + sum(counted)
    value = value + sum(observation[f'registers/{n}'] for n in self.seen)
    if not self.gate:
      return dict.fromkeys(self.writes, np.asarray(value)), state
    speaks = np.asarray(readings[self.gate] <= 5.0)
    return dict.fromkeys(self.writes, (np.asarray(value), speaks)), state


@final
class Summing(providers.Provider):
  """Writes the sum of all of its readings in the episode."""

  kind: Literal['test_summing'] = 'test_summing'

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {'sums': [np.zeros(batch_shape)], 'calls': np.zeros(batch_shape)}

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:  # fmt: skip
    CALLS.append(np.shape(episode_start))
    [total] = state['sums']
    total = total + sum(readings.values())
    following = {'sums': [total], 'calls': state['calls'] + 1}
    return dict.fromkeys(self.writes, total), following


# Shapes of the calls of these providers, in order.
CALLS: list[tuple[int, ...]] = []


@contextlib.contextmanager
def registered(*kinds: type[providers.Provider]) -> Iterator[None]:
  """Registers the providers of this module, and more of them."""
  CALLS.clear()
  with contextlib.ExitStack() as stack:
    for kind in (Adding, Summing, *kinds):
      name = kind.model_fields['kind'].default
      stack.enter_context(helpers.registered(providers.PROVIDERS, name, kind))
    yield


def register(role: str, **options: Any) -> dict[str, Any]:
  """Returns a register with a role; `design` gives it a place."""
  return {'kind': 'two_block', 'role': role, 'range': [-50, 50],
          'scale': 0.01, **options}  # fmt: skip


def design(
    registers: Mapping[str, Mapping[str, Any]],
    *given: Mapping[str, Any],
    **changes: Any,
) -> dict[str, Any]:
  """Returns a design with these registers, providers and the clock."""
  made = {'clock': register('meter'), **registers}
  return {
      'schema': 1,
      'name': 'tampered',
      'dof': 'planar',
      'registers': {
          name: {'place': place, **one}
          for (name, one), place in zip(made.items(), _PLACES, strict=False)
      },
      'meters': [{'measures': 'steps', 'writes': 'clock'}],
      'providers': list(given),
      **changes,
  }


def move(env: Any, name: str, units: float, where: Any = None) -> None:
  """Moves the base block of a register, so that readings grow.

  Args:
    env: Has a `mechanism` and a `physics`.
    name: Name of the register.
    units: Increase of the readings.
    where: Worlds of a batch in which it moves; `None` for all worlds.
  """
  one = env.mechanism.registers[name]
  position = np.array(one.blocks[0].position(env.physics))
  position[..., 0] -= units * one.scale
  one.blocks[0].put(env.physics, position, where=where)


@final
class World:
  """An environment and what its registers contain.

  Attributes:
    env: The environment.
    mechanism: Its mechanism.
    num_envs: Number of worlds of a batch.
    is_batch: True for a batch.
    time_step: Time step of the agent, or of the agents of a batch.
  """

  def __init__(self, host: str, design: Any, num_envs: int = NUM_ENVS) -> None:
    is_foreign = host == 'embedded'
    task = helpers.PointTask() if is_foreign else rooms.EmptyRoom()
    duration = task.control_timestep
    env: Any = suite.embed(
        task, design, random=7, max_steps=50,
        measurements={
            'steps': lambda physics: np.floor(
                np.asarray(physics.data.time) / duration + 1e-6
            )
        },
        **({'world': TAMPERED} if host == 'single' else {}),
    )  # fmt: skip
    self.mechanism = env.mechanism
    if host == 'batch':
      env = batch_environment.BatchEnvironment(env, num_envs, 1)
    self.env = env
    self.num_envs = num_envs
    self.is_batch = host == 'batch'
    self.time_step: Any = None

  @property
  def physics(self) -> Any:
    return self.env.physics

  def of_tampered(self, value: Any) -> Any:
    """Returns the part of a value that belongs to the world with the moves."""
    return value[TAMPERED] if self.is_batch else value

  def begin(self) -> None:
    """Begins an episode."""
    self.time_step = self.env.reset()

  def step(
      self, moves: Sequence[tuple[str, float]] = (), query: float = 0.0
  ) -> None:
    """Moves base blocks by so many units, then makes a control step."""
    for name, units in moves:
      where = np.arange(self.num_envs) == TAMPERED if self.is_batch else None
      move(self, name, units, where)
    shape = self.env.action_spec().shape
    action = np.zeros((self.num_envs, *shape) if self.is_batch else shape)
    self.of_tampered(action)[: len(self.mechanism.queries)] = query
    self.time_step = self.env.step(action)

  def seen(self) -> list[bytes]:
    """Returns what the agent has seen in the last step."""
    parts = self.time_step.observation.values()
    return [np.asarray(self.of_tampered(part)).tobytes() for part in parts]

  def contents(self, name: str) -> tuple[float, float]:
    """Returns the reading and the clean content of a register."""
    one = self.mechanism.registers[name]
    reading, clean = one.read(self.physics), one.clean(self.physics)
    return float(self.of_tampered(reading)), float(self.of_tampered(clean))

  def run(
      self,
      moves: Sequence[tuple[int, str, float]],
      steps: int,
      *names: str,
      query: float = 0.0,
  ) -> dict[str, tuple[list[float], list[float]]]:
    """Returns what registers contain after each step of a new episode.

    Args:
      moves: Step, register and units of each move, as for `step`.
      steps: Number of control steps.
      *names: Names of the registers.
      query: Query of the agent in every step.

    Returns:
      Readings and clean contents, by register.
    """
    found: dict[str, tuple[list[float], list[float]]]
    found = {name: ([], []) for name in names}
    self.begin()
    for step in range(1, steps + 1):
      self.step([m[1:] for m in moves if m[0] == step], query)
      for name, sides in found.items():
        for side, value in zip(sides, self.contents(name), strict=True):
          side.append(value)
        assert self.is_batch <= self._is_honest(name)
    return found

  def _is_honest(self, name: str) -> bool:
    """Returns True if readings are clean in the other worlds of a batch."""
    one = self.mechanism.registers[name]
    found = np.atleast_1d(one.read(self.physics) - one.clean(self.physics))
    return bool((np.abs(found[np.arange(len(found)) != TAMPERED]) < 1e-6).all())

  def close(self) -> None:
    self.env.close()


@contextlib.contextmanager
def worlds() -> Iterator[Callable[[str, Any], World]]:
  """Yields a function that returns the world of a host and a design.

  Worlds are compiled once.
  """
  made: dict[str, World] = {}

  def get(host: str, design: Any) -> World:
    key = repr((host, design))
    if key not in made:
      made[key] = World(host, design)
    return made[key]

  with registered():
    yield get
    for world in made.values():
      world.close()
