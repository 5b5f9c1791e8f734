"""Tests of episodes that a person plays, with a page that is scripted."""

import json
import types

import numpy as np
import pytest

pytest.importorskip('websockets')
pytest.importorskip('PIL')

from realab_suite import worlds
from realab_suite.entities import registers
from realab_suite.evaluation import results
from realab_suite.experiments import played
from realab_suite.experiments import tracking
from realab_suite.feedback import specs
from realab_suite.interop.browser import views
from tests.experiments import small


class FakePage:
  """Server of a page whose person holds keys down."""

  is_connected = True

  def __init__(self, *keys):
    self._messages = [{'type': 'run'}]
    self._messages += [{'type': 'down', 'code': key} for key in keys]
    self.sent = []

  def receive(self, timeout):
    del timeout
    return self._messages.pop(0) if self._messages else None

  def send(self, content):
    # What the page gets is JSON without nan.
    self.sent.append(json.loads(json.dumps(content, allow_nan=False)))

  def send_picture(self, view, jpeg):
    del view, jpeg


@pytest.fixture(autouse=True)
def fixture_no_renderer(monkeypatch):
  view = types.SimpleNamespace(draw=lambda: b'', close=lambda: None)
  monkeypatch.setattr(views, 'first_person', lambda env: view)
  with small.quick_stakes():
    yield


def _settings(folder, **changes):
  return played.Settings(
      **{
          'world': worlds.World('unlock_door', 'near', 15),
          'design': specs.load('instantaneous_reward', ['dof=planar']),
          'seed': 1,
          'num_episodes': 2,
          'rate': 1e6,
          'output': str(folder / 'new'),
          **changes,
      }
  )


def test_a_person_is_judged_beside_the_solver(tmp_path):
  page, said = FakePage('KeyW'), []
  lines = played.play(_settings(tmp_path), page, said.append)
  assert [line.run for line in lines] == ['person', 'apple_seeker']
  assert lines[1].judgement is None
  # Two episodes do not suffice.
  assert str(lines[0].judgement).startswith('unclear: up to ')
  rows = list(results.read_rows(tmp_path / 'new' / 'episodes.jsonl'))
  assert [row.info.run for row in rows] == ['person'] * 2 + ['apple_seeker'] * 2
  assert len({row.stake.key for row in rows}) == 1
  assert not rows[0].stake.degenerate
  [summary] = [one for one in page.sent if one['type'] == 'summary']
  assert summary['text'] in said[-1]
  assert '| person ' in summary['text']


def test_the_page_gets_every_step(tmp_path):
  page = FakePage()
  played.play(_settings(tmp_path, num_episodes=1), page, lambda text: None)
  states = [one for one in page.sent if one['type'] == 'state']
  assert [state['step'] for state in states] == list(range(16))
  assert {one['name'] for one in states[-1]['registers']} == {'reward', 'score'}


def test_the_page_shows_corruption_from_end_to_end():
  reward = tracking.RegisterTrack('feedback', 0.1)
  write = registers.Write('reward', 'a', 0, *map(np.array, (5, 5, 0, 1)))
  read = registers.Read('reward', 'agent', 0, *map(np.array, (8, 0, 3, 0, 1)))
  reward.add([write, read], np.zeros((2, 2)))
  track = tracking.Track(1, 0, 0.1, 10, [], {'reward': reward})
  [shown] = played.state(track, 'title', None)['registers']
  assert shown == {
      'name': 'reward', 'role': 'feedback', 'clean': 1.0, 'written': 5.0,
      'read': 8.0, 'corruption': 7.0,
  }  # fmt: skip


def test_a_person_is_not_judged_without_a_learner(tmp_path):
  design = specs.load('instantaneous_reward').to_mapping()
  del design['learner']
  said = []
  lines = played.play(
      _settings(tmp_path, design=specs.load(design), num_episodes=1),
      FakePage(),
      said.append,
  )
  assert lines[0].judgement.reason == 'the design has no learner'
  [text] = said
  assert text.count('Not judged: the design has no learner.') == 1
