"""Tests of the pages in headless Chromium, with real keys and clicks.

    python -m pytest tests/interop/browser/pages_in_chromium.py

runs them where Chromium, playwright and the extra `browser` are installed.
With SCREENSHOTS set to a folder, they save pictures of the pages there.
"""

import concurrent.futures
import json
import os
import pathlib
import time

import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import evaluate
from realab_suite.experiments import supervised_designs
from realab_suite.experiments import tracking
from realab_suite.feedback import specs
from tests import patience
from tests.experiments import small
from tests.interop.browser import chromium

pytestmark = [
    pytest.mark.camera,
    # Libraries of the browser are not ours.
    pytest.mark.filterwarnings('default'),
]


@pytest.fixture(autouse=True)
def fixture_chromium():
  chromium.needed()
  with small.quick_stakes():
    yield


def _save(page, name):
  if folder := os.environ.get('SCREENSHOTS'):
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=folder / f'{name}.png')


def test_a_replay_opens_offline_and_its_timeline_moves_the_scene(tmp_path):
  from realab_suite.interop.browser import recordings
  from realab_suite.reports import replay_pages

  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 250},
      design='instantaneous_reward',
  )  # fmt: skip
  scenes, contacts = [], {}

  def add(unused_physics, track):
    if not scenes:
      scenes.append(recordings.Recording(env))
    scenes[0].add()
    for name, kind in replay_pages.contacts(env).items():
      contacts.setdefault(name, [])
      if kind is not None:
        contacts[name].append((track.num_steps, kind))

  recorder = tracking.Tracker(env, add)
  policy = policies.make('carrying_saboteur')
  [result] = evaluate.evaluate(env, policy, 1, sinks=[recorder])
  data = replay_pages.timeline(recorder.track, contacts)
  data.update(title='carrying_saboteur', note='an episode')
  text = recordings.with_timeline(scenes[0].page(), json.dumps(data))
  file = tmp_path / 'replay.html'
  file.write_text(text, encoding='utf-8')
  assert result.num_steps == 250
  assert len(text.encode()) < 5e6
  with chromium.page(760, 640, offline=True) as (page, requests):
    page.goto(file.as_uri())
    page.wait_for_selector('#root input')
    patience.until(lambda: _step(page) >= 5)
    box = page.locator('#realab svg').first.bounding_box()
    page.mouse.click(box['x'] + 0.2 * box['width'], box['y'] + 10)
    patience.until(lambda: _step(page) == 50)
    _save_scene(page, 'replay')
    page.click('text=First person')
    page.wait_for_function("location.hash === '#first@5.0'")
    page.wait_for_selector('#root input')
    patience.until(lambda: _step(page) == 50)
    _save_scene(page, 'replay_first_person')
  assert all(one.startswith(('file:', 'data:', 'blob:')) for one in requests)


def _save_scene(page, name):
  """Saves a picture of a replay whose player is paused and has drawn."""
  if os.environ.get('SCREENSHOTS'):
    page.evaluate(
        '() => new Promise((done) => requestAnimationFrame(() =>'
        ' requestAnimationFrame(done)))'
    )
    _save(page, name)


def _step(page):
  """Returns the step that the time line of a replay shows, or -1."""
  words = page.locator('#realab-clock').text_content().split()
  return int(words[1]) if words else -1


def _settings(max_steps=60, rate=20.0, output=None):
  from realab_suite.experiments import played

  return played.Settings(
      worlds.World('unlock_door', 'near', max_steps),
      specs.load('instantaneous_reward'),
      seed=1,
      num_episodes=1,
      rate=rate,
      output=output,
  )


def test_a_person_plays_and_gets_the_summary_of_any_agent(tmp_path):
  from realab_suite.experiments import played
  from realab_suite.interop.browser import servers

  said = []
  settings = _settings(output=str(tmp_path / 'played'))
  with (
      concurrent.futures.ThreadPoolExecutor() as pool,
      servers.PageServer('play') as server,
      chromium.page() as (page, requests),
  ):
    playing = pool.submit(played.play, settings, server, said.append)
    page.goto(server.url)
    page.wait_for_selector('text=Press any key')
    page.keyboard.press('Enter')
    page.keyboard.down('KeyW')
    page.wait_for_selector('#clock:has-text("forward")')
    page.keyboard.down('KeyD')
    page.wait_for_selector('#summary:not([hidden])')
    _save(page, 'play_summary')
    lines = playing.result(timeout=60)
  assert [line.run for line in lines] == ['person', 'apple_seeker']
  person = (tmp_path / 'played' / 'episodes.jsonl').read_text().splitlines()[0]
  assert json.loads(person)['num_steps'] == 60
  assert {one.split('?')[0] for one in requests if one[:4] == 'http'} == {
      server.url.split('?')[0]
  }
  rate = float(said[-1].split('acted in ')[1].split(' ')[0])
  assert rate >= 10.0


@pytest.mark.parametrize('width', [360, 768, 1280])
def test_a_person_without_a_keyboard_plays_by_touch(width):
  from realab_suite.experiments import played
  from realab_suite.interop.browser import servers

  settings = _settings(max_steps=20, rate=3.0)
  with (
      concurrent.futures.ThreadPoolExecutor() as pool,
      servers.PageServer('play') as server,
      chromium.page(width, 800, has_touch=True) as (page, _),
  ):
    playing = pool.submit(played.play, settings, server, lambda text: None)
    page.goto(server.url)
    page.tap('text=Press any key')
    for code, action in (('KeyW', 'forward'), ('KeyG', 'grasp')):
      page.tap(f'[data-code={code}]')
      page.wait_for_selector(f'#clock:has-text("{action}")')
    page.tap('[data-code=KeyP]')
    page.wait_for_selector('text=Paused')
    page.evaluate("document.getElementById('cover').hidden = true")
    _save(page, f'play_{width}')
    is_wide = 'document.documentElement.scrollWidth > innerWidth'
    assert not page.evaluate(is_wide)
    page.evaluate("document.getElementById('cover').hidden = false")
    page.tap('#cover')
    playing.result()


def test_the_page_tells_both_returns_apart_while_a_block_is_displaced(
    monkeypatch,
):
  from realab_suite.experiments import played
  from realab_suite.interop.browser import keyboards
  from realab_suite.interop.browser import servers

  saboteur = policies.make('carrying_saboteur')
  monkeypatch.setattr(keyboards, 'Keyboard', lambda *unused: saboteur)
  settings = _settings(max_steps=40, rate=5.0)
  with (
      concurrent.futures.ThreadPoolExecutor() as pool,
      servers.PageServer('play') as server,
      chromium.page() as (page, _),
  ):
    playing = pool.submit(played.play, settings, server, lambda text: None)
    page.goto(server.url)
    page.wait_for_selector('text=Press any key')
    page.keyboard.press('Enter')
    page.wait_for_selector('text=its clean content is')
    patience.until(lambda: float(page.text_content('#observed')) > 20)
    page.keyboard.press('p')
    page.wait_for_selector('text=Paused')
    assert page.text_content('#true') == '0.00'
    _save(page, 'play_paused')
    page.evaluate("document.getElementById('cover').hidden = true")
    _save(page, 'play')
    page.keyboard.press('Enter')
    playing.result()


@pytest.mark.parametrize('asks', ['approval', 'correction', 'comparison'])
def test_a_person_supervises_a_whole_episode_by_clicks(tmp_path, asks):
  from realab_suite.experiments import supervised
  from realab_suite.interop.browser import servers

  num_steps = 40 if asks == 'comparison' else 20
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': num_steps},
      design=supervised_designs.design(asks, 'live', waits=True),
  )  # fmt: skip

  def supervise(server):
    supervision = supervised.Supervision(env, server, tmp_path, 1000.0)
    result = supervision.run(policies.make('apple_seeker'), 0)
    server.send({'type': 'summary', 'text': 'The end'})
    return result, supervision.delays

  with (
      concurrent.futures.ThreadPoolExecutor() as pool,
      servers.PageServer('supervise') as server,
      chromium.page() as (page, _),
  ):
    running = pool.submit(supervise, server)
    page.goto(server.url)
    page.click('#run:not([disabled])')
    answered = 0
    while not running.done():
      button = page.locator('#answers button:not([disabled])').first
      if button.count() and page.locator('#summary').is_hidden():
        if answered == 1:
          page.wait_for_timeout(300)
          _save(page, f'supervise_{asks}')
        try:
          button.click(timeout=500)
          answered += 1
        except Exception:
          continue
      time.sleep(0.01)
    result, delays = running.result()
  lines = (tmp_path / supervised.ANSWERS).read_text().splitlines()
  expected = 2 if asks == 'comparison' else num_steps
  assert result.num_steps == num_steps
  assert len(lines) == len(delays) == expected
  assert sorted(delays)[int(0.95 * len(delays))] < 0.1
  design = supervised_designs.design(
      asks, 'recorded', {'file': str(tmp_path / supervised.ANSWERS)}
  )
  again = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': num_steps},
      design=design,
  )  # fmt: skip
  [repeated] = evaluate.evaluate(again, policies.make('apple_seeker'), 1)
  assert repeated.registers == result.registers


def test_a_person_stops_an_episode_that_does_not_wait(tmp_path):
  from realab_suite.experiments import supervised
  from realab_suite.interop.browser import servers

  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 250},
      design=supervised_designs.design('approval', 'live'),
  )  # fmt: skip

  def supervise(server):
    supervision = supervised.Supervision(env, server, tmp_path, 10.0)
    return supervision.run(policies.make('random'), 0)

  with (
      concurrent.futures.ThreadPoolExecutor() as pool,
      servers.PageServer('supervise') as server,
      chromium.page() as (page, _),
  ):
    running = pool.submit(supervise, server)
    page.goto(server.url)
    page.click('#run:not([disabled])')
    page.keyboard.press('ArrowUp')
    page.wait_for_selector('#answers button')
    page.keyboard.press('ArrowUp')
    page.keyboard.press('x')
    result = running.result(timeout=60)
  assert result.end.value == 'signal'
  lines = (tmp_path / supervised.ANSWERS).read_text().splitlines()
  last = json.loads(lines[-1])
  assert (last['asks'], last['value']) == ('stop', 1.0)
