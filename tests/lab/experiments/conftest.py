"""Fixture of all tests of experiments: plans of jobs are made quickly."""

import pytest

from realab_suite import suite
from tests.lab.experiments import small


@pytest.fixture(autouse=True, scope='module')
def _planned_quickly():
  """Builds each world once to find its dynamics, and measures few stakes."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(suite, 'dynamics', small.dynamics)
    with small.quick_stakes():
      yield
