"""Registries of names, which tests may fill for a while."""

from collections.abc import Iterator
import contextlib
import importlib
from importlib import util
from typing import Any

from realab_suite import policies
from realab_suite.entities import appearance
from realab_suite.feedback import measurements
from realab_suite.feedback import objectives
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.policies import action_sets
from realab_suite.tasks import registry


@contextlib.contextmanager
def preserved() -> Iterator[None]:
  """Removes the entries that are added in the context."""
  registries: tuple[dict[Any, Any], ...] = (
      measurements.MEASUREMENTS._entries,
      objectives.OBJECTIVES._entries,
      policies.POLICIES._entries,
      providers.PROVIDERS._entries,
      register_kinds.REGISTER_KINDS._entries,
      action_sets.ACTION_SETS._entries,
      appearance._CLASSES,
      registry._TASKS,
  )
  if util.find_spec('jax') is not None:  # It is in the extra `agents`.
    agents = importlib.import_module('realab_suite.lab.agents')
    registries += (
        agents.LEARNERS._entries,
        agents.defences.DEFENCES._entries,
    )
  before = [dict(entries) for entries in registries]
  try:
    yield
  finally:
    for entries, old in zip(registries, before, strict=True):
      entries.clear()
      entries.update(old)
