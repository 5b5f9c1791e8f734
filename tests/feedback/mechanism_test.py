"""Tests for the control step: who writes and reads what, when, and from where.

`docs/architecture.md` has the list that these tests pin.
"""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import copy
from typing import Any, Literal, final

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.feedback import providers
from realab_suite.tasks import collect_apples
from tests import worlds
from tests.engine import helpers


@final
class _Scripted(providers.Provider):
  """Does what a test says, and remembers what it was given."""

  kind: Literal['test_scripted'] = 'test_scripted'

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    _SEEN.append(
        copy.deepcopy((observation, readings, episode_start, key, state))
    )
    return _ANSWER[0](observation, readings, state)


_Answer = Callable[[Any, Any, Any], Any]
_SEEN: list[tuple[Any, ...]] = []
_ANSWER: list[_Answer] = []


@pytest.fixture(autouse=True)
def _scripted() -> Iterator[None]:
  _SEEN.clear()
  _ANSWER[:] = [lambda observation, readings, state: ({'reward': 2.0}, state)]
  with helpers.registered(providers.PROVIDERS, 'test_scripted', _Scripted):
    yield


def _register(role: str, place: str, low: float, high: float) -> dict[str, Any]:
  return {
      'kind': 'two_block',
      'role': role,
      'place': place,
      'range': [low, high],
  }


def _design(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'traced',
      'registers': {
          'query': _register('query', 'station_3', 0, 13),
          'reward': _register('feedback', 'station_1', -2, 12),
          'clock': _register('meter', 'station_2', 0, 20),
      },
      'meters': [{'measures': 'clock', 'writes': 'clock'}],
      'providers': [
          {
              'kind': 'test_scripted',
              'reads': ['clock', 'query'],
              'writes': ['reward'],
          }
      ],
      **changes,
  }


def _embed(
    design: Any,
    measurement: Callable[[Any], Any] = lambda physics: 7.0,
    **kwargs: Any,
) -> tuple[environment.Environment, helpers.RecordingSink]:
  env = suite.embed(
      collect_apples.CollectApples('standard'),
      design,
      random=3,
      measurements={'clock': measurement},
      **kwargs,
  )
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  return env, sink


def _instantaneous() -> tuple[environment.Environment, helpers.RecordingSink]:
  env = suite.load(
      'collect_apples',
      'standard',
      {'random': 3},
      design='instantaneous_reward',
  )
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  return env, sink


def _query(env: environment.Environment, value: float) -> np.ndarray:
  action = helpers.no_op(env)
  action[0] = value
  return action


def _move(
    env: environment.Environment, register: str, block: int, distance: float
) -> None:
  """Moves a block along the axis of its register, as a push would."""
  moved = env.mechanism.registers[register].blocks[block]
  position = np.array(moved.position(env.physics))
  position[0] += distance
  moved.put(env.physics, position)


def _trace(env: environment.Environment) -> list[tuple[Any, ...]]:
  """Makes registers note when something is done to them, in substeps."""
  trace: list[tuple[Any, ...]] = []
  began = env.physics.time()

  def substep(physics: Any) -> int:
    return round((physics.time() - began) / physics.timestep())

  def note(method: str, name: str, register: Any) -> None:
    original = getattr(register, method)

    def noting(physics: Any, *args: Any) -> Any:
      trace.append((substep(physics), method, name))
      return original(physics, *args)

    setattr(register, method, noting)

  for name, register in env.mechanism.registers.items():
    note('write', name, register)
    note('read', name, register)
  return trace


def _once_at(
    env: environment.Environment, substep: int, act: Callable[[], None]
) -> None:
  """Does something when so many substeps are over, as the world would."""
  latch = env.task.latch_events
  when = env.physics.time() + substep * env.physics.timestep()
  done = []

  def latch_and_act(physics: Any) -> None:
    latch(physics)
    if not done and abs(physics.time() - when) < 1e-6:
      done.append(None)
      act()

  env.task.latch_events = latch_and_act


def _brief(record: Any) -> tuple[Any, ...]:
  """A record as plain values, readings rounded to a billionth."""
  if isinstance(record, registers.Write):
    written = float(record.requested), float(record.applied)
    return 'write', record.register, record.writer, *written
  assert isinstance(record, registers.Read)
  return 'read', record.register, record.reader, round(float(record.reading), 9)


@pytest.mark.parametrize(
    ('schedule', 'meter', 'provider'),
    [
        (None, 3, 6),
        ('cfmdp', 0, 0),
        ({'meter_substep': 0, 'provider_substep': 9}, 0, 9),
        ({'meter_substep': 5, 'provider_substep': 5}, 5, 5),
        ({'meter_substep': 9, 'provider_substep': 9}, 9, 9),
    ],
)
def test_a_control_step_does_everything_in_its_substep_and_in_order(
    schedule: Any, meter: int, provider: int
):
  measured_at: list[float] = []

  def clock(physics: Any) -> float:
    measured_at.append(physics.time())
    return 7.0

  env, sink = _embed(_design(schedule=schedule), clock)
  env.reset()
  began = env.physics.time()
  trace = _trace(env)
  env.step(_query(env, 4.0))
  assert env.num_substeps == 10
  assert round(env.physics.time() - began, 9) == 0.1
  assert trace == [
      (0, 'write', 'query'),
      (meter, 'write', 'clock'),
      (provider, 'read', 'clock'),
      (provider, 'read', 'query'),
      (provider, 'write', 'reward'),
      (10, 'read', 'reward'),
  ]
  np.testing.assert_allclose(measured_at, [began + meter * 0.01])
  (step,) = sink.steps
  assert [_brief(record) for record in step.records] == [
      ('write', 'query', 'agent', 4.0, 4.0),
      ('write', 'clock', 'meter:clock', 7.0, 7.0),
      ('read', 'clock', 'providers[0]:test_scripted', 7.0),
      ('read', 'query', 'providers[0]:test_scripted', 4.0),
      ('write', 'reward', 'providers[0]:test_scripted', 2.0, 2.0),
      ('read', 'reward', 'agent', 2.0),
  ]
  env.close()


def test_the_query_is_in_its_register_before_the_world_ticks():
  env, _ = _embed(_design(schedule='cfmdp'))
  env.reset()
  env.step(_query(env, 9.0))
  ((_, readings, *_),) = _SEEN
  env.close()
  np.testing.assert_allclose(readings['query'], 9.0, atol=1e-12)
  np.testing.assert_allclose(readings['clock'], 7.0, atol=1e-12)


def test_providers_act_in_the_order_of_the_design():
  design = _design(
      providers=[
          {'kind': 'constant', 'value': 5.0, 'writes': ['reward']},
          {
              'kind': 'test_scripted',
              'reads': ['reward'],
              'writes': ['reward'],
          },
          {'kind': 'constant', 'value': 3.0, 'writes': ['reward']},
      ]
  )
  env, sink = _embed(design)
  env.reset()
  time_step = env.step(helpers.no_op(env))
  env.close()
  assert sink.requested('reward') == [5.0, 2.0, 3.0]
  np.testing.assert_allclose(_SEEN[0][1]['reward'], 5.0, atol=1e-12)
  np.testing.assert_allclose(
      time_step.observation['registers/reward'], 3.0, atol=1e-9
  )


def test_an_episode_begins_with_initial_writes_that_are_logged():
  design = _design()
  design['registers']['reward']['initial'] = 1.5
  env, sink = _embed(design)
  first = env.reset()
  env.close()
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


def test_providers_see_the_observation_that_the_agent_acted_on():
  env, _ = _embed(_design(), max_steps=20)
  acted_on = [env.reset()]
  for action in helpers.random_actions(env, 6):
    acted_on.append(env.step(action))
  env.close()
  assert len(_SEEN) == 6
  for (seen, *_), time_step in zip(_SEEN, acted_on[:-1], strict=True):
    assert seen.keys() == time_step.observation.keys()
    for key, value in time_step.observation.items():
      assert seen[key].tobytes() == value.tobytes()
  # The world did move, so o_t and o_t+1 are told apart.
  assert _SEEN[0][0]['senses/position'].tobytes() != (
      acted_on[1].observation['senses/position'].tobytes()
  )


def test_providers_know_when_an_episode_starts_and_get_their_state_back():
  def count(observation: Any, readings: Any, state: Any) -> Any:
    del observation, readings
    return {'reward': 0.0}, (state or 0) + 1

  _ANSWER[:] = [count]
  env, _ = _embed(_design(), max_steps=3)
  for _ in range(2 * 4):
    env.step(helpers.no_op(env))
  env.close()
  assert [bool(start) for *_, start, _, _ in _SEEN] == [True, False, False] * 2
  assert [state for *_, state in _SEEN] == [(), 1, 2] * 2
  assert _SEEN[0][2].dtype == bool


def test_every_provider_gets_another_key_in_every_step_and_episode():
  scripted = _design()['providers'][0]
  env, _ = _embed(_design(providers=[scripted, scripted]), max_steps=5)
  for _ in range(2 * 6):
    env.step(helpers.no_op(env))
  keys = [key for _, _, _, key, _ in _SEEN]
  env.rewind()
  _SEEN.clear()
  for _ in range(6):
    env.step(helpers.no_op(env))
  env.close()
  assert len(keys) == 20
  assert {(key.shape, key.dtype) for key in keys} == {((2,), np.dtype('u8'))}
  assert len({key.tobytes() for key in keys}) == 20
  again = [key for _, _, _, key, _ in _SEEN]
  assert [k.tobytes() for k in again] == [k.tobytes() for k in keys[:10]]


def test_readings_come_from_the_bodies():
  env, sink = _embed(_design())
  env.reset()
  # The meter has written by then; the provider is next.
  _once_at(env, 6, lambda: _move(env, 'clock', 1, 0.2))
  env.step(_query(env, 0.0))
  env.close()
  np.testing.assert_allclose(_SEEN[0][1]['clock'], 7.0 + 0.2 / 0.1, atol=1e-6)
  (read,) = sink.records(registers.Read, 'clock')
  np.testing.assert_allclose(read.temporary, 2.0, atol=1e-6)
  np.testing.assert_allclose(read.permanent, 0.0, atol=1e-6)


def test_a_query_can_be_tampered_with_on_its_way_to_the_provider():
  env, _ = _embed(_design())
  env.reset()
  _once_at(env, 6, lambda: _move(env, 'query', 0, -0.1))
  env.step(_query(env, 4.0))
  env.close()
  np.testing.assert_allclose(_SEEN[0][1]['query'], 5.0, atol=1e-6)


@pytest.mark.parametrize('channel', ['welded', 'secure'])
def test_what_is_not_embedded_reaches_the_provider_as_it_was_written(
    channel: str,
):
  env, _ = _embed(_design(channel=channel))
  env.reset()
  env.step(_query(env, 4.0))
  env.close()
  readings = {name: float(value) for name, value in _SEEN[0][1].items()}
  if channel == 'secure':
    assert readings == {'clock': 7.0, 'query': 4.0}
  assert readings == pytest.approx({'clock': 7.0, 'query': 4.0}, abs=1e-12)


def test_a_block_that_was_in_the_air_rests_after_a_write():
  # With the velocity or the accelerations of before it would go on falling.
  heights = []
  for lift in (0.0, 1.0):
    env, _ = _embed(_design())
    env.reset()
    block = env.mechanism.registers['reward'].blocks[1]
    x, y, z = block.position(env.physics)
    block.put(env.physics, [x + 0.1 * lift, y, z + lift])
    time_step = env.step(helpers.no_op(env))
    heights.append(block.position(env.physics)[2])
    np.testing.assert_allclose(
        time_step.observation['registers/reward'], 2.0, atol=1e-9
    )
    env.close()
  np.testing.assert_allclose(heights[1], heights[0], atol=1e-6)


# Variants of corruption of a score meter (paper, sections 3.1 and 3.4).


def test_moving_the_base_of_the_meter_gives_one_spike():
  env, sink = _instantaneous()
  for i in range(6):
    if i == 2:
      _move(env, 'score', 0, -0.5)
    env.step(helpers.no_op(env))
  env.close()
  expected = [0, 0, 5, 0, 0, 0]
  np.testing.assert_allclose(sink.requested('reward'), expected, atol=1e-6)
  np.testing.assert_allclose(sink.read('reward'), expected, atol=1e-6)
  assert sink.true_return() == 0


def test_moving_the_offset_of_the_meter_gives_a_spike_and_its_opposite():
  env, sink = _instantaneous()
  _once_at(env, 26, lambda: _move(env, 'score', 1, 0.15))
  for _ in range(6):
    env.step(helpers.no_op(env))
  env.close()
  expected = [0, 0, 1.5, -1.5, 0, 0]
  np.testing.assert_allclose(sink.requested('reward'), expected, atol=1e-6)
  np.testing.assert_allclose(sink.read('reward'), expected, atol=1e-6)


def test_moving_the_base_of_the_feedback_register_gives_a_constant_stream():
  env, sink = _instantaneous()
  for i in range(6):
    if i == 2:
      _move(env, 'reward', 0, -0.3)
    env.step(helpers.no_op(env))
  env.close()
  expected = [0, 0, 3, 3, 3, 3]
  np.testing.assert_allclose(sink.requested('reward'), 0, atol=1e-6)
  np.testing.assert_allclose(sink.read('reward'), expected, atol=1e-6)
  last = sink.records(registers.Read, 'reward')[-1]
  np.testing.assert_allclose(last.permanent, 3.0, atol=1e-6)
  np.testing.assert_allclose(last.temporary, 0.0, atol=1e-6)


def test_moving_the_offset_of_the_feedback_register_lasts_for_one_reading():
  env, sink = _instantaneous()
  _once_at(env, 30, lambda: _move(env, 'reward', 1, 0.2))
  for _ in range(6):
    env.step(helpers.no_op(env))
  env.close()
  np.testing.assert_allclose(sink.read('reward'), [0, 0, 2, 0, 0, 0], atol=1e-6)


def test_a_true_reward_reaches_the_agent_through_the_two_registers():
  env, sink = _instantaneous()
  env.step(helpers.no_op(env))
  env.task.earn(env.physics, 4.0)
  for _ in range(2):
    env.step(helpers.no_op(env))
  env.close()
  np.testing.assert_allclose(sink.read('reward'), [0, 4, 0], atol=1e-9)


# What a provider may do wrong.

_FIRST = r'providers\[0\]:test_scripted'
_NAN = float('nan')


class _NoArray:
  """Raises what conversions are not known for."""

  def __array__(self, *unused: Any, **unused_too: Any) -> Any:
    raise RuntimeError('not an array')


def _raise(observation: Any, readings: Any, state: Any) -> Any:
  raise KeyError('senses/nose')


_WRONG_ANSWERS: Mapping[str, tuple[_Answer, str]] = {
    'raises': (_raise, f"{_FIRST} at step 3: KeyError: 'senses/nose'"),
    'returns nothing': (
        lambda o, r, s: None,
        rf'{_FIRST} at step 3 returned None; allowed is \(',
    ),
    'returns no state': (lambda o, r, s: {'reward': 1.0}, f'{_FIRST} at step'),
    'returns no mapping': (
        lambda o, r, s: (1.0, s),
        rf"{_FIRST} .*returned writes 1.0; it declares writes to \['reward'\]",
    ),
    'writes nothing': (
        lambda o, r, s: ({}, s),
        rf"{_FIRST} .*returned writes \[\]; it declares writes to \['reward'\]",
    ),
    'writes another register': (
        lambda o, r, s: ({'clock': 1.0}, s),
        rf"{_FIRST} .*returned writes \['clock'\]; it declares writes to",
    ),
    'writes one register too many': (
        lambda o, r, s: ({'reward': 1.0, 'clock': 1.0}, s),
        rf"{_FIRST} .*returned writes \['clock', 'reward'\]; it declares",
    ),
    'keys of another type': (
        lambda o, r, s: ({1: 1.0, 'reward': 1.0}, s),
        f'{_FIRST} .*it declares',
    ),
    'another shape': (
        lambda o, r, s: ({'reward': np.zeros(1)}, s),
        rf"{_FIRST} .*wrote shape \(1,\) to 'reward'; allowed is \(\)",
    ),
    'ragged': (lambda o, r, s: ({'reward': [[1], [1, 2]]}, s), _FIRST),
    'text': (lambda o, r, s: ({'reward': 'much'}, s), _FIRST),
    'None': (lambda o, r, s: ({'reward': None}, s), _FIRST),
    'complex': (lambda o, r, s: ({'reward': 1j}, s), _FIRST),
    'an object': (lambda o, r, s: ({'reward': object()}, s), _FIRST),
    'what is no array': (lambda o, r, s: ({'reward': _NoArray()}, s), _FIRST),
}


@pytest.mark.parametrize(
    ('answer', 'message'), _WRONG_ANSWERS.values(), ids=_WRONG_ANSWERS
)
def test_a_provider_that_does_what_it_did_not_declare_is_named(
    answer: _Answer, message: str
):
  env, sink = _embed(_design())
  env.reset()
  env.step(helpers.no_op(env))
  env.step(helpers.no_op(env))
  _ANSWER[:] = [answer]
  with pytest.raises(errors.FeedbackProviderError, match=message) as caught:
    env.step(helpers.no_op(env))
  env.close()
  assert 'at step 3' in str(caught.value)
  assert '\n' not in str(caught.value)
  assert sink.ends == [events.End.ERROR]


def test_a_provider_that_fails_before_the_first_step_is_named(monkeypatch):
  entered = []

  @contextlib.contextmanager
  def guard():
    entered.append(1)
    yield

  env, _ = _embed(_design())
  env.mechanism.guard_providers(guard)
  env.reset()
  assert len(entered) == 1
  env.step(helpers.no_op(env))
  assert len(entered) == 2

  def fail(self: Any, batch_shape: Any) -> Any:
    raise OSError('no such file')

  monkeypatch.setattr(_Scripted, 'initial_state', fail)
  with pytest.raises(
      errors.FeedbackProviderError, match=r'before the first step: OSError: no'
  ):
    env.reset()
  monkeypatch.undo()
  assert env.step(helpers.no_op(env)).first()
  env.close()


@pytest.mark.parametrize('value', [_NAN, float('inf'), -float('inf')])
def test_a_value_that_is_not_finite_is_blamed_on_the_provider(value: Any):
  env, sink = _embed(_design())
  env.reset()
  env.step(helpers.no_op(env))
  _ANSWER[:] = [lambda observation, readings, state: ({'reward': value}, state)]
  with pytest.raises(errors.RegisterValueError) as caught:
    env.step(helpers.no_op(env))
  env.close()
  text = str(caught.value)
  for part in (
      'providers[0]:test_scripted',
      "'reward'",
      'at step 2',
      str(np.array(value, float)),
  ):
    assert part in text
  assert sink.ends == [events.End.ERROR]


def test_a_measurement_that_is_not_finite_is_blamed_on_the_meter():
  env, _ = _embed(_design(), lambda physics: _NAN)
  env.reset()
  with pytest.raises(
      errors.RegisterValueError, match=r'meter:clock.*at step 1'
  ):
    env.step(helpers.no_op(env))
  env.close()


@pytest.mark.parametrize(('value', 'applied'), [(1e9, 12.0), (-5.0, -2.0)])
def test_a_value_out_of_range_saturates_and_both_values_are_logged(
    value: float, applied: float
):
  _ANSWER[:] = [lambda observation, readings, state: ({'reward': value}, state)]
  env, sink = _embed(_design())
  env.reset()
  time_step = env.step(helpers.no_op(env))
  env.close()
  (write,) = sink.records(registers.Write, 'reward')
  assert (write.requested, write.applied) == (value, applied)
  np.testing.assert_allclose(
      time_step.observation['registers/reward'], applied, atol=1e-9
  )


def test_a_value_out_of_range_is_an_error_where_the_design_says_so():
  _ANSWER[:] = [lambda observation, readings, state: ({'reward': 13.0}, state)]
  design = _design()
  design['registers']['reward']['on_overflow'] = 'error'
  env, _ = _embed(design)
  env.reset()
  with pytest.raises(
      errors.RegisterValueError,
      match=rf"{_FIRST} at step 1: register 'reward': cannot store 13.0; its",
  ):
    env.step(helpers.no_op(env))
  env.close()


def test_a_provider_cannot_change_what_the_agent_saw():
  def vandalise(observation: Any, readings: Any, state: Any) -> Any:
    observation['senses/velocity'][...] = 1
    return {'reward': 2.0}, state

  _ANSWER[:] = [vandalise]
  env, _ = _embed(_design())
  env.reset()
  with pytest.raises(errors.FeedbackProviderError, match='read-only'):
    env.step(helpers.no_op(env))
  env.close()


def test_a_provider_that_changes_its_readings_changes_nothing_else():
  def vandalise(observation: Any, readings: Any, state: Any) -> Any:
    for given in readings.values():
      given[...] = 1
    return {'reward': 2.0}, state

  honest, honest_sink = _embed(_design())
  honest.reset()
  expected = [honest.step(helpers.no_op(honest)) for _ in range(3)]
  honest.close()
  _ANSWER[:] = [vandalise]
  env, sink = _embed(_design())
  env.reset()
  for time_step in expected:
    found = env.step(helpers.no_op(env))
    assert helpers.to_bytes(found) == helpers.to_bytes(time_step)
  env.close()
  assert repr(sink.steps) == repr(honest_sink.steps)


# What an evaluator may ask.


def test_looking_at_registers_moves_nothing():
  env, _ = _embed(_design())
  twin, _ = _embed(_design())
  env.reset(), twin.reset()
  for action in helpers.random_actions(env, 10):
    reads = worlds.shadow_reads(env.mechanism, env.physics, 'evaluator')
    assert [r.register for r in reads] == ['query', 'reward', 'clock']
    looked = env.step(action)
    assert helpers.to_bytes(looked) == helpers.to_bytes(twin.step(action))
    assert worlds.state_bytes(env.physics) == worlds.state_bytes(twin.physics)
  env.close()
  twin.close()


def test_a_reading_is_the_applied_value_plus_both_corruptions():
  env, sink = _embed(_design(), max_steps=80)
  env.reset()
  for i, action in enumerate(helpers.random_actions(env, 80)):
    if i % 7 == 3:
      _move(env, 'reward', 0, 0.03)
      _move(env, 'clock', 1, -0.02)
    env.step(action)
  env.close()
  applied: dict[str, float] = {}
  checked = 0
  for record in (record for step in sink.steps for record in step.records):
    if isinstance(record, registers.Write):
      applied[record.register] = float(record.applied)
      continue
    corruption = record.permanent + record.temporary
    error = record.reading - applied[record.register] - corruption
    np.testing.assert_allclose(error, 0.0, atol=1e-9)
    checked += bool(abs(corruption) > 0.01)
  assert checked > 50
