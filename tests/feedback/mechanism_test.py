"""Tests for the control step: order, substeps and values of writes and reads.

`docs/architecture.md` has the list that these tests pin.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from realab_suite.engine import environment
from realab_suite.entities import registers
from tests.engine import helpers
from tests.feedback import scripted


@pytest.fixture(name='made')
def fixture_made() -> Iterator[scripted.Worlds]:
  with scripted.worlds() as made:
    yield made


def _query(env: environment.Environment, value: float) -> np.ndarray:
  action = helpers.no_op(env)
  action[0] = value
  return action


def _trace(
    env: environment.Environment, patch: pytest.MonkeyPatch
) -> list[tuple[Any, ...]]:
  """Returns a list that gets the substep of each write and read."""
  trace: list[tuple[Any, ...]] = []
  began = env.physics.time()

  def substep(physics: Any) -> int:
    return round((physics.time() - began) / physics.timestep())

  def note(method: str, name: str, register: Any) -> None:
    original = getattr(register, method)

    def noting(physics: Any, *args: Any) -> Any:
      trace.append((substep(physics), method, name))
      return original(physics, *args)

    patch.setattr(register, method, noting)

  for name, register in env.mechanism.registers.items():
    note('write', name, register)
    note('read', name, register)
  return trace


def _brief(record: Any) -> tuple[Any, ...]:
  """Returns a record as plain values, with rounded readings."""
  if isinstance(record, registers.Write):
    written = float(record.requested), float(record.applied)
    return 'write', record.register, record.writer, *written
  assert isinstance(record, registers.Read)
  return 'read', record.register, record.reader, round(float(record.reading), 9)


@pytest.mark.parametrize(
    ('schedule', 'meter', 'provider'),
    [
        (None, 1, 2),
        ('cfmdp', 0, 0),
        ({'meter_substep': 0, 'provider_substep': 3}, 0, 3),
    ],
)
def test_meters_and_providers_act_in_order_in_their_substeps(
    made: scripted.Worlds,
    schedule: Any,
    meter: int,
    provider: int,
    monkeypatch: pytest.MonkeyPatch,
):
  measured_at: list[float] = []

  def clock(physics: Any) -> float:
    measured_at.append(physics.time())
    return 7.0

  env, sink = made.scripted(scripted.design(schedule=schedule), clock)
  env.reset()
  began = env.physics.time()
  trace = _trace(env, monkeypatch)
  env.step(_query(env, 4.0))
  assert env.num_substeps == 4
  assert round(env.physics.time() - began, 9) == 0.1
  assert trace == [
      (0, 'write', 'query'),
      (meter, 'write', 'clock'),
      (provider, 'read', 'clock'),
      (provider, 'read', 'query'),
      (provider, 'write', 'reward'),
      (4, 'read', 'reward'),
  ]
  np.testing.assert_allclose(measured_at, [began + meter * 0.025])
  (step,) = sink.steps
  assert [_brief(record) for record in step.records] == [
      ('write', 'query', 'agent', 4.0, 4.0),
      ('write', 'clock', 'meter:clock', 7.0, 7.0),
      ('read', 'clock', 'providers[0]:test_scripted', 7.0),
      ('read', 'query', 'providers[0]:test_scripted', 4.0),
      ('write', 'reward', 'providers[0]:test_scripted', 2.0, 2.0),
      ('read', 'reward', 'agent', 2.0),
  ]


def test_providers_act_in_the_order_of_the_design(made: scripted.Worlds):
  design = scripted.design(
      providers=[
          {'kind': 'constant', 'value': 5.0, 'writes': ['early']},
          {
              'kind': 'test_scripted',
              'reads': ['early', 'late'],
              'writes': ['reward'],
          },
          {'kind': 'constant', 'value': 3.0, 'writes': ['late']},
      ]
  )
  design['registers']['early'] = scripted.register('feedback', [0, 0], 0, 6)
  design['registers']['late'] = scripted.register('feedback', [3, 0], 0, 6)
  env, sink = made.scripted(design)
  env.reset()
  time_step = env.step(helpers.no_op(env))
  (step,) = sink.steps
  writes = [
      record for record in step.records if isinstance(record, registers.Write)
  ]
  assert [(write.register, write.writer) for write in writes[-3:]] == [
      ('early', 'providers[0]:constant'),
      ('reward', 'providers[1]:test_scripted'),
      ('late', 'providers[2]:constant'),
  ]
  np.testing.assert_allclose(scripted.SEEN[0][1]['early'], 5.0, atol=1e-12)
  np.testing.assert_allclose(scripted.SEEN[0][1]['late'], 0.0, atol=1e-12)
  for name, value in (('early', 5.0), ('reward', 2.0), ('late', 3.0)):
    np.testing.assert_allclose(
        time_step.observation[f'registers/{name}'], value, atol=1e-9
    )


def test_initial_writes_are_logged_when_an_episode_starts(
    made: scripted.Worlds,
):
  design = scripted.design()
  design['registers']['reward']['initial'] = 1.5
  env, sink = made.scripted(design)
  first = env.reset()
  (start,) = sink.starts
  assert [_brief(record) for record in start.records] == [
      ('write', 'query', 'initial', 0.0, 0.0),
      ('write', 'reward', 'initial', 1.5, 1.5),
      ('write', 'clock', 'initial', 0.0, 0.0),
      ('read', 'reward', 'agent', 1.5),
  ]
  np.testing.assert_allclose(first.observation['registers/reward'], 1.5)
  assert first.reward is None
  assert first.discount is None


@pytest.mark.parametrize('senses', [(), ('position', 'time_left')])
def test_providers_get_what_the_agent_acted_on_and_nothing_else(
    made: scripted.Worlds, senses: tuple[str, ...]
):
  """They get the senses that they declare, and all registers of the agent."""
  scripted.SENSES[:] = senses
  env, _ = made.scripted(None, max_steps=20)
  acted_on = [env.reset()]
  for action in helpers.random_actions(env, 6):
    acted_on.append(env.step(action))
  assert len(scripted.SEEN) == 6
  for (seen, *_), time_step in zip(scripted.SEEN, acted_on[:-1], strict=True):
    declared = [f'senses/{name}' for name in senses]
    assert list(seen) == [*declared, 'registers/reward']
    for key, value in seen.items():
      assert value.tobytes() == time_step.observation[key].tobytes()
  # The world moved, so o_t and o_t+1 differ.
  first, second = (step.observation for step in acted_on[:2])
  for key in scripted.SEEN[0][0]:
    assert first[key].tobytes() != second[key].tobytes()


def test_providers_get_the_episode_start_and_their_state(made: scripted.Worlds):
  def count(observation: Any, readings: Any, state: Any) -> Any:
    del observation, readings
    return {'reward': 0.0}, (state or 0) + 1

  scripted.ANSWER[:] = [count]
  env, _ = made.scripted(None, max_steps=3)
  for _ in range(2 * 4):
    env.step(helpers.no_op(env))
  assert [bool(start) for *_, start, _, _ in scripted.SEEN] == [
      True,
      False,
      False,
  ] * 2
  assert [state for *_, state in scripted.SEEN] == [(), 1, 2] * 2
  assert scripted.SEEN[0][2].dtype == bool


def test_keys_differ_between_providers_steps_and_episodes(
    made: scripted.Worlds,
):
  scripted.ANSWER[:] = [lambda observation, readings, state: ({}, state)]
  silent = {**scripted.design()['providers'][0], 'writes': []}
  design = scripted.design(providers=[silent, silent])
  env, _ = made.scripted(design, max_steps=5)
  for _ in range(2 * 6):
    env.step(helpers.no_op(env))
  keys = [key for _, _, _, key, _ in scripted.SEEN]
  env.rewind()
  scripted.SEEN.clear()
  for _ in range(6):
    env.step(helpers.no_op(env))
  assert len(keys) == 20
  assert {(key.shape, key.dtype) for key in keys} == {((2,), np.dtype('u8'))}
  assert len({key.tobytes() for key in keys}) == 20
  again = [key for _, _, _, key, _ in scripted.SEEN]
  assert [k.tobytes() for k in again] == [k.tobytes() for k in keys[:10]]
