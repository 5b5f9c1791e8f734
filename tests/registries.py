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
  registries = [
      measurements.MEASUREMENTS,
      objectives.OBJECTIVES,
      objectives.PAYMENTS,
      policies.POLICIES,
      policies.VALUE_FUNCTIONS,
      providers.PROVIDERS,
      register_kinds.REGISTER_KINDS,
      action_sets.ACTION_SETS,
  ]
  if util.find_spec('jax') is not None:  # It is in the extra `agents`.
    agents = importlib.import_module('realab_suite.lab.agents')
    registries += [agents.LEARNERS, agents.defences.DEFENCES]
  # A module registers its entries once, when it is imported.
  for names in registries:
    for name in names:
      names.get(name)
  registry.of_package()  # Imports all domains.
  tables: list[dict[Any, Any]] = [names._entries for names in registries]
  tables += [appearance._CLASSES, registry._TASKS]
  before = [dict(entries) for entries in tables]
  try:
    yield
  finally:
    for entries, old in zip(tables, before, strict=True):
      entries.clear()
      entries.update(old)
