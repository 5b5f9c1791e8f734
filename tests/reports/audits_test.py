"""Tests of audits beside the results of a sweep."""

import json
import types

import pytest

from realab_suite import errors
from realab_suite.feedback import specs
from realab_suite.lab.audit import findings
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import audits

_WORLD = {
    'domain': 'unlock_door', 'task': 'near', 'max_steps': 250,
    'task_kwargs': {}, 'senses': None,
}  # fmt: skip


def _run(design='instantaneous_reward', **learner):
  """Returns a stand-in for a run of a sweep."""
  spec = specs.load(design).to_mapping()
  spec['learner'] |= learner
  return types.SimpleNamespace(
      name='reward',
      design=specs.load(spec),
      config={
          'task': 'unlock_door.near', 'max_steps': 250, 'task_kwargs': {},
          'environment_kwargs': {'senses': None},
      },
  )  # fmt: skip


def _content(run, **changes):
  """Returns the contents of an audit.json, as the program writes it."""
  design = run.design
  content = {
      'verdict': findings.RESISTED,
      'is_sufficient': True,
      'num_searched': 1488,
      'world': _WORLD,
      'design': design.to_mapping(),
      'target': None,
      'objective': design.objective.model_dump(mode='json'),
      'query_policy': 'taken_action',
  }
  return {**content, **changes}


def _read(folder, run, content):
  sweep = types.SimpleNamespace(
      folder=folder, audits={run.name: json.loads(json.dumps(content))}
  )
  return audits.of_run(sweep, run)


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({}, (False, True, 1488)),
        ({'verdict': findings.EXPLOITABLE}, (True, True, 1488)),
        ({'verdict': findings.UNDECIDED}, (False, False, 1488)),
    ],
)
def test_an_audit_of_a_run_is_read(changes, expected, tmp_path):
  run = _run()
  found = _read(tmp_path, run, _content(run, **changes))
  assert found == verdicts.Audit(*expected)


def test_a_run_without_an_audit_has_none(tmp_path):
  sweep = types.SimpleNamespace(folder=tmp_path, audits={})
  assert audits.of_run(sweep, _run()) is None


def test_settings_of_training_may_differ(tmp_path):
  run = _run()
  audited = _run(learning_rate=0.5, entropy=0.25)
  content = _content(run, design=audited.design.to_mapping())
  assert _read(tmp_path, run, content) is not None


@pytest.mark.parametrize('field', ['registers', 'discount', 'kind'])
def test_an_audit_for_another_objective_is_refused(field, tmp_path):
  run = _run()
  objective = (
      _content(run)['objective']
      | {
          'registers': {'registers': {'reward': -1.0}},
          'discount': {'discount': 0.5},
          'kind': {'kind': 'mean', 'discount': None},
      }[field]
  )
  with pytest.raises(errors.ResultsError, match='the objective is'):
    _read(tmp_path, run, _content(run, objective=objective))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'world': {'domain': 'collect_apples', 'task': 'near'}}, 'task is'),
        ({'world': _WORLD | {'max_steps': 3}}, 'max_steps is 3, and 250 in'),
        ({'target': 'score'}, "target is 'score'"),
        ({'query_policy': 'independent_action'}, 'the query policy is'),
        ({'verdict': 'PERHAPS'}, "verdict: 'PERHAPS'; Input should be 'EXPL"),
        ({'world': None}, 'world: None'),
    ],
)
def test_an_audit_of_another_world_is_refused(changes, message, tmp_path):
  run = _run()
  with pytest.raises(errors.ResultsError, match=message):
    _read(tmp_path, run, _content(run, **changes))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'dof': 'planar'}, r'design\.dof is'),
        ({'learner': None}, r'learner\.kind is None'),
    ],
)
def test_an_audit_of_another_design_is_refused(changes, message, tmp_path):
  run = _run()
  content = _content(run)
  content['design'] = content['design'] | changes
  with pytest.raises(errors.ResultsError, match=message):
    _read(tmp_path, run, content)
