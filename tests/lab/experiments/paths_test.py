"""Paths in files and flags never lead out of the working directory."""

from collections.abc import Callable
import json
import os
import pathlib
import re
import sys
import sysconfig
from typing import Any

import pytest
import yaml

import realab_suite
from realab_suite import errors
from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import result_folders
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import scripted
from realab_suite.lab.experiments import storage
from tests.config import off_limits
from tests.lab.experiments import small

_WATCH = off_limits.Watch()
_ALLOWED = (
    str(pathlib.Path(realab_suite.__file__).parents[1]),
    sys.prefix,
    sys.base_prefix,
    sysconfig.get_path('stdlib'),
)
_REGISTER = {
    'kind': 'two_block', 'role': 'feedback', 'initial': 0, 'place': 'station_1',
    'range': [0, 13],
}  # fmt: skip


def _design(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1, 'name': 'd', 'registers': {'reward': _REGISTER}, **changes,
  }  # fmt: skip


def _load_design(**changes: Any) -> Any:
  pathlib.Path('given.yaml').write_text(json.dumps(_design(**changes)))
  return specs.load('given.yaml')


def _load_world(**changes: Any) -> Any:
  register = {**_REGISTER, **changes}
  design = _design(registers={'reward': register})
  return suite.load('unlock_door', 'near', design=design)


def _experiment(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'e',
      'task': 'unlock_door.near',
      'runs': {'one': {'design': 'online_imitation'}},
      'seeds': [0],
      **changes,
  }


def _load_experiment(**changes: Any) -> Any:
  pathlib.Path('given.yaml').write_text(json.dumps(_experiment(**changes)))
  return experiment_specs.load('given.yaml')


def _load_sweep(folder: str) -> Any:
  """Reads a sweep whose description is forged."""
  sweep = pathlib.Path('sweep')
  sweep.mkdir(exist_ok=True)
  if folder == 'link.yaml' and not os.path.lexists(sweep / folder):
    os.symlink(os.path.abspath('linked'), sweep / folder)
  text = yaml.safe_dump(_experiment())
  (sweep / scheduler.EXPERIMENT).write_text(text, encoding='utf-8')
  job = {
      'run': 'one', 'seed': 0, 'folder': folder, 'kind': 'q_learning',
      'is_scripted': False, 'design': 'd', 'channel': 'embedded',
      'baseline': None, 'twin_of': None,
  }  # fmt: skip
  content = {'experiment': 'e', 'calibration': False, 'jobs': [job]}
  storage.write_json(sweep / scheduler.SWEEP, content)
  return result_folders.load(sweep)


def _run_scripted(**changes: Any) -> Any:
  return scripted.run(small.settings(pathlib.Path(), **changes), str)


# Uses of a path. Options of designs are tried by config/option_types_test.py.
_USES: dict[str, Callable[[str], Any]] = {
    'design of an experiment': lambda path: _load_experiment(
        runs={'one': {'design': path}}
    ),
    'weights in an override': lambda path: _load_experiment(
        runs={
            'one': {
                'design': 'online_imitation',
                'overrides': [
                    'providers.0.policy=network_demonstrator',
                    f'providers.0.options.weights={path!r}',
                ],
            }
        }
    ),
    'name of an experiment': lambda path: _load_experiment(name=path),
    'baseline': lambda path: _load_experiment(baselines=[path]),
    'name of a design': lambda path: _load_design(name=path),
    'model in a design': lambda path: _load_design(model=path),
    'kind of a register': lambda path: _load_world(kind=path),
    'option of a register': lambda path: _load_world(options={'file': path}),
    'folder of a job': _load_sweep,
    '--run': lambda path: jobs.plan(
        experiment_specs.load(_experiment()), [0], [path]
    ),
    '--policies': lambda path: _run_scripted(policies=(path,)),
    '--target': lambda path: _run_scripted(
        policies=('carrying_saboteur',), target=path
    ),
}


@pytest.mark.parametrize('use', _USES)
def test_a_path_that_leads_elsewhere_is_refused_and_not_opened(use: str):
  with off_limits.workplace() as folder:
    for path in off_limits.make_paths(folder).values():
      with _WATCH.only(os.getcwd(), *_ALLOWED):
        with pytest.raises(errors.RealabError) as caught:
          _USES[use](path)
        assert _WATCH.opened == []
      assert str(caught.value).isprintable()


def test_a_file_that_a_call_names_is_opened_and_the_watch_sees_it():
  with off_limits.workplace() as folder, _WATCH.only('.'):
    specs.load(str(folder / 'secret.yaml'))
    assert any(off_limits.FOLDER in path for path in _WATCH.opened)


def test_a_design_within_the_working_directory_may_be_named(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
  monkeypatch.chdir(tmp_path)
  (tmp_path / 'designs').mkdir()
  action_set = {'name': 'dmlab_like', 'version': 1}
  design = _design(action_set=action_set, learner={'kind': 'mine'})
  text = yaml.safe_dump(design)
  (tmp_path / 'designs' / 'mine.yaml').write_text(text, encoding='utf-8')
  for name in ('designs/mine.yaml', str(tmp_path / 'designs' / 'mine.yaml')):
    loaded = _load_experiment(runs={'one': {'design': name}})
    assert loaded.runs['one'].load(is_confined=True).name == 'd'


def test_no_module_reads_a_model_from_a_file_or_a_text():
  # What a design or an experiment says never becomes MJCF, and no `.mjb` is
  # ever loaded: includes, meshes and entities cannot lead anywhere.
  reads = re.compile(
      r'mjcf\.from_|from_xml_(path|string)|from_binary_path|mj_loadXML'
      r'|mj_loadModel|MjSpec|lxml|xml\.etree'
  )
  package = pathlib.Path(realab_suite.__file__).parent
  found = {
      path.name: match.group()
      for path in package.rglob('*.py')
      if (match := reads.search(path.read_text(encoding='utf-8')))
  }
  assert found == {
      # A box with which a process of its own tests the renderer.
      'renderers.py': 'from_xml_string',
  }
