"""Tests that the package's metadata match its files and dependencies."""

import configparser
import importlib
from importlib import metadata
import pathlib
import re
import sys

import pytest

import realab_suite
from realab_suite import _versions
from realab_suite import errors

_ROOT = pathlib.Path(__file__).parents[1]
_WORKING_PAIR = {'dm-control': '1.0.50', 'mujoco': '3.17.0'}


def _install(monkeypatch, **changes):
  """Pretends that the working pair, with `changes`, is what is installed."""
  versions = _WORKING_PAIR | {
      name.replace('_', '-'): version for name, version in changes.items()
  }

  def version(name):
    if versions[name] is None:
      raise metadata.PackageNotFoundError(name)
    return versions[name]

  monkeypatch.setattr(metadata, 'version', version)


def _setup_cfg():
  setup = configparser.ConfigParser()
  setup.read(_ROOT / 'setup.cfg', encoding='utf-8')
  return setup


def _lines(text):
  return [line.strip() for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'dm_control': '1.0.51'},
        {'mujoco': '3.18.0.dev1'},
    ],
)
def test_a_pair_inside_the_ranges_is_accepted(monkeypatch, changes):
  _install(monkeypatch, **changes)
  assert _versions.check() is None


@pytest.mark.parametrize(
    ('changes', 'found'),
    [
        ({'mujoco': '4.0.0'}, 'dm-control 1.0.50 and mujoco 4.0.0'),
        ({'dm_control': '2.0'}, 'dm-control 2.0 and mujoco 3.17.0'),
        ({'mujoco': None}, 'dm-control 1.0.50 and mujoco missing'),
        ({'mujoco': 'unknown'}, 'dm-control 1.0.50 and mujoco unknown'),
    ],
)
def test_a_wrong_pair_is_refused_in_one_line_with_the_remedy(
    monkeypatch, changes, found
):
  _install(monkeypatch, **changes)
  with pytest.raises(ImportError) as caught:
    _versions.check()
  assert isinstance(caught.value, errors.RealabError)
  remove = 'python -m pip uninstall -y mujoco mujoco-core mujoco-studio; '
  assert str(caught.value) == (
      f'realab_suite: found {found};'
      ' needs dm-control>=1.0.50,<2 and mujoco>=3.17,<4;'
      f' run: {remove if "4.0" in found else ""}python -m pip install'
      ' "dm-control>=1.0.50,<2" "mujoco>=3.17,<4"'
  )


def test_the_doctor_says_in_one_line_that_mujoco_4_is_installed(monkeypatch):
  _install(monkeypatch, mujoco='4.0.0')
  monkeypatch.setattr(sys, 'argv', ['/usr/bin/realab', 'doctor'])
  with pytest.raises(SystemExit, match=r'^realab_suite: found .* mujoco 4'):
    importlib.reload(realab_suite)
  monkeypatch.setattr(sys, 'argv', ['/usr/bin/python3'])
  with pytest.raises(_versions.DependencyError):
    importlib.reload(realab_suite)


def test_the_checked_ranges_are_those_that_pip_is_given():
  required = _lines(_setup_cfg()['options']['install_requires'])
  checked = [f'{n}>={low},<{high}' for n, low, high in _versions._RANGES]
  assert set(checked) <= set(required)


def test_every_folder_with_code_is_in_the_list_of_packages():
  folders = [
      path.parent.relative_to(_ROOT)
      for top in ('realab_suite', 'configs')
      for path in (_ROOT / top).rglob('__init__.py')
  ]
  names = [
      '.'.join(folder.parts).replace('configs', 'realab_suite.configs')
      for folder in folders
  ]
  assert sorted(names) == _lines(_setup_cfg()['options']['packages'])


def test_every_data_file_is_shipped():
  """Files of the packages that are no code, against `package_data`."""
  data = _setup_cfg()['options.package_data']
  shipped = {
      path
      for package, patterns in data.items()
      for pattern in _lines(patterns)
      for path in (
          _ROOT
          / package.replace('realab_suite.configs', 'configs').replace('.', '/')
      ).glob(pattern)
  }
  there = {
      path
      for top in ('realab_suite', 'configs')
      for path in (_ROOT / top).rglob('*')
      if path.is_file() and path.suffix not in ('.py', '.pyc')
  }
  assert there == shipped


@pytest.mark.parametrize(
    ('file', 'pattern'),
    [
        ('CITATION.cff', r'^version: (.+)$'),
        ('CHANGELOG.md', r'^## \[(\d.+?)\]'),
        ('README.md', r'version = \{(\d.+?)\}'),
    ],
)
def test_one_version_is_named_everywhere(file, pattern):
  text = (_ROOT / file).read_text(encoding='utf-8')
  named = re.search(pattern, text, re.MULTILINE)
  assert named[1] == realab_suite.__version__
