"""Fixtures of the tests of datasets."""

import pytest

from realab_suite import suite
from tests.lab.experiments import small


@pytest.fixture(autouse=True, scope='session')
def _cached_dynamics():
  """Builds each world once to find its dynamics."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(suite, 'dynamics', small.dynamics)
    yield
