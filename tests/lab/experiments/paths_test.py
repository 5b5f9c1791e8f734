"""Files may name other files anywhere, and names are no paths."""

import json
import os
import pathlib
import re
from typing import Any

import pytest
import yaml

import realab_suite
from realab_suite import errors
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import studies
from realab_suite.policies import network_files
from tests.config import refusals


def _experiment(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'e',
      'task': 'unlock_door.near',
      'runs': {'one': {'design': 'online_imitation'}},
      'seeds': [0],
      **changes,
  }


def _load_sweep(folder: str) -> Any:
  """Reads a sweep whose description is forged."""
  sweep = pathlib.Path('sweep')
  sweep.mkdir(exist_ok=True)
  text = yaml.safe_dump(_experiment())
  (sweep / scheduler.EXPERIMENT).write_text(text, encoding='utf-8')
  job = {
      'run': 'one', 'seed': 0, 'folder': folder, 'kind': 'q_learning',
      'is_scripted': False, 'design': 'd', 'channel': 'embedded',
      'baseline': None, 'twin_of': None,
  }  # fmt: skip
  content = {'experiment': 'e', 'calibration': False, 'jobs': [job]}
  storage.write_json(sweep / scheduler.SWEEP, content)
  return studies.read_sweep(sweep)


@pytest.fixture(autouse=True)
def elsewhere(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> pathlib.Path:
  """A folder beside the working directory."""
  for name in ('elsewhere', 'here'):
    (tmp_path / name).mkdir()
  monkeypatch.chdir(tmp_path / 'here')
  return tmp_path / 'elsewhere'


@pytest.mark.parametrize('path', ['../elsewhere', '/etc', 'a/../b', '~', '.'])
def test_a_name_of_which_a_folder_is_made_is_no_path(path: str):
  design = specs.load('online_imitation').to_source()
  runs = {path: {'design': 'online_imitation'}}
  for load, given in (
      (specs.load, {**design, 'name': path}),
      (experiment_specs.load, _experiment(name=path)),
      (experiment_specs.load, _experiment(runs=runs)),
      (_load_sweep, path),
  ):
    with pytest.raises(errors.RealabError, match=r'a-z|matches'):
      load(given)


def test_a_folder_of_a_job_is_no_link(elsewhere: pathlib.Path):
  os.mkdir('sweep')
  os.symlink(elsewhere, 'sweep/link')
  with pytest.raises(errors.RealabError, match='not a symbolic link'):
    _load_sweep('link')


@pytest.mark.parametrize('is_absolute', [True, False])
def test_a_file_may_name_designs_and_networks_anywhere(
    elsewhere: pathlib.Path, is_absolute: bool
):
  folder = elsewhere if is_absolute else pathlib.Path('..', elsewhere.name)
  network = network_files.load('demonstrator_v1')
  (elsewhere / 'own.npz').write_bytes(network.to_bytes())
  weights = f'{folder}/own.npz'
  design = specs.load('online_imitation').to_source()
  [provider] = design['providers']
  provider['policy'] = 'network_demonstrator'
  provider['options'] = options = {'weights': weights}
  design['learner']['trusted'] = weights  # Any text of a learner.
  (elsewhere / 'mine.yaml').write_text(json.dumps(design))
  run = {
      'design': f'{folder}/mine.yaml',
      'learner': design['learner'],
      'overrides': [f'providers.0.options.weights={weights}'],
  }
  given = pathlib.Path('given.yaml')
  given.write_text(json.dumps(_experiment(runs={'one': run})))
  [loaded] = experiment_specs.load(given).designs.values()
  assert loaded.to_mapping()['providers'][0]['options'] == options
  # What is not there, or is no network, is refused with its keys.
  for wrong in ('nowhere.npz', 'mine.yaml', '.'):
    provider['options'] = {'weights': f'{folder}/{wrong}'}
    given.write_text(json.dumps(design))
    text = refusals.refusal(specs.load, given)
    assert text.startswith('given.yaml: providers[0]: ')


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
