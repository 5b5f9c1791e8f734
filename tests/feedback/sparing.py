"""A design whose providers are silent at random, for tests."""

from collections.abc import Iterator
import contextlib
from typing import Any, Literal, final

import numpy as np

from realab_suite.feedback import providers
from realab_suite.policies import random_keys
from tests.engine import helpers


@final
class Sparing(providers.Provider):
  """Writes a tenth of the number of its calls, and is silent at random.

  It adds a hundredth of the first reading.
  """

  kind: Literal['test_sparing'] = 'test_sparing'
  share: float = 0.5

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {'calls': np.zeros(batch_shape, int)}

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:
    calls = np.where(episode_start, 1, state['calls'] + 1)
    speaks = random_keys.uniform(key) < self.share
    value = 0.1 * calls + sum(0.01 * r for r in readings.values())
    # A value that is not written is not looked at.
    value = np.where(speaks, value, np.nan)
    writes = {name: (value, speaks) for name in self.writes if speaks.any()}
    return writes, {'calls': calls}


@contextlib.contextmanager
def registered() -> Iterator[None]:
  with helpers.registered(providers.PROVIDERS, 'test_sparing', Sparing):
    yield


def register(role: str, place: str, **options: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block',
      'role': role,
      'place': place,
      'range': [-5, 20],
      **options,
  }


def design(**changes: Any) -> dict[str, Any]:
  """Returns a design with silence, a memory, a meter and a signal.

  Args:
    **changes: Options of registers, by the name of the register.
  """
  made = {
      'reward': register('feedback', 'station_1'),
      'note': register('memory', 'station_2'),
      'score': register('meter', 'station_3'),
      'stop': register('signal', 'station_4', ends_episode={'above': 1.0}),
  }
  return {
      'schema': 1,
      'name': 'sparing',
      'registers': {
          name: {**options, **changes.get(name, {})}
          for name, options in made.items()
      },
      'meters': [{'measures': 'score', 'writes': 'score'}],
      'providers': [
          {
              'kind': 'test_sparing',
              'reads': ['note', 'score'],
              'writes': ['note'],
          },
          {
              'kind': 'difference',
              'reads': ['note'],
              'writes': ['reward'],
              'every': 3,
          },
          {
              'kind': 'test_sparing',
              'writes': ['stop'],
              'share': 0.3,
              'every': 2,
          },
      ],
  }
