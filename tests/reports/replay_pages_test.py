"""Tests of the pages that replay episodes in 3D."""

import json
import math
import re
from urllib import parse

import numpy as np
import pytest

pytest.importorskip('mjviser')

from realab_suite import policies
from realab_suite import suite
from realab_suite.audit import aiming
from realab_suite.evaluation import evaluate
from realab_suite.experiments import tracking
from realab_suite.reports import html_page
from realab_suite.reports import replay_pages
from realab_suite.reports import sweep_results
from tests.experiments import fake_sweep


def _play(policy, num_steps, on_step=None):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': num_steps},
      design='instantaneous_reward',
  )  # fmt: skip
  recorder = tracking.Tracker(env, on_step and (lambda *unused: on_step(env)))
  [result] = evaluate.evaluate(env, policies.make(policy), 1, sinks=[recorder])
  return recorder.track, result


def test_a_timeline_contains_the_returns_of_the_episode():
  track, result = _play('carrying_saboteur', 60)
  data = replay_pages.timeline(track, {})
  json.dumps(data, allow_nan=False)
  assert len(data['true_return']) == len(data['observed_return']) == 61
  assert data['true_return'][-1] == pytest.approx(result.true_return)
  assert data['observed_return'][-1] == pytest.approx(
      result.observed_return, rel=1e-5
  )
  reward = data['registers']['reward']
  # A unit of the register is 0.1 m, and the reset is no control step.
  mean = 0.1 * np.sum(np.abs(reward['permanent'])) / 60
  assert mean == pytest.approx(result.registers['reward'].permanent, rel=1e-4)


def test_a_timeline_shows_corruption_that_a_meter_passed_on():
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 60},
      design='instantaneous_reward',
      overrides=['registers.reward.channel=secure'],
  )  # fmt: skip
  saboteur = aiming.make_policy('carrying_saboteur', env, 'score', 0)
  env.rewind()
  recorder = tracking.Tracker(env)
  evaluate.evaluate(env, saboteur, 1, first_episode=0, sinks=[recorder])
  reward = replay_pages.timeline(recorder.track, {})['registers']['reward']
  assert reward['reading'] == reward['applied']
  assert reward['reading'] != reward['clean']


def test_contacts_name_the_block_that_the_hand_holds():
  found = []
  _play(
      'carrying_saboteur',
      60,
      lambda env: found.append(replay_pages.contacts(env)),
  )
  kinds = [one['reward/base'] for one in found]
  assert kinds[0] is None
  assert kinds[-1] == 'held'
  assert {one['score/base'] for one in found} == {None}


def test_a_report_links_to_the_replays_beside_it(tmp_path):
  one = fake_sweep.experiment(seeds=[0])
  folder = fake_sweep.build(tmp_path / 'sweep #1', one)
  pages = folder / sweep_results.REPLAYS
  pages.mkdir()
  (pages / 'reward-seed0-world0-episode0.html').write_text('a replay')
  sweep = sweep_results.load(folder)
  [(name, address)] = html_page._replays(sweep, tmp_path / 'report')
  assert name == 'reward-seed0-world0-episode0'
  path = parse.urlsplit(address).path
  linked = tmp_path / 'report' / parse.unquote(path)
  linked.parent.mkdir(parents=True, exist_ok=True)
  assert linked.resolve() == pages / 'reward-seed0-world0-episode0.html'


def test_a_recording_is_one_page_that_loads_nothing():
  pytest.importorskip('viser')
  pytest.importorskip('mjviser')
  from realab_suite.interop.browser import recordings

  scenes = []

  def add(env):
    if not scenes:
      scenes.append(recordings.Recording(env))
    scenes[0].add()

  track, _ = _play('carrying_saboteur', 20, add)
  data = json.dumps(replay_pages.timeline(track, {}))
  page = recordings.with_timeline(scenes[0].page(), data + '</script>')
  assert page.count('__VISER_EMBED_DATA__ =') == 1
  assert len(page) < 5e6
  ours = page.split('<div id="realab">', 1)[1]
  assert not re.search(r'(src|href)\s*=|https?://(?!www\.w3\.org)', ours)
  text = re.search(r'application/json">(.*?)</script>', ours, re.DOTALL)[1]
  assert json.loads(text.removesuffix('\\u003c/script>'))['timestep'] == 0.1
  assert not math.isnan(track.true_return)
