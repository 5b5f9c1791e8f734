"""Tests of the digest of sources, and of the designs beside the code."""

import importlib
import os
import pathlib
import shutil
import subprocess
import sys

import pytest

from realab_suite import errors
from realab_suite import sources
from realab_suite.config import documents

_MODULES = {
    'sources_mine.py': 'import importlib\n'
    'from sources_pack import inner\n'
    "importlib.import_module('sources_' + 'dynamic')\n",
    'sources_pack/__init__.py': 'import json, numpy.linalg\n',
    'sources_pack/inner.py': 'from .deep import VALUE\n',
    'sources_pack/deep.py': 'VALUE = 1\ndef later():\n  import sources_lazy\n',
    'sources_lazy.py': 'VALUE = 1\n',
    'sources_dynamic.py': '',
    'sources_unrelated.py': '',
}


def _use(folder: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> str:
  """Imports the module of a user from a folder, and returns the digest."""
  for name, text in _MODULES.items():
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
  monkeypatch.syspath_prepend(str(folder))
  for name in [name for name in sys.modules if name.startswith('sources_')]:
    del sys.modules[name]
  before = set(sys.modules)
  importlib.import_module('sources_mine')
  sources.use(['sources_mine'], sys.modules.keys() - before)
  return sources.digest()


@pytest.fixture(autouse=True)
def _forget():
  yield
  sources.use([], [])


@pytest.mark.parametrize('name', sorted(_MODULES))
def test_what_a_module_imports_is_a_source(name, tmp_path, monkeypatch):
  one = _use(tmp_path / 'one', monkeypatch)
  assert _use(tmp_path / 'two', monkeypatch) == one
  path = tmp_path / 'two' / name
  path.write_bytes(path.read_bytes().replace(b'\n', b'\r\n'))
  assert sources.current_digest() == one
  path.write_text(f'{_MODULES[name]}OTHER = 1\n')
  is_same = name == 'sources_unrelated.py'
  assert (sources.current_digest() == one) == is_same
  assert sources.digest() == one


def test_a_module_with_another_name_is_another_source(tmp_path, monkeypatch):
  one = _use(tmp_path, monkeypatch)
  monkeypatch.setitem(
      _MODULES, 'sources_pack/inner.py', 'from .deep2 import VALUE\n'
  )
  deep = _MODULES['sources_pack/deep.py']
  monkeypatch.setitem(_MODULES, 'sources_pack/deep2.py', deep)
  assert _use(tmp_path, monkeypatch) != one


@pytest.fixture(name='clone')
def fixture_clone(tmp_path):
  """Another checkout."""
  root = sources.FOLDER.parent
  ignored = shutil.ignore_patterns('__pycache__')
  for name in ('realab_suite', 'configs'):
    shutil.copytree(root / name, tmp_path / name, ignore=ignored)
  return tmp_path


def test_what_jobs_run_is_a_source_in_any_folder(clone, monkeypatch):
  here = sources.current_digest()
  package = clone / 'realab_suite'
  monkeypatch.setattr(sources, 'FOLDER', package)
  for name, is_source in (
      ('reports/plots.py', False),
      ('launchers/sweep.py', False),
      ('doors/data/cards.py', False),
      ('testing/__init__.py', False),
      ('engine/seeding.py', True),
      ('lab/agents/networks.py', True),
      ('lab/experiments/jobs.py', True),
      ('entities/registers/two_block.py', True),
      ('new.py', True),
  ):
    assert sources.current_digest() == here
    path = package / name
    text = path.read_bytes() if path.exists() else None
    path.write_bytes((text or b'') + b'# Changed.\n')
    assert (sources.current_digest() != here) == is_source, name
    path.unlink()
    if text is not None:
      path.write_bytes(text)


def test_a_wheel_has_the_digest_of_its_clone(clone, monkeypatch):
  package = clone / 'realab_suite'
  monkeypatch.setattr(sources, 'FOLDER', package)
  here = sources.current_digest()
  assert list((clone / 'configs').rglob('*.py'))
  # As in `package_dir` of setup.cfg.
  (clone / 'configs').rename(package / 'configs')
  assert sources.current_digest() == here


def test_designs_are_those_beside_the_code(clone, monkeypatch):
  # Another checkout is installed, whose designs would be found otherwise.
  (clone / 'configs' / 'designs' / 'theirs.yaml').write_text('')
  program = (
      'from realab_suite.config import documents;'
      "print(documents.shipped('designs', '.yaml')['theirs'])"
  )
  ended = subprocess.run(
      [sys.executable, '-c', program],
      env={**os.environ, 'PYTHONPATH': str(clone)},
      cwd=clone,
      capture_output=True,
      text=True,
      check=True,
  )
  assert ended.stdout.strip() == str(clone / 'configs/designs/theirs.yaml')
  monkeypatch.setattr(sources, 'FOLDER', clone / 'realab_suite')
  folder = documents.folder_of_configs.__wrapped__
  assert folder() == clone / 'configs'
  # In an installed package, they are within it.
  (clone / 'configs').rename(clone / 'realab_suite' / 'configs')
  assert folder() == clone / 'realab_suite' / 'configs'
  shutil.rmtree(clone / 'realab_suite' / 'configs')
  with pytest.raises(errors.SpecError, match='this code has no designs'):
    folder()
