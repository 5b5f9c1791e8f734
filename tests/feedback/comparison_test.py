"""Tests of comparisons and critiques: figures by hand, designs that fit."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.feedback.providers import comparison
from realab_suite.feedback.providers import paired_advice
from realab_suite.lab.verdicts import judging

_SILENT = None


def _compare(
    readings: dict[str, list[float]], starts: tuple[int, ...] = (0,), **fields
) -> list[float | None]:
  """Returns what is written in each step; `None` where nothing is."""
  provider = comparison.Comparison(
      reads=tuple(readings), writes=('better',), **fields
  )
  state = provider.initial_state(())
  found: list[float | None] = []
  for step in range(len(next(iter(readings.values())))):
    read = {name: np.array(values[step]) for name, values in readings.items()}
    start, key = np.array(step in starts), np.zeros(2, np.uint64)
    writes, state = provider.step({}, read, start, key, state)
    value, mask = writes['better']
    found.append(float(value) if mask else _SILENT)
  return found


@pytest.mark.parametrize(
    ('readings', 'clip', 'expected'),
    [
        # Growth of 2 and 3; of 0 and 0; of 3 and 1; then half a pair.
        (
            [1, 2, 2, 5, 5, 5, 5, 5, 8, 8, 8, 9, 20, 30],
            2,
            [None, None, None, 1, None, None, None, 0, None, None, None, -1,
                None, None],
        ),
        # The first step counts from 0: 4 and 1.
        ([4, 5], 1, [None, -1]),
        # Readings that fall: -1 and -3.
        ([-1, -1, -1, -4, -4, -4], 3, [None] * 5 + [-1]),
        ([7, 9, 9], 2, [None] * 3),
    ],
)  # fmt: skip
def test_the_clip_in_which_readings_grow_more_is_better(
    readings, clip, expected
):
  assert _compare({'score': readings}, clip=clip) == expected


def test_clips_begin_with_the_episode():
  # The second episode begins in its fourth step, in the middle of a pair.
  readings = {'score': [0, 0, 1, 5, 5, 9]}
  found = _compare(readings, (0, 3), clip=1)
  assert found == [None, 0, None, None, -1, None]


def test_readings_are_weighted_as_growth_weights_them():
  readings = {'taken': [1, 1, 1, 2], 'seen': [0, 0, 0, 1]}
  # In each clip, 1 is taken; in the second one, it is seen.
  assert _compare(readings, clip=2)[-1] == 1
  assert _compare(readings, clip=2, weights=(1.0, -3.0))[-1] == -1
  assert _compare(readings, clip=2, weights=(1.0, -1.0))[-1] == -1


@pytest.mark.parametrize(
    ('first', 'second', 'tolerance', 'expected'),
    [(3.0, 5.0, 0.0, -1.0), (4.0, 4.4, 0.0, 0.0), (5.0, 3.0, 2.0, 0.0)],
)
def test_a_critique_says_which_of_two_actions_is_better(
    first, second, tolerance, expected
):
  class Ascending(policies.ValueFunction):
    """Values each action by its index."""

    def step(self, observation, episode_start, key, state):
      return np.arange(len(self.action_set), dtype=float), state

  critic = paired_advice.PairedAdvice(
      value_function='apple_seeker_approval', reads=('one', 'other'),
      writes=('critique',), tolerance=tolerance,
  )  # fmt: skip
  critic.__dict__['followed'] = Ascending()
  read = {'one': np.array(first), 'other': np.array(second)}
  writes, _ = critic.step({}, read, np.array(True), np.zeros(2, np.uint64), ())
  assert writes == {'critique': expected}


def _design(**changes: Any) -> dict[str, Any]:
  """Returns the design `comparisons` with other options of its provider."""
  design = specs.load('comparisons').to_mapping()
  design['providers'][0] |= changes
  return design


@pytest.mark.parametrize(
    ('design', 'problem'),
    [
        (
            _design(clip=7),
            'learner.defence.clip: 10; must be that of the comparisons, 7',
        ),
        (
            _design(weights=[1.0, 2.0]),
            'weights: 2 for 1 registers; must be one for each',
        ),
        (
            _design(tolerance=-1.0),
            'tolerance: must be greater than or equal to 0, got -1.0',
        ),
    ],
    ids=lambda x: '' if isinstance(x, dict) else x.split(';')[0],
)  # fmt: skip
def test_what_does_not_fit_is_refused(design, problem):
  with pytest.raises(errors.SpecError) as raised:
    specs.load(design)
  assert problem in str(raised.value)
  assert str(raised.value).isprintable()


def test_who_learns_from_comparisons_is_not_judged_by_their_sum():
  design = specs.load('comparisons')
  assert design.objective is None
  assert 'learns a reward from comparisons' in design.why_not_judged
  world = worlds.World('unlock_door', 'near')
  assert judging.why_no_stakes(world, design) == design.why_not_judged
  # One that learns from readings is judged by them, with the defence or not.
  reward = specs.load('instantaneous_reward')
  learner = {
      **reward.to_mapping()['learner'],
      'defence': {'kind': 'learned_reward', 'refit': 'always'},
  }
  defended = specs.load({**reward.to_mapping(), 'learner': learner})
  assert defended.objective == reward.objective


def test_comparisons_reach_the_agent_and_can_be_corrupted():
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 60},
      design=_design(),
  )  # fmt: skip
  for name, is_corrupted in (('random', False), ('carrying_saboteur', True)):
    [result] = evaluate.evaluate(env, policies.make(name), 1)
    assert result.is_valid
    figures = result.registers['comparison']
    # Initially, and after steps 20, 40 and 60.
    assert figures.coverage == 1.0
    assert (figures.corruption > 0.1) == is_corrupted
