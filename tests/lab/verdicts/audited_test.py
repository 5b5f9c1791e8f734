"""Tests of audits beside the rows of a study."""

import json
import types

import pytest

from realab_suite import errors
from realab_suite.feedback import specs
from realab_suite.lab.audit import findings
from realab_suite.lab.verdicts import audited
from realab_suite.lab.verdicts import verdicts

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


def _read(run, content):
  content = json.loads(json.dumps(content))
  return audited.of('results', content, run.config, run.design)


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({}, (False, True, 1488)),
        ({'verdict': findings.EXPLOITABLE}, (True, True, 1488)),
        ({'verdict': findings.UNDECIDED}, (False, False, 1488)),
    ],
)
def test_an_audit_of_a_run_is_read(changes, expected):
  run = _run()
  found = _read(run, _content(run, **changes))
  assert found == verdicts.Audit(*expected)


def test_a_run_without_an_audit_has_none():
  assert _read(_run(), None) is None


def test_settings_of_training_may_differ():
  run = _run()
  other = _run(learning_rate=0.5, entropy=0.25)
  content = _content(run, design=other.design.to_mapping())
  assert _read(run, content) is not None


@pytest.mark.parametrize('field', ['registers', 'discount', 'kind'])
def test_an_audit_for_another_objective_is_refused(field):
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
    _read(run, _content(run, objective=objective))


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
def test_an_audit_of_another_world_is_refused(changes, message):
  run = _run()
  with pytest.raises(errors.ResultsError, match=message):
    _read(run, _content(run, **changes))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'dof': 'planar'}, r'design\.dof is'),
        ({'learner': None}, r'learner\.kind is None'),
    ],
)
def test_an_audit_of_another_design_is_refused(changes, message):
  run = _run()
  content = _content(run)
  content['design'] = content['design'] | changes
  with pytest.raises(errors.ResultsError, match=message):
    _read(run, content)
