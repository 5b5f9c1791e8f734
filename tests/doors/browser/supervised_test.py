"""Tests of episodes with a person at a page, with a page that is scripted."""

import json
import types

import pytest

pytest.importorskip('websockets')
pytest.importorskip('PIL')

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.doors.browser import supervised
from realab_suite.doors.browser import supervised_designs
from realab_suite.doors.browser import views
from realab_suite.evaluation import results
from realab_suite.lab.verdicts import stakes


class FakePage:
  """Server of a page whose person reacts to what the page shows."""

  is_connected = True

  def __init__(self, react=lambda page, content: None):
    self._react = react
    self._messages = []
    self.sent = []
    self.clip_views = []  # Views of the pictures of clips.
    self.put({'type': 'run'})

  def put(self, content):
    self._messages.append(content)

  def answer(self, asks, value):
    self.put({'type': 'answer', 'asks': asks, 'value': value})

  def steps(self):
    return [one['step'] for one in self.sent if one['type'] == 'step']

  def asked(self):
    return [one['asks'] for one in self.sent if one['type'] == 'question']

  def receive(self, timeout):
    del timeout
    return self._messages.pop(0) if self._messages else None

  def send(self, content):
    self.sent.append(content)
    self._react(self, content)

  def send_picture(self, view, jpeg):
    del jpeg
    if view:
      self.clip_views.append(view)


@pytest.fixture(autouse=True)
def fixture_no_renderer(monkeypatch):
  view = types.SimpleNamespace(draw=lambda: b'', close=lambda: None)
  monkeypatch.setattr(views, 'View', lambda env: view)


def _supervise(page, folder, design, max_steps=30, num_episodes=1):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': max_steps},
      design=design,
  )  # fmt: skip
  one = supervised.Supervision(env, page, folder, 1e6)
  policy = policies.make('random')
  results = [one.run(policy, episode) for episode in range(num_episodes)]
  lines = (folder / supervised.ANSWERS).read_text().splitlines()
  return results, [json.loads(line) for line in lines]


def test_an_answer_without_waiting_is_written_in_the_next_step(tmp_path):
  def react(page, content):
    if content['type'] == 'step' and content['step'] == 14:
      page.answer('comparison', 1)

  page = FakePage(react)
  design = supervised_designs.design('comparison', clip=5)
  _, answers = _supervise(page, tmp_path, design)
  assert page.asked() == ['comparison'] * 3
  assert [one['step'] for one in answers] == [15]


@pytest.mark.parametrize('value', [2, '1', None])
def test_a_value_that_is_no_answer_is_dropped(tmp_path, value):
  def react(page, content):
    if content['type'] == 'step' and content['step'] == 2:
      page.answer('approval', value)

  page = FakePage(react)
  design = supervised_designs.design('approval')
  _, answers = _supervise(page, tmp_path, design, 4)
  assert page.steps() == [0, 1, 2, 3, 4]
  assert page.receive(0) is None
  assert not [one for one in answers if one['asks'] == 'approval']


def test_a_stop_after_the_last_step_does_not_end_the_next_episode(tmp_path):
  def react(page, content):
    if content['type'] == 'step' and content['step'] == 5:
      page.answer('stop', 1)

  design = supervised_designs.design('approval')
  results, answers = _supervise(FakePage(react), tmp_path, design, 5, 2)
  assert [one.num_steps for one in results] == [5, 5]
  assert answers == []


def test_a_page_that_is_opened_again_gets_the_open_question(tmp_path):
  def react(page, content):
    if content['type'] == 'question':
      if len(page.asked()) == 1:
        page.put({'type': 'hello'})
      else:
        page.answer('correction', 3)
        page.put({'type': 'run'})

  page = FakePage(react)
  design = supervised_designs.design('correction', waits=True)
  _, answers = _supervise(page, tmp_path, design, 1)
  assert page.asked() == ['correction'] * 2
  assert page.steps() == [0, 0, 1]
  assert [one['value'] for one in answers] == [3.0]


def _run(supervision, num_episodes):
  """Runs supervised episodes, and returns what the program says."""
  said = []
  world = worlds.World('unlock_door', 'near')
  policy = policies.make('no_op')
  supervision.supervise(world, 'no_op', policy, num_episodes, said.append)
  [text] = said
  return text


def test_supervised_episodes_have_figures_and_no_judgement(tmp_path):
  def react(page, content):
    if content['type'] == 'step' and content['step'] == 2:
      page.answer('approval', 1)

  page = FakePage(react)
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 4},
      design=supervised_designs.design('approval'),
  )  # fmt: skip
  one = supervised.Supervision(env, page, tmp_path, 1e6)
  text = _run(one, 2)
  assert page.sent[-1] == {
      'type': 'summary',
      'rows': [[1, 4, '0.00', '2.00'], [2, 4, '0.00', '2.00']],
      'answers': 2,
      'folder': str(tmp_path),
  }
  [task] = {one['task'] for one in page.sent if one['type'] == 'step'}
  assert task.startswith('gather the small apples in the large room (reward 1')
  assert task.endswith('which ends the episode.')
  assert text.count('Not judged: the design has no learner.') == 1
  assert '| supervised |' in text
  rows = list(results.read_rows(tmp_path / 'episodes.jsonl'))
  assert [(row.num_steps, stakes.of(row)) for row in rows] == [(4, None)] * 2
  # A person cannot be asked twice, so what was written counts as clean.
  assert {row.registers['feedback'].inherited for row in rows} == {0.0}


def test_a_person_cannot_answer_again_for_a_control(tmp_path):
  design = supervised_designs.design('approval')
  design['learner'] = {
      'kind': 'decoupled_approval', 'approval': 'feedback', 'query': 'query',
  }  # fmt: skip
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 3}, design=design
  )
  one = supervised.Supervision(env, FakePage(), tmp_path, 1e6)
  text = _run(one, 1)
  assert 'Not judged: the person would have to answer again' in text


def test_two_persons_with_the_same_question_are_refused(tmp_path):
  design = supervised_designs.design('approval')
  question, _ = design['providers']
  design['providers'][1] = {**question, 'writes': ['stop']}
  with pytest.raises(errors.SpecError, match='one provider of kind person'):
    _supervise(FakePage(), tmp_path, design)


def test_the_intended_behaviour_of_a_task_is_in_its_module_or_its_class():
  class Own:
    """Gives a true reward near the middle.

    Other paragraphs say more.
    """

  said = supervised._intended_behaviour(Own())
  assert said == 'Gives a true reward near the middle.'
  for names in suite.ALL_TASKS:
    said = supervised._intended_behaviour(suite.load(*names).task)
    assert said.endswith('.')
    assert 'Exploit' not in said
