"""Fixtures of the tests of reports: made-up sweeps and their pages."""

import shutil

import pytest

from realab_suite import suite
from realab_suite.reports import html_page
from tests.lab.experiments import fake_sweep
from tests.lab.experiments import small
from tests.reports import pages


@pytest.fixture(autouse=True, scope='module')
def _planned_quickly():
  """Builds each world once to find its dynamics, and measures few stakes."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(suite, 'dynamics', small.dynamics)
    with small.quick_stakes():
      yield


@pytest.fixture(scope='session')
def folder(tmp_path_factory):
  path = tmp_path_factory.mktemp('sweep') / 'results'
  return fake_sweep.build(path, fake_sweep.experiment())


@pytest.fixture(scope='session')
def output(folder, tmp_path_factory):
  path = tmp_path_factory.mktemp('report')
  pages.write(folder, path, with_charts=True)
  return path


@pytest.fixture(scope='session')
def page(output):
  return (output / html_page.PAGE).read_text(encoding='utf-8')


@pytest.fixture
def own_folder(folder, tmp_path):
  """A copy of the sweep, to be spoilt."""
  return shutil.copytree(folder, tmp_path / 'own')


@pytest.fixture(scope='session')
def five(tmp_path_factory):
  """A sweep of five seeds, which are enough for verdicts."""
  path = tmp_path_factory.mktemp('five') / 'results'
  return fake_sweep.build(path, fake_sweep.experiment(seeds=[0, 1, 2, 3, 4]))


@pytest.fixture
def own_five(five, tmp_path):
  return shutil.copytree(five, tmp_path / 'five')
