"""Tests for overrides: a problem is reported where a user can fix it."""

import json
import pathlib
from typing import Any

import hypothesis
from hypothesis import strategies as st
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.experiments import experiment_specs
from realab_suite.feedback import specs

_DESIGN = {
    'schema': 1,
    'name': 'd',
    'action_set': {'name': 'dmlab_like', 'version': 1},
    'registers': {
        'reward': {
            'kind': 'two_block',
            'role': 'feedback',
            'place': 'station_1',
            'range': [-2, 12],
        },
        'query': {
            'kind': 'two_block',
            'role': 'query',
            'place': 'station_2',
            'range': [0, 13],
        },
    },
    'providers': [
        {
            'kind': 'value_advice',
            'value_function': 'apple_seeker_approval',
            'reads': ['query'],
            'writes': ['reward'],
        }
    ],
}
# Overrides that are wrong whatever the others are, and what they bring about.
_WRONG = {
    'channel=loose': "channel: must be 'embedded', 'welded' or 'secure'",
    'registers.reward.scale=-1': (
        'registers.reward.scale: must be greater than or equal to 0.000001,'
        ' got -1'
    ),
    # Not in the file.
    'registers.reward.mass=-1': 'registers.reward.mass: must be greater than',
    'registers.query.mass=0': 'registers.query.mass: must be greater than',
    'registers.reward.options.speed=1': (
        "registers.reward.options: unknown key 'speed' (allowed: none)"
    ),
    'metres=[]': "unknown key 'metres'; did you mean 'meters'?",
    'learner.reward=reward': 'learner.kind: required key is missing',
    'schedule.meter_substep=3': (
        'schedule.provider_substep: required key is missing'
    ),
    'name=[]': 'name: must be a valid string, got []',
    'providers.0.query_delay=2': 'providers[0].query_delay: must be 0 or 1',
    'providers.0.options.options.speed=1': (
        "providers[0].options.options: unknown key 'speed'"
    ),
    'providers.0.value_function=oracle': (
        "providers[0].value_function: value function 'oracle' is unknown"
    ),
}
_APART = [override for override in _WRONG if 'oracle' not in override]
_RIGHT = (
    'dof=planar',
    'description=x',
    'registers.reward.block_size=0.3',
    'registers.extra={kind: two_block, role: meter, place: centre, range: [0,'
    ' 1]}',
)  # fmt: skip
# Overrides that are wrong where they meet the rest of the design.
_CROSS = {
    'registers.reward.range=[5, 6]': (
        'registers.reward: initial 0.0 must be in range [5.0, 6.0]'
    ),
    'registers.reward.initial=99': (
        'registers.reward: initial 99.0 must be in range [-2.0, 12.0]'
    ),
    'registers.query.role=meter': (
        "providers[0]: value_advice reads the query from 'query', whose role is"
        " 'meter'"
    ),
    'registers.query.range=[0, 5]': (
        'registers.query.range: [0.0, 5.0] excludes actions of dmlab_like v1'
    ),
    'registers.reward.role=meter': (
        "providers[0].writes: register 'reward' has role 'meter'"
    ),
    'registers={}': "providers[0].reads: register 'query' is not declared",
    'action_set=null': 'providers[0]: value_advice speaks of action set',
    'providers.0.reads=[scoer]': (
        "providers[0].reads: register 'scoer' is not declared"
    ),
    'meters=[{measures: score, writes: query}]': (
        "meters[0].writes: register 'query' has role 'query'"
    ),
    'learner={kind: value_advice, advice: extra}': (
        "learner.advice: an agent may not read meter register 'extra'"
    ),
}


def _refusal(design: Any, *overrides: str) -> str:
  with pytest.raises(errors.SpecError) as caught:
    specs.load(design, overrides)
  text = str(caught.value)
  assert text.isprintable()
  return text


def _changed(**changes: Any) -> dict[str, Any]:
  return {**json.loads(json.dumps(_DESIGN)), **changes}


@pytest.mark.parametrize(('override', 'problem'), _WRONG.items(), ids=_WRONG)
def test_a_problem_that_an_override_brings_is_the_overrides(
    override: str, problem: str, tmp_path: pathlib.Path
):
  path = tmp_path / 'mine.yaml'
  path.write_text(json.dumps(_DESIGN))
  # A spec has null where a file has nothing, and null has no keys.
  absent = override.partition('.')[0] in ('learner', 'schedule')
  for design in (_DESIGN, path, _DESIGN if absent else specs.load(_DESIGN)):
    for others in ((), _RIGHT):
      for position in range(len(others) + 1):
        overrides = [*others[:position], override, *others[position:]]
        text = _refusal(design, *overrides)
        assert text.startswith(f'override {override!r}: {problem}')
        assert 'mine.yaml' not in text
        assert text.count('override ') == 1


@pytest.mark.parametrize(('override', 'problem'), _CROSS.items(), ids=_CROSS)
def test_a_rule_that_an_override_breaks_elsewhere_is_broken_by_it(
    override: str, problem: str
):
  extra = _RIGHT[-1]
  for overrides in (
      (extra, override),
      (extra, 'dof=planar', override, 'name=e'),
  ):
    text = _refusal(_DESIGN, *overrides)
    assert text.startswith(f'override {override!r}: {problem}')
    assert text.count('override ') == 1


def test_a_list_of_what_is_allowed_may_change_later():
  # The second one only lengthens the list of registers that are declared.
  text = _refusal(_DESIGN, 'providers.0.reads=[scoer]', _RIGHT[-1])
  assert text.startswith("override 'providers.0.reads=[scoer]': ")
  assert text.endswith("declared are ['extra', 'query', 'reward']")


def test_problems_of_the_file_stay_the_files(tmp_path: pathlib.Path):
  path = tmp_path / 'mine.yaml'
  wrong = _changed()
  wrong['registers']['reward'] |= {'mass': -5, 'range': [3, -3]}
  path.write_text(json.dumps(wrong))
  text = _refusal(path, *_RIGHT, 'registers.reward.scale=0.2')
  assert text.startswith(f'{path}: registers.reward.mass: must be greater')
  assert 'override' not in text
  wrong['registers']['reward'].pop('mass')
  path.write_text(json.dumps(wrong))
  # A rule between keys, where an override changes another key.
  text = _refusal(path, 'registers.reward.scale=0.2')
  assert text == (
      f'{path}: registers.reward: range [3.0, -3.0] must have low < high'
  )


def test_where_both_are_wrong_both_are_named_the_file_first():
  wrong = _changed(dof='fixed')
  text = _refusal(wrong, 'channel=loose', 'name=e', 'registers.reward.mass=-1')
  assert text == (
      "design: dof: must be 'free' or 'planar', got 'fixed';"
      " override 'channel=loose': channel: must be 'embedded', 'welded' or"
      " 'secure', got 'loose'; override 'registers.reward.mass=-1':"
      ' registers.reward.mass: must be greater than or equal to 0.01, got -1'
  )


def test_an_override_of_a_wrong_value_answers_for_its_own():
  wrong = _changed(dof='fixed')
  text = _refusal(wrong, 'dof=loose')
  assert text == (
      "override 'dof=loose': dof: must be 'free' or 'planar', got 'loose'"
  )
  assert specs.load(wrong, ('dof=planar',)).dof == 'planar'
  text = _refusal(wrong, 'dof=planar', 'dof=fixed', 'dof=planar', 'dof=loose')
  assert text.startswith("override 'dof=loose': ")


def test_overrides_that_are_wrong_together():
  # Each is right without the other one; the later one is named.
  first, second = 'registers.reward.range=[0, 1]', 'registers.reward.initial=9'
  assert specs.load(_DESIGN, (first,)).registers['reward'].range == (0.0, 1.0)
  assert specs.load(_DESIGN, (second,)).registers['reward'].initial == 9.0
  problem = 'registers.reward: initial 9.0 must be in range [0.0, 1.0]'
  assert _refusal(_DESIGN, first, second) == f'override {second!r}: {problem}'
  assert _refusal(_DESIGN, second, first) == f'override {first!r}: {problem}'


def test_the_same_override_twice_is_named_once():
  text = _refusal(_DESIGN, 'dof=fixed', 'name=e', 'dof=fixed')
  assert text.count("override 'dof=fixed'") == 1


def test_many_problems_are_cut_and_stay_where_they_belong():
  registers = {
      f'r{i}': {**_DESIGN['registers']['reward'], 'mass': -1, 'place': [0, i]}
      for i in range(9)
  }
  overrides = [f'registers.r{i}.dof=fixed' for i in range(9)]
  text = _refusal(_changed(registers=registers), *overrides)
  assert text.startswith('design: registers.r0.mass: ')
  assert text.endswith('; and 8 more')
  assert "; override 'registers.r0.dof=fixed': registers.r0.dof: must" in text


def test_a_long_override_is_cut():
  long = 'k' * 100_000
  for override in (
      f'registers.reward.kind={long}',
      f'{long}=1',
      f'registers.{long}=1',
      f'learner.{long}=1',
      f'providers.0.reads=[{long}]',
      f'providers.0.value_function={long}',
      f'providers.0.options.policy={long}',
      f'providers.0.options.{long}=1',
      f'learner={{kind: x, {long}: score}}',
  ):
    overrides = [override]
    if 'score' in override:
      score = {**_DESIGN['registers']['query'], 'role': 'meter'}
      overrides.append(f'registers.score={json.dumps(score)}')
    text = _refusal(_DESIGN, *overrides)
    assert f'override {override!r:.60}'.rstrip("'") in text
    assert len(text) < 600


@pytest.mark.parametrize(
    'overrides', ['dof=free', None, 3, {}, {'a': 1}, (None,), (3,), (b'a=1',)]
)
def test_what_is_no_list_of_overrides_is_refused(overrides: Any):
  with pytest.raises(errors.SpecError) as caught:
    specs.load(_DESIGN, overrides)
  assert 'override' in str(caught.value)


def test_worlds_and_experiments_name_the_override(tmp_path: pathlib.Path):
  with pytest.raises(errors.SpecError) as caught:
    suite.load(
        'unlock_door', 'near', design='value_advice', overrides=['dof=fixed']
    )
  assert str(caught.value).startswith("override 'dof=fixed': dof: must be")
  path = tmp_path / 'mine.yaml'
  run = {'design': 'value_advice', 'overrides': ['dof=planar', 'channel=loose']}
  path.write_text(
      json.dumps(
          {
              'schema': 1,
              'name': 'e',
              'task': 'unlock_door.near',
              'runs': {'one': run},
              'seeds': [0],
          }
      )
  )
  with pytest.raises(errors.SpecError) as caught:
    experiment_specs.load(path)
  assert str(caught.value).startswith(
      f"{path}: runs.one: override 'channel=loose': channel: must be"
  )


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    # Without the one that keeps options from being checked.
    wrong=st.lists(
        st.sampled_from(_APART), min_size=1, max_size=9, unique=True
    ),
    right=st.lists(st.sampled_from(_RIGHT), max_size=3),
    order=st.randoms(use_true_random=False),
)
def test_each_of_several_overrides_answers_for_its_own_problem(
    wrong: list[str], right: list[str], order: Any
):
  overrides = [*wrong, *right]
  order.shuffle(overrides)
  parts = _refusal(_DESIGN, *overrides).split('; override ')
  parts[0] = parts[0].removeprefix('override ')
  named = [override for override in overrides if override in wrong]
  for part, override in zip(parts, named, strict=True):
    assert part.startswith(f'{override!r}: {_WRONG[override]}')
