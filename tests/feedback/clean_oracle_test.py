"""Clean contents of designs at random, against a simulation without shortcuts.

The simulation calls every provider with clean contents in every step and every
world, and keeps states and contents of its own.
"""

from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite.policies import random_keys
from tests import examples
from tests.feedback import tampered

_STEPS = 9


def _design(rng: Any) -> dict[str, Any]:
  """Returns a chain of providers; each reads what others have written."""
  roles = ['memory', 'feedback', 'signal']
  names = [f'r{i}' for i in range(rng.integers(1, 4))]
  known = ['clock', 'query', 'gate']
  given = []
  for name in names:
    one: dict[str, Any] = {
        'writes': [name], 'every': int(rng.choice([1, 1, 2, 3])),
    }  # fmt: skip
    one['reads'] = sorted({*rng.choice(known, 2)})
    one['kind'] = str(rng.choice(['test_adding', 'test_summing', 'difference']))
    if one['kind'] == 'difference':
      one['reads'] = one['reads'][:1]
    if one['kind'] == 'test_adding':
      one['noise'] = float(rng.choice([0.0, 2.0]))
      one['seen'] = [n for n, role in zip(names, roles, strict=False)
                     if role != 'memory' and rng.random() < 0.3]  # fmt: skip
      if rng.random() < 0.3:
        one |= {'gate': 'gate', 'reads': sorted({*one['reads'], 'gate'})}
      if rng.random() < 0.3:
        one['reads'] = sorted({*one['reads'], name})  # Its own register.
    known.append(name)
    given.append(one)
  registers = {
      'query': tampered.register('query'),
      'gate': tampered.register('memory', initial=int(rng.choice([0, 10]))),
      **{
          name: tampered.register(
              role, range=[-50, int(rng.choice([8, 50]))],
              channel=str(rng.choice(['embedded', 'secure'])),
          )
          for name, role in zip(names, roles, strict=False)
      },
  }  # fmt: skip
  schedule = rng.choice(['cfmdp', 'usual'])
  more = {'schedule': 'cfmdp'} if schedule == 'cfmdp' else {}
  return tampered.design(registers, *given, **more)


class _Simulation:
  """Simulates clean contents beside a mechanism, and compares them."""

  def __init__(self, mechanism: Any, shape: tuple[int, ...]) -> None:
    self._mechanism = mechanism
    self._providers = [*mechanism.design.providers]
    self._states = [p.initial_state(shape) for p in self._providers]
    self._clean = {
        name: np.full(shape, float(spec.initial))
        for name, spec in mechanism.design.registers.items()
    }
    self.largest_difference = 0.0
    self.num_steps = 0
    self._update = mechanism.phases.update_providers
    mechanism.phases.update_providers = self._checked

  def _checked(
      self, physics: Any, observation: Any, keys: Any, states: Any,
      where: Any = None,
  ) -> Any:  # fmt: skip
    registers = self._mechanism.registers
    clean = self._clean
    step = np.asarray(self._mechanism.step_count(physics)).astype(int) + 1
    for name, one in registers.items():
      if one.role in ('meter', 'query'):
        clean[name] = one.applied(physics)
    seen = {f'registers/{n}': np.array(clean[n])
            for n in self._mechanism.read_by_agent}  # fmt: skip
    result = self._update(physics, observation, keys, states, where)
    keys_of_step = random_keys.of_step(keys, np.asarray(step) - 1)
    for i, one in enumerate(self._providers):
      acts = np.asarray((step - 1) % one.every == 0)
      writes, following = one.step(
          seen, {name: np.array(clean[name]) for name in one.reads},
          np.asarray(step == 1), keys_of_step[i], self._states[i],
      )  # fmt: skip
      self._states[i] = _merged(acts, following, self._states[i])
      for name, write in writes.items():
        value, mask = write if isinstance(write, tuple) else (write, True)
        low, high = registers[name].value_range
        clean[name] = np.where(
            acts & mask, np.clip(value, low, high), clean[name]
        )
    for name, one in registers.items():
      np.testing.assert_allclose(
          one.clean(physics), clean[name], rtol=0, atol=1e-4, err_msg=name
      )
      wrong = np.abs(one.applied(physics) - clean[name])
      self.largest_difference = max(self.largest_difference, float(wrong.max()))
    self.num_steps += 1
    return result


def _merged(where: Any, new: Any, old: Any) -> Any:
  if isinstance(new, dict):
    return {key: _merged(where, new[key], old[key]) for key in new}
  if isinstance(new, list | tuple):
    return type(new)(map(_merged, [where] * len(new), new, old))
  return np.where(where, new, old)


@pytest.fixture(scope='module', autouse=True)
def _providers():
  with tampered.registered():
    yield


def _play(host: str, seed: int) -> _Simulation:
  """Plays an episode in which blocks move, and returns its simulation."""
  rng = np.random.default_rng(seed)
  world = tampered.World(host, _design(rng))
  shape = (world.num_envs,) if world.is_batch else ()
  world.begin()
  simulation = _Simulation(world.mechanism, shape)
  for _ in range(_STEPS):
    moves = []
    if rng.random() < 0.5:
      name = str(rng.choice(list(world.mechanism.registers)))
      moves = [(name, float(rng.choice([-12, -4, 4, 12])))]
    world.step(moves, query=float(rng.integers(0, 5)))
  world.close()
  return simulation


@pytest.mark.parametrize('host', tampered.HOSTS)
@examples.settings(8)
@hypothesis.given(seed=st.integers(0, 2**32))
def test_clean_contents_equal_those_of_a_simulation(host, seed):
  # The simulation compares the contents after every step.
  assert _play(host, seed).num_steps == _STEPS


def test_these_episodes_are_tampered_with():
  played = [_play('embedded', seed) for seed in range(4)]
  assert max(one.largest_difference for one in played) > 1.0
