"""Worlds whose feedback provider is scripted by a test."""

from collections.abc import Callable, Iterator
import contextlib
import copy
from typing import Any, Literal, final

import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.feedback import providers
from realab_suite.tasks import collect_apples
from tests import kept
from tests.engine import helpers

Answer = Callable[[Any, Any, Any], Any]
"""From an observation, readings and a state to writes and the next state."""


def constant(value: Any) -> Answer:
  """Returns an answer that writes a value to the reward."""
  return lambda observation, readings, state: ({'reward': value}, state)


@final
class Provider(providers.Provider):
  """Gives the answer of a test, and keeps the inputs."""

  kind: Literal['test_scripted'] = 'test_scripted'

  @property
  def required_senses(self) -> tuple[str, ...]:
    return tuple(SENSES)

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    inputs = observation, readings, episode_start, key, state
    SEEN.append(copy.deepcopy(inputs))
    return ANSWER[0](observation, readings, state)


SEEN: list[tuple[Any, ...]] = []
ANSWER: list[Answer] = []
CLOCK: list[Callable[[Any], Any]] = []
"""What the meter of the world that was made last measures."""
SENSES: list[str] = []
"""Senses that the provider of the next world declares."""


def register(role: str, place: str, low: float, high: float) -> dict[str, Any]:
  return {
      'kind': 'two_block',
      'role': role,
      'place': place,
      'range': [low, high],
      'initial': 0,
  }


def design(**changes: Any) -> dict[str, Any]:
  """Returns a design with a query, a reward and the meter of a clock."""
  scripted = {
      'kind': 'test_scripted',
      'reads': ['clock', 'query'],
      'writes': ['reward'],
  }
  return {
      'schema': 1,
      'name': 'traced',
      'registers': {
          'query': register('query', 'station_3', 0, 13),
          'reward': register('feedback', 'station_1', -2, 12),
          'clock': register('meter', 'station_2', 0, 20),
      },
      'meters': [{'measures': 'clock', 'writes': 'clock'}],
      'providers': [scripted],
      **changes,
  }


class Worlds:
  """Makes worlds that are closed at the end of a test, and used again."""

  def __init__(self, stack: contextlib.ExitStack) -> None:
    self._stack = stack

  def scripted(
      self,
      changed: Any = None,
      measurement: Callable[[Any], Any] = lambda physics: 7.0,
      **kwargs: Any,
  ) -> tuple[environment.Environment, helpers.RecordingSink]:
    """Returns a world with the scripted provider, and its events."""
    CLOCK[:] = [measurement]
    env = kept.load(
        (changed or design(), SENSES, kwargs),
        lambda: suite.embed(
            collect_apples.CollectApples('standard'),
            changed or design(),
            random=3,
            measurements={'clock': lambda physics: CLOCK[0](physics)},
            **kwargs,
        ),
    )
    return env, self._sink(env)

  def _sink(self, env: environment.Environment) -> helpers.RecordingSink:
    self._stack.callback(env.close)
    sink = helpers.RecordingSink()
    env.add_sink(sink)
    return sink


@contextlib.contextmanager
def worlds() -> Iterator[Worlds]:
  """Registers the provider, which writes 2 until a test changes its answer."""
  SEEN.clear()
  SENSES.clear()
  ANSWER[:] = [constant(2.0)]
  names = providers.PROVIDERS
  with (
      helpers.registered(names, 'test_scripted', Provider),
      contextlib.ExitStack() as stack,
  ):
    yield Worlds(stack)
