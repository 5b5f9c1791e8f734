"""Tests of the pages in headless Chromium, with real keys and clicks.

    python -m pytest tests/doors/browser/pages_in_chromium.py

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
from realab_suite.doors.browser import supervised_designs
from realab_suite.evaluation import evaluate
from tests.doors.browser import chromium
from tests.lab.experiments import small

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


@pytest.mark.parametrize('asks', ['approval', 'correction', 'comparison'])
def test_a_person_supervises_a_whole_episode_by_clicks(tmp_path, asks):
  from realab_suite.doors.browser import servers
  from realab_suite.doors.browser import supervised

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
  from realab_suite.doors.browser import servers
  from realab_suite.doors.browser import supervised

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
