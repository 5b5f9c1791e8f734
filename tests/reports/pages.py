"""Helpers of the tests of reports: writing, reading and damaging them."""

import html
import json
import re

import pytest

from realab_suite.evaluation import results
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.reports import html_page
from realab_suite.reports import plots


def quiet(line):
  del line


def write(folder, output, with_charts=False):
  """Writes a report; returns its page."""
  with pytest.MonkeyPatch.context() as patch:
    if not with_charts:  # They take most of the time.
      patch.setattr(plots, 'learning', lambda *unused: {})
    path = html_page.write(folder, output, quiet)
  return path.read_text(encoding='utf-8')


def rows(folder, run):
  sweep = json.loads((folder / scheduler.SWEEP).read_text())
  return [
      row
      for job in sweep['jobs']
      if job['run'] == run
      for row in results.read_rows(folder / job['folder'] / training.EPISODES)
  ]


def text(page):
  """Returns the text of a page, without explanations of words."""
  page = re.sub(r'<span class="tip".*?</span>', '', page)
  text = re.sub(r'<style>.*?</style>', '', page, flags=re.DOTALL)
  return html.unescape(re.sub(r'<[^>]*>', '', text))


def cells(page, title, run):
  """Returns the cells of a run's row in a table."""
  section = page.split(f'{title}</h2>', 1)[1].split('</table>', 1)[0]
  rows = re.findall(r'<tr>(.*?)</tr>', section, flags=re.DOTALL)
  for row in rows:
    cells = re.findall(r'<td[^>]*>(.*?)</td>', row, flags=re.DOTALL)
    texts = [' '.join(text(cell).split()) for cell in cells]
    if texts and texts[0] == run:
      return texts
  raise AssertionError(f'no row of {run}')


def spoil(folder, run, seed, name, change):
  """Changes a file of a job."""
  sweep = json.loads((folder / scheduler.SWEEP).read_text())
  [job] = [j for j in sweep['jobs'] if (j['run'], j['seed']) == (run, seed)]
  path = folder / job['folder'] / name
  path.write_bytes(change(path.read_bytes()))
  # So whatever refuses or reports it has not compared digests.
  storage.finish(path.parent, {}, training.RECORDS)
  return path


def give_up(folder, run, seed, end=b'abandoned'):
  spoil(
      folder, run, seed, training.EPISODES,
      lambda data: data.replace(
          b'"end":"timeout","is_valid":true',
          b'"end":"%s","is_valid":false' % end,
      ),
  )  # fmt: skip
