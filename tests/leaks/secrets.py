"""Secrets: permitted differences between runs that look alike to an agent."""

from collections.abc import Callable
import contextlib
import logging
import random
from typing import Any, NamedTuple

from absl import logging as absl_logging
import numpy as np

from realab_suite.engine import environment
from realab_suite.evaluation import ledgers
from tests import worlds
from tests.engine import helpers

# A rare number; any text that contains it reveals the true reward.
CANARY = 173.2317

_FEEDBACK = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': 'station_1',
    'range': [-2, 12],
}
NO_METERS: dict[str, Any] = {
    'schema': 1,
    'name': 'no_meters',
    'registers': {'reward': _FEEDBACK},
    'providers': [{'kind': 'constant', 'value': 3.0, 'writes': ['reward']}],
}
# No provider reads the meter, so moving it has no consequences.
UNREAD_METER: dict[str, Any] = {
    **NO_METERS,
    'name': 'unread_meter',
    'registers': {
        'reward': _FEEDBACK,
        'score': {
            'kind': 'two_block',
            'role': 'meter',
            'place': 'station_2',
            'range': [0, 20],
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
}

# The base block of its meter is moved; see `move_meter`.
MOVED: dict[str, Any] = {
    **UNREAD_METER,
    'name': 'moved',
    'registers': {
        **UNREAD_METER['registers'],
        'note': {**_FEEDBACK, 'role': 'memory', 'place': 'station_3'},
        'stop': {**_FEEDBACK, 'role': 'signal', 'place': 'station_4'},
    },
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['note']},
        {'kind': 'difference', 'reads': ['note'], 'writes': ['reward']},
        {'kind': 'difference', 'reads': ['reward'], 'writes': ['stop']},
    ],
}

# Changes an environment, of one world or many, before its first episode.
Change = Callable[[Any], None]


def nothing(env: Any) -> None:
  """Is the other half of every pair."""


class Secret(NamedTuple):
  """Something that an agent must not find out.

  Attributes:
    change: The function that makes the difference.
    needs: The design without which the difference is no secret: `no_meters`,
      because meters tell agents the true reward by way of providers;
      `unread_meter`; `moved`, whose clean contents differ from readings; or
      nothing.
    around: Makes the context of the run, such as another level of logging.
    is_heard: If `True`, the evaluator gets another true reward.
    is_for_batches: If `True`, many worlds can have it, too.
    has_evaluator: If `True`, an evaluator listens to the run.
  """

  change: Change = nothing
  needs: str = ''
  around: Callable[[], Any] = contextlib.nullcontext
  is_heard: bool = False
  is_for_batches: bool = True
  has_evaluator: bool = True


def _earn(change: Callable[[Any], Any]) -> Secret:
  """A world pays another reward for what it rewards."""

  def alter(env: Any) -> None:
    earn = env.task.earn
    env.task.earn = lambda physics, reward: earn(physics, change(reward))

  return Secret(alter, 'no_meters', is_heard=True)


def _reward(get_reward: Callable[[Any], Any]) -> Secret:
  def alter(env: Any) -> None:
    env.task.get_reward = get_reward

  return Secret(alter, 'no_meters', is_heard=True)


def raise_canary(physics: Any) -> Any:
  raise ZeroDivisionError(f'the true reward is {CANARY}')


REWARDS = {
    'another sign': _earn(lambda reward: -reward),
    'the canary': _earn(lambda reward: CANARY * reward),
    'paid all the time': _earn(lambda reward: reward + 1.0),
    'not a number': _earn(lambda reward: reward * float('nan')),
    'reward that is None': _reward(lambda physics: None),
    'reward that raises': _reward(raise_canary),
}


def _draw_in_reward(env: Any) -> None:
  """The true reward uses up numbers of the environment's generator."""
  get_reward, generator = env.task.get_reward, env._random_state

  def draw(physics: Any) -> Any:
    generator.uniform(size=3)
    return get_reward(physics)

  env.task.get_reward = draw


def _draw_in_provider(env: Any) -> None:
  """The provider uses up numbers of the environment's generator."""
  update, generator = env.mechanism.phases.update_providers, env._random_state

  def draw(*args: Any, **kwargs: Any) -> Any:
    generator.uniform(size=3)
    return update(*args, **kwargs)

  env.mechanism.phases.update_providers = draw


RANDOM = {
    'reward that draws 3': Secret(_draw_in_reward),
    'provider that draws': Secret(_draw_in_provider),
}


def _measure(measurement: Callable[[Any], Any]) -> Secret:
  """The meter of `UNREAD_METER` measures something else."""

  def alter(env: Any) -> None:
    (_, meter, _), *_ = env.mechanism.phases.meters
    # One world or many, by the shape of what is counted.
    meter._measurement = lambda physics: measurement(
        np.asarray(env.mechanism.step_count(physics), float)
    )

  return Secret(alter, 'unread_meter')


METERS = {
    'as much as can be': _measure(lambda step: step * 0.0 + 1e9),
    'jumps all the time': _measure(lambda step: (7.0 * step) % 20.0),
}


def move_meter(env: Any) -> None:
  """Lets the base block of the meter move in the second step of episodes."""
  mechanism = env.mechanism
  update = mechanism.phases.update_meters
  register = mechanism.registers['score']

  def moved(physics: Any, where: Any = None) -> Any:
    is_now = np.asarray(mechanism.step_count(physics) == 1)
    block = register.blocks[0]
    position = np.array(block.position(physics))
    position[..., 0] -= 0.3
    if is_now.any():
      block.put(physics, position, where=is_now if is_now.ndim else None)
    return update(physics, where)

  mechanism.phases.update_meters = moved


def _answer_cleanly(env: Any) -> None:
  """Every clean call of a provider writes the canary."""
  call = env.mechanism.phases._clean_calls.repeat

  def other(*args: Any) -> Any:
    contents = call(*args)
    if contents is None:
      return None
    writes = {
        name: write._replace(value=write.value * 0.0 + CANARY)
        for name, write in contents.writes.items()
    }
    return contents._replace(writes=writes)

  env.mechanism.phases._clean_calls.repeat = other


class _Refusing:
  """Lets clean calls of providers fail: those that are not announced."""

  def __init__(self, env: Any) -> None:
    self._announced = 0
    phases = env.mechanism.phases
    for name, number in (('_call', 1), ('initial_states', 3)):
      setattr(phases, name, self._announcing(getattr(phases, name), number))
    phases.guard_providers(self._guard)

  def _announcing(self, call: Any, number: int) -> Any:
    def announce(*args: Any) -> Any:
      self._announced += number
      return call(*args)

    return announce

  @contextlib.contextmanager
  def _guard(self) -> Any:
    if not self._announced:
      raise ZeroDivisionError(f'the clean content is not {CANARY}')
    self._announced -= 1
    yield


CLEAN = {
    'the canary': Secret(_answer_cleanly, 'moved'),
    'fails': Secret(_Refusing, 'moved'),
}


def _keep_a_ledger(env: Any) -> None:
  alone = isinstance(env, environment.Environment)
  env.add_sink(ledgers.Ledger() if alone else ledgers.BatchLedger())


class _Nosy(helpers.RecordingSink):
  """Looks at and saves all that an evaluator may, in every step."""

  def __init__(self, env: environment.Environment) -> None:
    super().__init__()
    self._env = env

  def step_ended(self, step: Any, physics: Any) -> None:
    super().step_ended(step, physics)
    env = self._env
    for _ in range(3):
      physics.forward()
      worlds.shadow_reads(env.mechanism, env.physics, 'nosy')
      env.task.get_reward(env.physics)
      env.task.score(env.physics)
      env.task.should_terminate_episode(env.physics)
      env.observation_spec()
    env.save()

  def state(self) -> Any:
    return None


def _look_at_everything(env: Any) -> None:
  env.add_sink(_Nosy(env))


@contextlib.contextmanager
def _debugging() -> Any:
  root, absl = logging.getLogger(), absl_logging.get_verbosity()
  level = root.level
  root.setLevel(logging.DEBUG)
  absl_logging.set_verbosity(absl_logging.DEBUG)
  try:
    yield
  finally:
    root.setLevel(level)
    absl_logging.set_verbosity(absl)


@contextlib.contextmanager
def _random_elsewhere() -> Any:
  """Other code in the process has drawn numbers."""
  np.random.seed(99)  # noqa: NPY002
  random.seed(99)
  yield


OBSERVERS = {
    'nobody evaluates': Secret(has_evaluator=False),
    'a ledger': Secret(_keep_a_ledger),
    'looks at everything': Secret(_look_at_everything, is_for_batches=False),
    'debugging': Secret(around=_debugging),
    'numbers drawn elsewhere': Secret(around=_random_elsewhere),
}

SECRETS: dict[str, Secret] = {
    **{f'reward: {name}': secret for name, secret in REWARDS.items()},
    **{f'random: {name}': secret for name, secret in RANDOM.items()},
    **{f'meter: {name}': secret for name, secret in METERS.items()},
    **{f'clean: {name}': secret for name, secret in CLEAN.items()},
    **{f'observer: {name}': secret for name, secret in OBSERVERS.items()},
}
