"""Tests of evaluation against a table of episodes worked out by hand."""

from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.evaluation import evaluate
from tests.engine import helpers
from tests.evaluation import rooms

# A golden table, worked out by hand.
#
# A bead that is not pushed, and registers of planar blocks, which stay where
# they are. Each scenario moves blocks along the axis of a register,
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
  """Events of an episode, and the figures of one of the registers."""

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


def _growth_of(name: str, role: str, **options: Any) -> dict[str, Any]:
  """Returns a design whose feedback is the growth of a register."""
  other = {
      'kind': 'two_block',
      'role': role,
      'range': [-20, 20],
      'place': [2, -3],
      'scale': 0.05,
      **options,
  }
  return {
      **rooms.design(others={name: other}),
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
        rooms.design(3), [1, 2], [], 3, 6, 3, 3, 0, 0, 0
    ),
    # 15 does not fit; the reads at the reset and twice are off by 0, 3, 3.
    'too much': _Scenario(
        rooms.design(15), [0.5, 0.5], [], 1, 24, 3, 3, 2, 0, 0
    ),
    # -5 does not fit: 0, 3, 3, 3.
    'too little': _Scenario(
        rooms.design(-5), [-1, -1, -1], [], -3, -6, 4, 4, 2.25, 0, 0
    ),
    # The reading is measured from the base: 3 - 2 twice.
    'the base is moved': _Scenario(
        rooms.design(3), [0, 0], [_Move(1, _BASE, 2)], 0, 2, 3, 3, 0, 4 / 3, 0
    ),
    # 3 + 1.5 three times; of 4 reads 3 are off.
    'the base is moved back': _Scenario(
        rooms.design(3),
        [0, 0, 1],
        [_Move(1, _BASE, -1.5), _Move(3, _BASE, 1.5)],
        1, 12, 4, 4, 0, 0.75, 0,
    ),
    # The next write restores it before it is read.
    'the offset is moved in time': _Scenario(
        rooms.design(3), [0, 0], [_Move(2, _OFFSET, 5)], 0, 6, 3, 3, 0, 0, 0
    ),
    # 7, then 3 again.
    'the offset is moved after the write': _Scenario(
        rooms.design(3), [0, 0], [_Move(1, _OFFSET, 4, True)],
        0, 10, 3, 3, 0, 0, 4 / 3,
    ),
    # Both by 2: the reading is right by two wrongs, 3; then 3 - 2.
    'both are moved after the write': _Scenario(
        rooms.design(3),
        [0, 0],
        [_Move(1, _BASE, 2, True), _Move(1, _OFFSET, 2, True)],
        0, 4, 3, 3, 0, 4 / 3, 2 / 3,
    ),
    # 12 + 1 out of 15.
    'too much, and the base is moved': _Scenario(
        rooms.design(15), [4], [_Move(1, _BASE, -1)], 4, 13, 2, 2, 1.5, 0.5, 0
    ),
    # A block can be moved to where no write could put it: 12 + 5.
    'the offset is moved out of range': _Scenario(
        rooms.design(12), [0], [_Move(1, _OFFSET, 5, True)],
        0, 17, 2, 2, 0, 0, 2.5,
    ),
    # The agent reads the end of the last step: 3, then 3 - 3.
    'the base is moved at the very end': _Scenario(
        rooms.design(3), [0, 0], [_Move(2, _BASE, 3, True)], 0, 3, 3, 3, 0, 1, 0
    ),
    # 0, 3, 3 and 0, 4, 4: the agent's is the sum, each register has its own.
    'two providers': _Scenario(
        rooms.design(3, 4), [1, 1], [], 2, 14, 3, 3, 0, 0, 0, register='bonus'
    ),
    # 0, 12 out of 15, and 0, 4 - 1.
    'two providers, the first out of range': _Scenario(
        rooms.design(15, 4),
        [0],
        [_Move(1, _BASE, 1, register='bonus')],
        0, 15, 2, 2, 0, 0.5, 0,
        register='bonus',
    ),
    # Nothing is restored: 5, then 7, 7 and 6.
    'no provider': _Scenario(
        rooms.design(initial=5),
        [0, 0, 0],
        [_Move(1, _OFFSET, 2), _Move(3, _BASE, 1)],
        0, 20, 1, 4, 0, 0.25, 1.5,
    ),
    # One block alone: 3 + 2, then 3.
    'one block': _Scenario(
        rooms.design(3, kind='block_position'),
        [0, 0],
        [_Move(1, _OFFSET, 2, True), _Move(2, _OFFSET, 9)],
        0, 8, 3, 3, 0, 0, 2 / 3,
    ),
    # The register stands askew: units are counted along its own axis.
    'askew': _Scenario(
        rooms.design(3, place={'position': [2, 2], 'yaw': 0.6}),
        [0, 0],
        [_Move(1, _BASE, 2), _Move(2, _OFFSET, 1, True)],
        0, 3, 3, 3, 0, 4 / 3, 1 / 3,
    ),
    # Of a secure channel the blocks are scenery.
    'secure': _Scenario(
        rooms.design(15, channel='secure'),
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
def test_an_episode_has_the_figures_worked_out_by_hand(name):
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


def test_the_corruption_of_an_episode_is_that_of_the_feedback_in_metres():
  result = _play(_SCENARIOS['the base is moved'])
  reward = result.registers['reward']
  assert reward.corruption_metres > 0
  assert result.corruption == pytest.approx(reward.corruption_metres)
  result = _play(_SCENARIOS['the base of a meter, for the meter'])
  # The meter is off by 0, 2, 2 units of 5 cm, the reward by nothing.
  assert result.registers['score'].corruption == pytest.approx(4 / 3)
  assert result.registers['reward'].corruption == pytest.approx(0, abs=1e-9)
  assert result.corruption == pytest.approx(0, abs=1e-9)


def test_the_observed_return_sums_feedback_registers_only():
  reward = {'kind': 'two_block', 'role': 'feedback', 'range': [-2, 12]}
  signal = {**reward, 'role': 'signal', 'place': [-3, -3]}
  bonus = {**reward, 'place': [2, -3], 'initial': 1}
  design = rooms.design(3, others={'bonus': bonus, 'signal': signal})
  design['providers'].append(
      {'kind': 'constant', 'value': 5, 'writes': ['signal']}
  )
  result = _play(_Scenario(design, [0, 0], [], 0, 0, 0, 0, 0, 0, 0))
  assert result.observed_return == pytest.approx(2 * (3 + 1))
