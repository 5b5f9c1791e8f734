"""Providers may stay silent: what they do not write keeps its value (P1)."""

from typing import Any, Literal, final

import numpy as np
import pytest

from realab_suite.entities import registers
from realab_suite.evaluation import evaluate
from realab_suite.feedback import providers
from realab_suite.policies import random_keys
from tests.engine import helpers
from tests.engine import identity
from tests.feedback import scripted


@final
class _Sparing(providers.Provider):
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


def _register(role: str, place: str, **options: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block',
      'role': role,
      'place': place,
      'range': [-5, 20],
      **options,
  }


def _design(**changes: Any) -> dict[str, Any]:
  """Returns a design with silence, a memory, a meter and a signal.

  Args:
    **changes: Options of registers, by the name of the register.
  """
  made = {
      'reward': _register('feedback', 'station_1'),
      'note': _register('memory', 'station_2'),
      'score': _register('meter', 'station_3'),
      'stop': _register('signal', 'station_4', ends_episode={'above': 1.0}),
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


_MIXED = {
    'reward': {'dof': 'planar', 'kind': 'block_position'},
    'note': {'kind': 'block_orientation'},
    'score': {'channel': 'secure'},
}


@pytest.fixture(name='made')
def fixture_made():
  with scripted.worlds() as worlds:
    yield worlds


@pytest.fixture(name='sparing_providers')
def fixture_sparing():
  names = providers.PROVIDERS
  with helpers.registered(names, 'test_sparing', _Sparing):
    yield


def _move(env: Any, name: str, distance: float) -> None:
  """Moves the last block of a register along its axis."""
  block = env.mechanism.registers[name].blocks[-1]
  position = np.array(block.position(env.physics))
  position[..., 0] += distance
  block.put(env.physics, position)


@pytest.mark.parametrize(
    'silent',
    [
        lambda o, r, s: ({}, s),
        lambda o, r, s: ({'reward': (np.nan, np.array(False))}, s),
        lambda o, r, s: ({'reward': (7.0, False)}, s),
    ],
    ids=['left_out', 'masked', 'masked_by_a_bool'],
)
def test_a_register_that_is_not_written_keeps_its_value(made, silent):
  env, sink = made.scripted()
  env.reset()
  env.step(helpers.no_op(env))  # Writes 2.
  scripted.ANSWER[:] = [silent]
  _move(env, 'reward', 0.3)
  seen = [
      env.step(helpers.no_op(env)).observation['registers/reward']
      for _ in range(2)
  ]
  assert seen == pytest.approx([5.0, 5.0], abs=1e-6)
  scripted.ANSWER[:] = [scripted.constant((4.0, True))]
  env.step(helpers.no_op(env))
  assert sink.requested('reward') == [2.0, 4.0]
  _, *silences, last = sink.records(registers.Read, 'reward')
  # Corruption is relative to the value that was written last.
  errors = [float(read.temporary) for read in silences]
  assert errors == pytest.approx([3.0, 3.0], abs=1e-6)
  assert float(last.reading) == pytest.approx(4.0, abs=1e-6)


@pytest.mark.usefixtures('sparing_providers')
def test_a_batch_with_silence_equals_its_worlds():
  case = identity.Case('unlock_door', 'standard', _design(**_MIXED))
  result = identity.compare(case, 50)
  assert result.differences == ()
  # Episodes have ended at different steps.
  assert result.num_episodes > 2 * identity.NUM_ENVS
  assert result.num_corrupted > 0


@pytest.mark.parametrize('every', [2, 4])
def test_a_provider_acts_in_the_first_and_then_every_kth_step(made, every):
  design = scripted.design()
  design['providers'][0]['every'] = every
  env, sink = made.scripted(design, max_steps=7)
  scripted.ANSWER[:] = [lambda o, r, s: ({'reward': 1.0}, (*s, len(s)))]
  [result] = evaluate.evaluate(env, lambda _: helpers.no_op(env), 1)
  steps = [1 + every * i for i in range(7) if 1 + every * i <= 7]
  assert [w.step for w in sink.records(registers.Write, 'reward')] == steps
  reads = sink.records(registers.Read, 'clock')
  assert [read.step for read in reads] == steps
  assert result.num_provider_calls == len(scripted.SEEN) == len(steps)
  starts = [bool(seen[2]) for seen in scripted.SEEN]
  assert starts == [s == 1 for s in steps]
  assert [len(seen[4]) for seen in scripted.SEEN] == list(range(len(steps)))
