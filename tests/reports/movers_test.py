"""Tests of the figures of movers: whose corruption it was."""

import csv

import pytest

from realab_suite.evaluation import results
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.experiments import training
from realab_suite.reports import html_page
from tests.reports import pages


def _metrics(world):
  """Returns the attribution of an episode; worlds 0 and 1 have corruption."""
  has_corruption = world < 2
  return attribution_metrics.AttributionMetrics(
      total=0.3 if has_corruption else 0.0,
      agent=0.4 if has_corruption else 0.0,
      world=0.1 if has_corruption else 0.0,
      agent_share=(0.75, 0.85)[world] if has_corruption else None,
  )


def _attribute(data):
  """Adds attributions to all rows but those of the last world."""
  rows = []
  for line in data.splitlines():
    row = results.EpisodeResult.model_validate_json(line)
    if row.world < 3:
      row = row.of_run(row.info, attribution=_metrics(row.world))
    rows.append(results.line(row))
  return b''.join(rows)


def test_movers_are_means_over_the_attributed_episodes(own_folder, tmp_path):
  for seed in range(3):
    pages.spoil(own_folder, 'reward', seed, training.EPISODES, _attribute)
  pages.write(own_folder, tmp_path)
  with open(tmp_path / html_page.CSV, encoding='utf-8', newline='') as file:
    records = {record['run']: record for record in csv.DictReader(file)}
  # Three episodes of each of three seeds, of which two have corruption.
  assert float(records['reward']['agent_share']) == 0.8
  metres = float(records['reward']['agent_metres'])
  assert metres == pytest.approx(0.8 / 3)
  assert records['decoupled']['agent_metres'] == ''
