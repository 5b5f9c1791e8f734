"""Tests of a person as feedback provider."""

import json

import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.doors.browser import person
from realab_suite.doors.browser import supervised_designs
from realab_suite.evaluation import evaluate


def _evaluate(policy, design, max_steps=60, **kwargs):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': max_steps},
      design=design,
  )  # fmt: skip
  [result] = evaluate.evaluate(env, policies.make(policy), 1, **kwargs)
  return result


def test_recorded_answers_repeat_an_episode(tmp_path):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 30},
      design=supervised_designs.design('approval'),
  )  # fmt: skip
  asked, log = [], []

  def ask(question):
    asked.append(question.asks)
    if question.asks == 'stop' or len(asked) % 3:
      return None
    one = {'asks': question.asks, 'value': 1.0, 'key': question.key.tolist()}
    log.append(json.dumps(one))
    return 1.0

  for provider in env.mechanism.design.providers:
    provider.source.connect(ask)
  [live] = evaluate.evaluate(env, policies.make('random'), 1)
  file = tmp_path / 'answers.jsonl'
  file.write_text('\n'.join(log))
  design = supervised_designs.design('approval')
  for provider in design['providers']:
    provider['recorded'] = str(file)
  again = _evaluate('random', design, 30)
  assert len(log) == 10
  assert again.observed_return == live.observed_return
  assert again.registers == live.registers


_GIVEN = {'asks': 'approval', 'value': 1.0, 'key': [1, 2]}


@pytest.mark.parametrize(
    'content',
    [
        b'{"asks": "approval"}',
        b'{"asks": "approval", "val',
        b'[1, 2, 3]',
        b'\xff\xfe',
        b'[' * 100_000,
        *(
            json.dumps({**_GIVEN, **change}).encode()
            for change in (
                {'value': 100},
                {'value': 0.5},
                {'value': float('nan')},
                {'value': None},
                {'value': 10**400},
                {'asks': 'correction', 'value': 9},
                {'asks': 'correction', 'value': -1},
                {'asks': 'stop', 'value': 0},
                {'asks': 'comparison', 'value': 0},
                {'asks': 'else'},
                {'asks': []},
                {'key': [float('inf'), 1]},
                {'key': 7},
            )
        ),
        b'\n'.join([json.dumps(_GIVEN).encode()] * 2),
    ],
)
def test_what_no_person_can_answer_is_refused(tmp_path, content):
  file = tmp_path / 'answers.jsonl'
  file.write_bytes(content)
  with pytest.raises(errors.SpecError, match='must be a file of ans') as caught:
    person.Recorded(str(file), 9)
  assert '\n' not in str(caught.value)
  file.unlink()
  file.mkdir()
  with pytest.raises(errors.SpecError, match='must be a file of answers'):
    person.Recorded(str(file), 9)


def test_a_live_source_without_a_person_is_refused():
  design = supervised_designs.design('approval')
  with pytest.raises(errors.FeedbackProviderError, match='no person'):
    _evaluate('random', design)
