"""Fixture of all tests of experiments: plans of jobs are made quickly."""

import functools

import pytest

from realab_suite import sources
from realab_suite import suite
from tests.lab.experiments import small


@pytest.fixture(autouse=True, scope='module')
def _planned_quickly():
  """Finds the dynamics of each world once, and measures few stakes."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(suite, 'dynamics', small.dynamics)
    # Somebody may edit the package while it is tested.
    code = functools.cache(sources.current_digest)
    patch.setattr(sources, 'current_digest', code)
    with small.quick_stakes():
      yield
