"""Tests for overrides: an error names the override that causes it."""

import json
import pathlib
from typing import Any

import pytest

from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests.config import refusals
from tests.feedback import designs

_DESIGN = designs.ADVISED
# Overrides that are wrong with any others, and the problem of each.
_WRONG = {
    'channel=loose': "channel: must be 'embedded' or 'secure'",
    'registers.reward.scale=-1':
        'registers.reward.scale: must be greater than or equal to 0.000001,'
        ' got -1',
    # Not in the file.
    'registers.reward.mass=-1': 'registers.reward.mass: must be greater than',
    'metres=[]': "unknown key 'metres'; did you mean 'meters'?",
    'learner.reward=reward': 'learner.kind: required key is missing',
    'schedule.meter_substep=3':
        'schedule.provider_substep: required key is missing',
    'providers.0.options.options.speed=1':
        "providers[0].options.options: unknown key 'speed'",
}  # fmt: skip
_RIGHT = (
    'dof=planar',
    'description=x',
    'registers.reward.block_size=0.3',
    'registers.extra={kind: two_block, role: meter, place: centre, range: [0,'
    ' 1]}',
)  # fmt: skip
# Overrides that contradict the rest of the design.
_CROSS = {
    'registers.reward.range=[5, 6]':
        'registers.reward: initial 0.0 must be in range [5.0, 6.0]',
    'registers.query.role=meter':
        "providers[0]: value_advice reads the query from 'query', whose role is"
        " 'meter'",
    'registers={}': "providers[0].reads: register 'query' is not declared",
    'learner={kind: value_advice, advice: extra}':
        "learner.advice: an agent may not read meter register 'extra'"
}  # fmt: skip


def _refusal(design: Any, *overrides: str) -> str:
  return refusals.refusal(specs.load, design, overrides)


def _changed(**changes: Any) -> dict[str, Any]:
  return {**json.loads(json.dumps(_DESIGN)), **changes}


@pytest.mark.parametrize(('override', 'problem'), _WRONG.items(), ids=_WRONG)
def test_a_problem_of_an_override_is_reported_as_its_own(
    override: str, problem: str, tmp_path: pathlib.Path
):
  path = tmp_path / 'mine.yaml'
  path.write_text(json.dumps(_DESIGN))
  # A spec has null where a file has nothing, and null has no keys.
  absent = override.partition('.')[0] in ('learner', 'schedule')
  for design, overrides in (
      (_DESIGN, (override,)),
      (path, (*_RIGHT, override)),
      (_DESIGN if absent else specs.load(_DESIGN), (override, *_RIGHT)),
  ):
    text = _refusal(design, *overrides)
    assert text.startswith(f'override {override!r}: {problem}')
    assert 'mine.yaml' not in text
    assert text.count('override ') == 1


@pytest.mark.parametrize(('override', 'problem'), _CROSS.items(), ids=_CROSS)
def test_an_override_that_contradicts_the_design_is_reported(
    override: str, problem: str
):
  text = _refusal(_DESIGN, _RIGHT[-1], 'dof=planar', override, 'name=e')
  assert text.startswith(f'override {override!r}: {problem}')
  assert text.count('override ') == 1


def test_a_problem_of_the_file_is_reported_as_the_files(tmp_path: pathlib.Path):
  path = tmp_path / 'mine.yaml'
  wrong = _changed()
  wrong['registers']['reward'] |= {'mass': -5, 'range': [3, -3]}
  path.write_text(json.dumps(wrong))
  text = _refusal(path, *_RIGHT, 'registers.reward.scale=0.2')
  assert text.startswith(f'{path}: registers.reward.mass: must be greater')
  assert 'override' not in text
  wrong['registers']['reward'].pop('mass')
  path.write_text(json.dumps(wrong))
  # A rule between keys; an override changes another key, or is wrong itself.
  for override in ('registers.reward.scale=0.2', 'dof=loose'):
    assert _refusal(path, override) == (
        f'{path}: registers.reward: range [3.0, -3.0] must have low < high'
    )


def test_an_override_replaces_a_wrong_value_of_the_file():
  wrong = _changed(dof='fixed')
  assert specs.load(wrong, ('dof=planar',)).dof == 'planar'
  text = _refusal(wrong, 'dof=planar', 'dof=free', 'dof=loose', 'name=e')
  assert text.startswith("override 'dof=loose': ")


def test_of_two_overrides_that_contradict_each_other_the_later_is_named():
  first, second = 'registers.reward.range=[0, 1]', 'registers.reward.initial=9'
  for override in (first, second):
    specs.load(_DESIGN, (override,))
  problem = 'registers.reward: initial 9.0 must be in range [0.0, 1.0]'
  assert _refusal(_DESIGN, first, second) == f'override {second!r}: {problem}'
  assert _refusal(_DESIGN, second, first) == f'override {first!r}: {problem}'


@pytest.mark.parametrize('override', ['registers.reward.kind={}', '{}=1'])
def test_a_long_override_is_cut_in_the_message(override: str):
  override = override.format('k' * 100_000)
  text = _refusal(_DESIGN, override)
  assert f'override {override!r:.60}'.rstrip("'") in text
  assert len(text) < 600


@pytest.mark.parametrize('overrides', ['dof=free', None, {'a': 1}, (None,)])
def test_overrides_that_are_no_list_of_texts_are_refused(overrides: Any):
  assert 'override' in refusals.refusal(specs.load, _DESIGN, overrides)


def test_worlds_and_experiments_name_the_override(tmp_path: pathlib.Path):
  text = refusals.refusal(
      suite.load,
      'unlock_door',
      'near',
      design='value_advice',
      overrides=['dof=fixed'],
  )
  assert text.startswith("override 'dof=fixed': dof: must be")
  path = tmp_path / 'mine.yaml'
  run = {'design': 'value_advice', 'overrides': ['dof=planar', 'channel=loose']}
  experiment = {
      'schema': 1,
      'name': 'e',
      'task': 'unlock_door.near',
      'runs': {'one': run},
      'seeds': [0],
  }
  path.write_text(json.dumps(experiment))
  text = refusals.refusal(experiment_specs.load, path)
  assert text.startswith(
      f"{path}: runs.one: override 'channel=loose': channel: must be"
  )
