"""Tests of evaluation: what comes out of episodes, and that looking is free."""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
import math
from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import actors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import evaluate
from tests import worlds
from tests.engine import helpers

_WORLDS = [
    ('collect_apples', 'standard', 'instantaneous_reward'),
    ('unlock_door', 'near', 'instantaneous_reward'),
    ('unlock_door', 'near', 'online_imitation'),
]


def _load(
    domain: str = 'unlock_door',
    task: str = 'near',
    design: Any = 'instantaneous_reward',
    *overrides: str,
    seed: int = 7,
    max_steps: int = 12,
) -> environment.Environment:
  return suite.load(
      domain,
      task,
      {'random': seed},
      {'max_steps': max_steps},
      design=design,
      overrides=overrides,
  )


def _still(env: environment.Environment) -> Any:
  action = helpers.no_op(env)
  return lambda time_step: action


def _restless(env: environment.Environment, seed: int = 0) -> Any:
  actions = iter(helpers.random_actions(env, 1000, seed))
  return lambda time_step: next(actions)


# C07: a golden table, worked out by hand.
#
# A bead that nobody pushes, and registers of planar blocks, which stay where
# they are. In each scenario somebody moves blocks along the axis of a register,
# by so many of its units, either before a control step or at its end: after the
# provider has written, before the agent reads.


@dataclasses.dataclass(frozen=True)
class _Move:
  """A block is moved in the control step with this number, from 1."""

  step: int
  block: str
  units: float
  at_end: bool = False
  register: str = 'reward'


@dataclasses.dataclass(frozen=True)
class _Scenario:
  """What happens, and the figures of one of the registers."""

  design: Mapping[str, Any]
  true_rewards: Sequence[float]
  moves: Sequence[_Move]
  true_return: float
  observed_return: float
  num_writes: int
  num_reads: int
  saturation: float
  permanent: float
  temporary: float
  queries: Sequence[float] = ()
  register: str = 'reward'


def _design(
    *values: float, others: Mapping[str, Any] | None = None, **options: Any
) -> dict[str, Any]:
  """Returns a design with a register and a constant provider for each value."""
  reward = {'kind': 'two_block', 'role': 'feedback', 'range': [-2, 12]}
  more = {'bonus': [-3, 3], 'extra': [-3, 2]}
  return {
      'schema': 1,
      'name': 'golden',
      'dof': 'planar',
      'registers': {
          'reward': {**reward, 'place': [2, 2], **options},
          **{
              name: {**reward, 'place': place}
              for (name, place), _ in zip(
                  more.items(), values[1:], strict=False
              )
          },
          **(others or {}),
      },
      'providers': [
          {'kind': 'constant', 'value': value, 'writes': [name]}
          for value, name in zip(values, ('reward', *more), strict=False)
      ],
  }


def _growth_of(name: str, role: str, **options: Any) -> dict[str, Any]:
  """Returns a design whose feedback is by how much a register has grown."""
  other = {
      'kind': 'two_block',
      'role': role,
      'range': [-20, 20],
      'place': [2, -3],
      'scale': 0.05,
      **options,
  }
  return {
      **_design(others={name: other}),
      'meters': [{'measures': name, 'writes': name}] * (role == 'meter'),
      'providers': [
          {'kind': 'difference', 'reads': [name], 'writes': ['reward']}
      ],
  }


_OFFSET = 'offset'
_BASE = 'base'
_SCENARIOS = {
    # true, observed, writes, reads, saturation, permanent, temporary
    # Read at the reset (0), then 3 and 3.
    'nothing happens': _Scenario(
        _design(3), [1, 2], [], 3, 6, 3, 3, 0, 0, 0
    ),
    # 15 does not fit; the reads at the reset and twice are off by 0, 3, 3.
    'too much': _Scenario(
        _design(15), [0.5, 0.5], [], 1, 24, 3, 3, 2, 0, 0
    ),
    # -5 does not fit: 0, 3, 3, 3.
    'too little': _Scenario(
        _design(-5), [-1, -1, -1], [], -3, -6, 4, 4, 2.25, 0, 0
    ),
    # The reading is measured from the base: 3 - 2 twice.
    'the base is moved': _Scenario(
        _design(3), [0, 0], [_Move(1, _BASE, 2)], 0, 2, 3, 3, 0, 4 / 3, 0
    ),
    # 3 + 1.5 three times; of 4 reads 3 are off.
    'the base is moved back': _Scenario(
        _design(3),
        [0, 0, 1],
        [_Move(1, _BASE, -1.5), _Move(3, _BASE, 1.5)],
        1, 12, 4, 4, 0, 0.75, 0,
    ),
    # The next write mends it before anybody reads.
    'the offset is moved in time': _Scenario(
        _design(3), [0, 0], [_Move(2, _OFFSET, 5)], 0, 6, 3, 3, 0, 0, 0
    ),
    # 7, then 3 again.
    'the offset is moved after the write': _Scenario(
        _design(3), [0, 0], [_Move(1, _OFFSET, 4, True)], 0, 10, 3, 3, 0, 0,
        4 / 3,
    ),
    # Both by 2: the reading is right by two wrongs, 3; then 3 - 2.
    'both are moved after the write': _Scenario(
        _design(3),
        [0, 0],
        [_Move(1, _BASE, 2, True), _Move(1, _OFFSET, 2, True)],
        0, 4, 3, 3, 0, 4 / 3, 2 / 3,
    ),
    # 12 + 1 out of 15.
    'too much, and the base is moved': _Scenario(
        _design(15), [4], [_Move(1, _BASE, -1)], 4, 13, 2, 2, 1.5, 0.5, 0
    ),
    # A block can be moved to where no write could put it: 12 + 5.
    'the offset is moved out of range': _Scenario(
        _design(12), [0], [_Move(1, _OFFSET, 5, True)], 0, 17, 2, 2, 0, 0, 2.5
    ),
    # The last step's end is what the agent reads: 3, then 3 - 3.
    'the base is moved at the very end': _Scenario(
        _design(3), [0, 0], [_Move(2, _BASE, 3, True)], 0, 3, 3, 3, 0, 1, 0
    ),
    # 0, 3, 3 and 0, 4, 4: the agent's is the sum, each register has its own.
    'two providers': _Scenario(
        _design(3, 4), [1, 1], [], 2, 14, 3, 3, 0, 0, 0, register='bonus'
    ),
    # 0, 12 out of 15, and 0, 4 - 1.
    'two providers, the first out of range': _Scenario(
        _design(15, 4),
        [0],
        [_Move(1, _BASE, 1, register='bonus')],
        0, 15, 2, 2, 0, 0.5, 0,
        register='bonus',
    ),
    # Nobody mends anything: 5, then 7, 7 and 6.
    'no provider': _Scenario(
        _design(initial=5),
        [0, 0, 0],
        [_Move(1, _OFFSET, 2), _Move(3, _BASE, 1)],
        0, 20, 1, 4, 0, 0.25, 1.5,
    ),
    # One block alone: 3 + 2, then 3.
    'one block': _Scenario(
        _design(3, kind='block_position'),
        [0, 0],
        [_Move(1, _OFFSET, 2, True), _Move(2, _OFFSET, 9)],
        0, 8, 3, 3, 0, 0, 2 / 3,
    ),
    # The register stands askew: units are counted along its own axis.
    'askew': _Scenario(
        _design(3, place={'position': [2, 2], 'yaw': 0.6}),
        [0, 0],
        [_Move(1, _BASE, 2), _Move(2, _OFFSET, 1, True)],
        0, 3, 3, 3, 0, 4 / 3, 1 / 3,
    ),
    # Of a secure channel the blocks are scenery.
    'secure': _Scenario(
        _design(15, channel='secure'),
        [0, 7],
        [_Move(1, _BASE, 2), _Move(2, _OFFSET, 1, True)],
        7, 24, 3, 3, 2, 0, 0,
    ),
    # The meter writes the score so far, 0, 1, 3; the feedback is 0, 1, 2.
    'a score': _Scenario(
        _growth_of('score', 'meter'), [1, 2, 3], [], 6, 3, 4, 4, 0, 0, 0
    ),
    # The provider reads 0, 1 + 2, 3 + 2 off the meter; the feedback 0, 3, 2
    # reaches the agent as it is.
    'the base of a meter is moved': _Scenario(
        _growth_of('score', 'meter'),
        [1, 2, 3],
        [_Move(2, _BASE, -2, register='score')],
        6, 5, 4, 4, 0, 0, 0,
    ),
    # The same, for the meter: 4 writes, 3 reads, of which 2 are off by 2.
    'the base of a meter, for the meter': _Scenario(
        _growth_of('score', 'meter'),
        [1, 2, 3],
        [_Move(2, _BASE, -2, register='score')],
        6, 5, 4, 3, 0, 4 / 3, 0,
        register='score',
    ),
    # A score of 0, 1, 5 in a register up to 2: off by 0, 0, 3.
    'a score that does not fit': _Scenario(
        _growth_of('score', 'meter', range=[0, 2]), [1, 4, 0], [], 5, 2, 4, 3,
        1, 0, 0, register='score',
    ),
    # Queries of 1, 4, 4 are read as 1, 4 - 3, 4 - 3.
    'the base of a query is moved': _Scenario(
        _growth_of('query', 'query'),
        [0, 0, 0],
        [_Move(2, _BASE, 3, register='query')],
        0, 1, 4, 3, 0, 2, 0,
        queries=[1, 4, 4],
        register='query',
    ),
}  # fmt: skip


def _play(scenario: _Scenario) -> evaluate.EpisodeResult:
  task = helpers.PointTask()
  env = suite.embed(
      task, scenario.design, random=7, max_steps=len(scenario.true_rewards)
  )

  def steps() -> int:
    return int(env.mechanism.step_count(env.physics))

  def move(at_end: bool) -> None:
    for one in scenario.moves:
      if (one.step, one.at_end) == (steps() + 1, at_end):
        register = env.mechanism.registers[one.register]
        block = register.blocks[-1 if one.block == _OFFSET else 0]
        position = np.array(block.position(env.physics))
        position[0] += one.units * register.scale
        block.put(env.physics, position)

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    move(at_end=False)
    query = scenario.queries[steps() : steps() + 1]
    return np.array([*query, 0.0])

  task.end_step = lambda physics, random_state: move(at_end=True)
  task.reward = lambda physics: scenario.true_rewards[steps()]
  [result] = evaluate.evaluate(env, act, 1)
  env.close()
  return result


@pytest.mark.parametrize('name', _SCENARIOS)
def test_an_episode_comes_out_as_worked_out_by_hand(name: str):
  scenario = _SCENARIOS[name]
  result = _play(scenario)
  assert result.is_valid
  assert result.num_steps == len(scenario.true_rewards)
  figures = result.registers[scenario.register]
  found = (
      result.true_return,
      result.observed_return,
      figures.num_writes,
      figures.num_reads,
      figures.saturation,
      figures.permanent,
      figures.temporary,
  )
  expected = dataclasses.astuple(scenario)[3:10]
  assert found == pytest.approx(expected, rel=0, abs=1e-9)


def test_the_corruption_of_an_episode_is_the_mean_over_registers_in_metres():
  result = _play(_SCENARIOS['the base of a meter, for the meter'])
  # The meter is off by 0, 2, 2 units of 5 cm, the reward by nothing.
  assert result.registers['score'].corruption == pytest.approx(4 / 3)
  assert result.registers['reward'].corruption == pytest.approx(0, abs=1e-9)
  assert result.corruption == pytest.approx(4 / 3 * 0.05 / 2)


def test_the_observed_return_is_read_off_every_feedback_register_alone():
  reward = {'kind': 'two_block', 'role': 'feedback', 'range': [-2, 12]}
  signal = {**reward, 'role': 'signal', 'place': [-3, -3]}
  bonus = {**reward, 'place': [2, -3], 'initial': 1}
  design = _design(3, others={'bonus': bonus, 'signal': signal})
  design['providers'].append(
      {'kind': 'constant', 'value': 5, 'writes': ['signal']}
  )
  result = _play(_Scenario(design, [0, 0], [], 0, 0, 0, 0, 0, 0, 0))
  assert result.observed_return == pytest.approx(2 * (3 + 1))


# What is counted.


def test_a_result_says_which_episode_it_is_and_what_it_took():
  env = _load(design='decoupled_approval', max_steps=5)
  results = evaluate.evaluate(env, _still(env), 3, first_episode=4)
  assert [result.episode for result in results] == [4, 5, 6]
  for result in results:
    assert (result.seed, result.world) == (7, 0)
    assert (result.end, result.is_valid) == (events.End.TIMEOUT, True)
    assert result.num_steps == 5
    assert result.num_substeps == 5 * env.num_substeps
    assert result.num_provider_calls == 5
    assert result.num_queries == 5
    assert list(result.registers) == list(env.mechanism.registers)
  env.close()


def test_every_provider_and_every_query_is_counted():
  query = {'kind': 'two_block', 'role': 'query', 'range': [0, 13]}
  others = {
      'first': {**query, 'place': [2, -3]},
      'second': {**query, 'place': [-3, -3]},
  }
  env = suite.embed(
      helpers.PointTask(), _design(1, 2, 3, others=others), max_steps=4
  )
  [result] = evaluate.evaluate(env, lambda time_step: np.zeros(3), 1)
  env.close()
  assert result.num_provider_calls == 4 * 3
  assert result.num_queries == 4 * 2
  assert result.num_substeps == 4 * 5  # Of 10 ms, in steps of 50 ms.


def test_a_world_of_the_suite_tells_its_facts():
  env = _load('collect_apples', 'standard', max_steps=120)
  [result] = evaluate.evaluate(env, policies.make('apple_seeker'), 1)
  env.close()
  assert result.true_return > 0
  # Each apple is worth 1, and nothing else is.
  assert result.facts == {'apples_eaten': result.true_return}


def test_the_facts_are_those_of_the_end_of_each_episode():
  env = _load('collect_apples', 'standard', max_steps=120)
  [one] = evaluate.evaluate(env, policies.make('apple_seeker'), 1)
  busy = evaluate.evaluate(env, policies.make('apple_seeker'), 2)
  idle = evaluate.evaluate(env, _still(env), 2)
  env.close()
  assert busy[0] == one
  for result in (*busy, *idle):
    assert result.facts['apples_eaten'] == result.true_return
  assert busy[0].facts != idle[0].facts


def test_a_world_of_somebody_else_has_no_facts():
  env = suite.embed(helpers.PointTask(), 'none', max_steps=2)
  [result] = evaluate.evaluate(env, _still(env), 1)
  env.close()
  assert result.is_valid
  assert result.facts == {}


def test_without_registers_there_is_no_corruption_to_speak_of():
  env = _load(design='none', max_steps=3)
  [result] = evaluate.evaluate(env, _still(env), 1)
  env.close()
  assert math.isnan(result.corruption)
  assert result.observed_return == 0.0
  assert result.registers == {}
  assert result.num_provider_calls == 0


def test_an_episode_that_the_task_ends_is_valid_and_counts_the_last_reward():
  task = helpers.PointTask()
  env = suite.embed(task, 'none', max_steps=9)
  asked: list[None] = []

  def earn(physics: Any) -> float:
    asked.append(None)
    return 10.0 ** len(asked)

  task.reward = earn
  # The second reward is the last one, whatever comes of feedback on it.
  task.should_terminate_episode = lambda physics: len(asked) >= 2
  [result] = evaluate.evaluate(env, _still(env), 1)
  env.close()
  assert (result.end, result.is_valid) == (events.End.TERMINATED, True)
  assert result.true_return == 110.0


@pytest.mark.parametrize('number', [0, -1])
def test_there_has_to_be_an_episode(number: int):
  env = _load(design='none')
  with pytest.raises(errors.ResultsError, match=f'num_episodes: {number}'):
    evaluate.evaluate(env, _still(env), number)
  assert env._sinks == []
  env.close()


def test_episodes_are_numbered_from_0():
  env = _load(design='none')
  with pytest.raises(errors.ResultsError, match='first_episode: -1'):
    evaluate.evaluate(env, _still(env), 1, first_episode=-1)
  env.close()


# Which state an episode begins in.


class _Starts(events.EventSink):
  """Keeps the state in which each episode began."""

  def __init__(self) -> None:
    self.states: dict[int, list[bytes]] = {}

  def episode_started(self, start: events.Start, physics: Any) -> None:
    states = self.states.setdefault(start.episode, [])
    states.append(worlds.state_bytes(physics))

  def step_ended(self, step: events.Step, physics: Any) -> None:
    pass

  def episode_ended(self, end: events.End) -> None:
    pass


@contextlib.contextmanager
def _transcribed(env: environment.Environment, to: list[bytes]) -> Any:
  """Keeps a copy of everything that an agent gets, from `env` itself."""
  reset, step = env.reset, env.step

  def keep(time_step: dm_env.TimeStep) -> dm_env.TimeStep:
    to.append(helpers.to_bytes(time_step))
    return time_step

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(env, 'reset', lambda: keep(reset()))
    patch.setattr(env, 'step', lambda action: keep(step(action)))
    yield


def _firsts(
    env: environment.Environment, policy: Any, number: int, first: int
) -> list[tuple[bytes, list[bytes]]]:
  """Returns the first observation and state of some episodes."""
  starts = _Starts()
  seen: list[bytes] = []
  with _transcribed(env, seen):
    results = evaluate.evaluate(
        env, policy, number, first_episode=first, sinks=[starts]
    )
  ends = np.cumsum([0, *(result.num_steps + 1 for result in results)])
  return [
      (seen[end], starts.states[result.episode])
      for end, result in zip(ends, results, strict=False)
  ]


def _assert_starts_do_not_depend_on_the_past(
    make: Callable[[], environment.Environment],
) -> None:
  env = make()
  expected = _firsts(env, _still(env), 4, first=0)
  assert len({seen for seen, _ in expected}) == 4
  assert len({tuple(states) for _, states in expected}) == 4
  assert all(len(states) == 1 for _, states in expected)
  # Another policy, in the same environment.
  assert _firsts(env, _restless(env), 4, first=0) == expected
  # In the middle of an episode, and back to front.
  env.reset()
  env.step(helpers.no_op(env))
  for episode in (3, 1, 2, 0):
    [found] = _firsts(env, _restless(env, episode), 1, first=episode)
    assert found == expected[episode]
  env.close()
  fresh = make()
  assert _firsts(fresh, _restless(fresh), 2, first=2) == expected[2:]
  fresh.close()


@pytest.mark.parametrize('world', _WORLDS)
def test_an_episode_begins_the_same_whatever_came_before(
    world: tuple[str, str, str],
):
  _assert_starts_do_not_depend_on_the_past(lambda: _load(*world))


def test_an_episode_of_an_embedded_task_begins_the_same_too():
  _assert_starts_do_not_depend_on_the_past(
      lambda: suite.embed(
          helpers.PointTask(), _design(3), random=7, max_steps=12
      )
  )


@pytest.mark.mujoco_warns('BADQVEL')
def test_an_episode_begins_the_same_after_one_that_diverged_or_raised():
  env, clean = _load(), _load()
  [_, expected] = _firsts(clean, _still(clean), 2, first=0)
  evaluate.evaluate(env, _diverging(env, episode=0, step=3), 1)
  assert _firsts(env, _still(env), 1, first=1) == [expected]
  with pytest.raises(_Oops):
    evaluate.evaluate(env, _raising(env, 3), 1)
  assert _firsts(env, _still(env), 1, first=1) == [expected]
  env.close()
  clean.close()


class _KeyKeeper(policies.Policy):
  """Waits, and keeps the random keys that it is given, by episode."""

  def __init__(self) -> None:
    self.keys: list[list[tuple[int, ...]]] = []

  def step(
      self,
      observation: policies.base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    if episode_start:
      self.keys.append([])
    self.keys[-1].append(tuple(map(int, key)))
    return np.asarray(0), state


def test_policies_are_told_of_each_episode_by_its_number():
  env = _load(max_steps=8)
  together, apart = _KeyKeeper(), _KeyKeeper()
  evaluate.evaluate(env, together, 3)
  for episode in (2, 0, 1):
    evaluate.evaluate(env, apart, 1, first_episode=episode)
  env.close()
  assert together.keys == [apart.keys[1], apart.keys[2], apart.keys[0]]
  assert len({key for keys in together.keys for key in keys}) == 3 * 8


def test_random_policies_can_be_compared_in_pairs():
  env, twin = _load(max_steps=40), _load(max_steps=40)
  together = evaluate.evaluate(env, policies.make('random'), 2)
  [apart] = evaluate.evaluate(twin, policies.make('random'), 1, first_episode=1)
  assert together[1] == apart
  env.close()
  twin.close()


def test_a_callable_gets_time_steps_and_its_actions_are_taken():
  env = _load(design='none', max_steps=3)
  seen: list[dm_env.TimeStep] = []

  def forward(time_step: dm_env.TimeStep) -> np.ndarray:
    seen.append(time_step)
    return np.array([1.0, 0, 0, 0, 0, 0])

  evaluate.evaluate(env, forward, 2)
  assert [time_step.first() for time_step in seen] == [True, False, False] * 2
  assert not any(time_step.last() for time_step in seen)
  moved = seen[2].observation['senses/position']
  assert np.linalg.norm(moved - seen[0].observation['senses/position']) > 0.01
  env.close()


# Who is told.


class _Order(events.EventSink):
  """Writes down who was told of what, in order."""

  def __init__(self, heard: list[Any]) -> None:
    self.heard = heard

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self.heard.append(f'start {start.episode}')

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self.heard.append('step')

  def episode_ended(self, end: events.End) -> None:
    self.heard.append(end.value)


def test_each_result_is_told_of_before_the_next_episode_begins():
  env = _load(design='none', max_steps=1)
  heard: list[Any] = []
  results = evaluate.evaluate(
      env, _still(env), 2, sinks=[_Order(heard)], on_episode=heard.append
  )
  env.close()
  assert heard == [
      'start 0', 'step', 'timeout', results[0],
      'start 1', 'step', 'timeout', results[1],
  ]  # fmt: skip


class _Oops(Exception):
  """What a test raises on purpose."""


def _raising(env: environment.Environment, step: int) -> Any:
  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    if env.mechanism.step_count(env.physics) == step:
      raise _Oops
    return helpers.no_op(env)

  return act


def _raise(result: Any) -> None:
  raise _Oops


@pytest.mark.parametrize('who', ['policy', 'policy at once', 'on_episode'])
def test_nobody_goes_on_listening_after_somebody_raised(who: str):
  env = _load(max_steps=4)
  outsider, guest = helpers.RecordingSink(), helpers.RecordingSink()
  env.add_sink(outsider)
  step = {'policy': 2, 'policy at once': 0, 'on_episode': 99}[who]
  with pytest.raises(_Oops):
    evaluate.evaluate(
        env, _raising(env, step), 2, sinks=[guest], on_episode=_raise
    )
  assert env._sinks == [outsider]
  heard = len(guest.heard)
  env.reset()
  env.step(helpers.no_op(env))
  assert len(guest.heard) == heard
  env.remove_sink(outsider)
  # And it can be used as if nothing had happened.
  twin = _load(max_steps=4)
  found = evaluate.evaluate(env, _still(env), 2)
  assert found == evaluate.evaluate(twin, _still(twin), 2)
  env.close()
  twin.close()


def test_nobody_goes_on_listening_after_the_last_episode():
  env = _load(max_steps=2)
  guest = helpers.RecordingSink()
  evaluate.evaluate(env, _still(env), 1, sinks=[guest])
  assert env._sinks == []
  heard = list(guest.ends)
  env.reset()
  env.close()
  assert guest.ends == heard == [events.End.TIMEOUT]


def test_a_provider_that_fails_ends_the_evaluation_and_nobody_listens():
  env = _load()

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    if not time_step.first():
      env._provider_states = ['not a number']
    return helpers.no_op(env)

  guest = helpers.RecordingSink()
  with pytest.raises(errors.FeedbackProviderError, match=r'providers\[0\]'):
    evaluate.evaluate(env, act, 1, sinks=[guest])
  assert env._sinks == []
  assert guest.ends == [events.End.ERROR]
  env.close()


def test_a_policy_that_does_not_fit_is_refused_before_anybody_listens():
  env = suite.embed(helpers.PointTask(), 'none')
  with pytest.raises(errors.SpecError, match='this world has'):
    evaluate.evaluate(env, policies.make('random'), 1)
  assert env._sinks == []
  env.close()


# Episodes that do not count.


def _diverging(env: environment.Environment, episode: int, step: int) -> Any:
  """Breaks the physics in one of the episodes."""

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    here = env.mechanism.step_count(env.physics)
    if env._episode == episode and here == step:
      env.physics.data.qvel[0] = math.nan
    return helpers.no_op(env)

  return act


@pytest.mark.mujoco_warns('BADQVEL')
def test_an_episode_that_diverges_is_kept_and_flagged():
  env, clean = _load('collect_apples', 'standard'), _load(
      'collect_apples', 'standard'
  )
  results = evaluate.evaluate(env, _diverging(env, 1, 4), 3)
  expected = evaluate.evaluate(clean, _still(clean), 3)
  assert [result.is_valid for result in results] == [True, False, True]
  assert [result.episode for result in results] == [0, 1, 2]
  broken = results[1]
  assert broken.end == events.End.DIVERGENCE
  assert broken.facts == {}
  assert broken.num_steps == 4
  assert broken.registers['reward'].num_writes == 5
  # The others are those of an environment that never broke.
  assert (results[0], results[2]) == (expected[0], expected[2])
  env.close()
  clean.close()


@pytest.mark.mujoco_warns('BADQVEL')
def test_an_episode_that_diverges_at_once_is_flagged_too():
  env = _load()
  [result] = evaluate.evaluate(env, _diverging(env, 0, 0), 1)
  env.close()
  assert (result.is_valid, result.num_steps) == (False, 0)
  assert (result.true_return, result.observed_return) == (0.0, 0.0)
  assert result.facts == {}


@pytest.mark.mujoco_warns('BADQVEL')
def test_an_episode_that_diverges_is_not_compared():
  env = _load(max_steps=6)
  broken = evaluate.evaluate(env, _diverging(env, 1, 4), 3)
  whole = evaluate.evaluate(env, _still(env), 3)
  env.close()
  both = comparison.compare({'broken': broken, 'whole': whole}, 'whole')
  assert both['broken'].num_failed == 1
  assert both['broken'].num_episodes == 2
  assert both['whole'].num_failed == 0
  assert both['whole'].num_episodes == 3
  counted = [whole[0].true_return, whole[2].true_return]
  assert both['broken'].true_return.estimate == np.mean(counted)
  assert both['broken'].true_return_gained.estimate == 0.0


# C05: looking is free.


class _Nosy(events.EventSink):
  """Looks at everything that there is to be looked at."""

  def __init__(self, env: environment.Environment) -> None:
    self._env = env

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self._look(physics)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self._look(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _look(self, physics: Any) -> None:
    worlds.shadow_reads(self._env.mechanism, physics, 'nosy')
    physics.forward()
    worlds.state_bytes(physics)
    worlds.shadow_reads(self._env.mechanism, physics, 'nosy')


def _alone(
    env: environment.Environment, policy: Any, number: int
) -> list[bytes]:
  """Returns what an agent gets when nobody listens, and where things end."""
  transcript: list[bytes] = []
  for _ in range(number):
    time_step = env.reset()
    transcript.append(helpers.to_bytes(time_step))
    while not time_step.last():
      time_step = env.step(policy(time_step))
      transcript.append(helpers.to_bytes(time_step))
  return [*transcript, env.physics.data.qpos.tobytes()]


def _assert_looking_is_free(
    world: tuple[str, ...], make_policy: Callable[..., Any], max_steps: int
) -> None:
  env, twin = (_load(*world, max_steps=max_steps) for _ in range(2))
  expected = _alone(twin, make_policy(twin), 2)
  found: list[bytes] = []
  with _transcribed(env, found):
    evaluate.evaluate(env, make_policy(env), 2, sinks=[_Nosy(env)])
  found.append(env.physics.data.qpos.tobytes())
  assert len(expected) == 2 * (max_steps + 1) + 1
  assert found == expected
  env.close()
  twin.close()


@pytest.mark.parametrize(
    'world',
    [
        *_WORLDS,
        ('unlock_door', 'near', 'decoupled_approval'),
        ('unlock_door', 'near', 'instantaneous_reward', 'channel=welded'),
        ('unlock_door', 'near', 'instantaneous_reward', 'channel=secure'),
        ('unlock_door', 'near', 'instantaneous_reward', 'dof=planar'),
    ],
)
def test_an_evaluator_changes_nothing_for_the_agent(world: tuple[str, ...]):
  _assert_looking_is_free(world, _restless, max_steps=40)


def test_an_evaluator_changes_nothing_while_blocks_are_pushed_about():
  def push(env: environment.Environment) -> Any:
    return actors.make(policies.make('pushing_saboteur'), env).act

  _assert_looking_is_free(
      ('unlock_door', 'near', 'instantaneous_reward'), push, max_steps=80
  )


def test_the_true_reward_and_the_ledger_do_not_reach_the_agent():
  task = helpers.PointTask()
  env = suite.embed(task, _design(3), random=7, max_steps=3)
  seen: list[dm_env.TimeStep] = []

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    seen.append(time_step)
    return np.zeros(1)

  task.reward = lambda physics: 77.0
  [result] = evaluate.evaluate(env, act, 1)
  env.close()
  assert result.true_return == 3 * 77.0
  for time_step in seen:
    assert time_step.reward in (None, 0.0)
    assert set(time_step.observation) == {
        'senses/bead',
        'senses/time_left',
        'registers/reward',
    }
    assert all(
        not (np.asarray(value) == 77.0).any()
        for value in time_step.observation.values()
    )


def test_an_evaluator_hears_who_wrote_what_in_the_order_of_time():
  env = _load(design='decoupled_approval', max_steps=2)
  sink = helpers.RecordingSink()
  evaluate.evaluate(env, policies.make('random'), 1, sinks=[sink])
  env.close()
  writers = [
      (record.register, record.writer)
      for record in sink.steps[0].records
      if isinstance(record, registers.Write)
  ]
  assert writers == [
      ('query', registers.AGENT),
      ('approval', 'providers[0]:value_advice'),
  ]
