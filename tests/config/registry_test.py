"""Registries import what they list when it is asked for, and not before."""

import subprocess
import sys
from typing import Any

import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.config import registry
from realab_suite.feedback import measurements
from realab_suite.feedback import providers
from realab_suite.tasks import registry as task_registry

_QUICKSTART = """
import sys
import realab_suite as realab
realab.load('unlock_door', 'standard', design='instantaneous_reward').reset()
print(*(name for name in sys.modules if name.startswith('realab_suite.')))
"""
_UNUSED = (
    'engine.batch_environment',
    'engine.foreign',
    'engine.snapshots',
    'feedback.measurements.tampering',
    'feedback.providers.inspection',
    'policies.saboteurs',
    'tasks.gates',
)


@pytest.mark.parametrize(
    'names',
    [
        measurements.MEASUREMENTS,
        policies.POLICIES,
        policies.VALUE_FUNCTIONS,
        providers.PROVIDERS,
    ],
)
def test_each_listed_module_registers_its_entries(names: Any):
  assert len(names) == len({*names})
  for name in names:
    assert names.get(name) is not None


def test_the_tasks_of_a_domain_are_in_the_module_of_its_name():
  # Otherwise nothing would import it when the task is asked for.
  domains = set()
  for domain_name, task_name in suite.ALL_TASKS:
    factory = task_registry.find(domain_name, task_name)
    made = getattr(factory, 'func', factory)
    assert made.__module__ == f'realab_suite.tasks.{domain_name}'
    domains.add(domain_name)
  assert domains == {*suite.TASKS_BY_DOMAIN} > {'gates', 'unlock_door'}


def test_the_quickstart_imports_nothing_that_its_design_does_not_use():
  done = subprocess.run(
      [sys.executable, '-c', _QUICKSTART],
      capture_output=True, text=True, check=True,
  )  # fmt: skip
  imported = done.stdout.split()
  assert 'realab_suite.feedback.providers.difference' in imported
  for name in _UNUSED:
    assert f'realab_suite.{name}' not in imported


def test_a_listed_name_is_taken_before_its_module_is_imported(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
):
  path = tmp_path / 'listed_entry.py'
  path.write_text('from listed_names import NAMES\nNAMES.add("ours")(int)\n')
  (tmp_path / 'listed_names.py').write_text(
      'from realab_suite.config import registry\n'
      'NAMES = registry.Registry("kind", {"ours": "listed_entry"})\n'
  )
  monkeypatch.syspath_prepend(str(tmp_path))
  import listed_names

  names: registry.Registry[Any] = listed_names.NAMES
  assert [*names] == ['ours']
  assert 'ours' in names
  assert 'listed_entry' not in sys.modules
  with pytest.raises(errors.SpecError, match="'ours' is registered already"):
    names.add('ours')(float)
  assert names.get('ours') is int
  with pytest.raises(errors.UnknownNameError, match="known are \\['ours'\\]"):
    names.get('theirs')
