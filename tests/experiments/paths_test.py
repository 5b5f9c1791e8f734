"""Campaign C22 in small, and that it can fail."""

from collections.abc import Iterator
import pathlib
import re
from typing import Any

import pytest

from campaigns import paths_campaign
import realab_suite
from realab_suite import errors
from realab_suite.config import annotations
from realab_suite.config import loading
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from tests.config import file_readers

_WATCH = paths_campaign.Watch()


def test_what_leads_elsewhere_is_refused_and_nothing_there_is_opened():
  found = paths_campaign.run(_WATCH, every=5)
  assert found.tried >= 40
  assert not found.accepted
  assert not found.other_errors
  assert not found.opened


def test_a_file_that_the_user_names_is_opened_and_the_watch_sees_it():
  with paths_campaign.workplace() as outside, _WATCH.only('.'):
    specs.load(str(outside / 'secret.yaml'))
    assert any(paths_campaign.OFF_LIMITS in path for path in _WATCH.opened)


def test_without_the_check_files_elsewhere_are_opened(
    monkeypatch: pytest.MonkeyPatch,
):
  monkeypatch.setattr(loading, 'is_inside', lambda path: True)
  with paths_campaign.workplace() as outside, _WATCH.only('.'):
    use = paths_campaign._from_file(
        experiment_specs.load,
        paths_campaign._experiment(
            runs={'one': {'design': str(outside / 'secret.yaml')}}
        ),
    )
    use()
    assert any(paths_campaign.OFF_LIMITS in path for path in _WATCH.opened)


def test_paths_that_are_looked_for_in_one_place_only_are_missed(
    monkeypatch: pytest.MonkeyPatch,
):
  # What the check was once: options of providers, and nothing within them.
  found = annotations.paths_in

  def shallow(*arguments: Any) -> Iterator[Any]:
    return (
        (path, text)
        for path, text in found(*arguments)
        if path[2:] == ('options', 'weights')
    )

  monkeypatch.setattr(annotations, 'paths_in', shallow)
  with paths_campaign.workplace() as outside, file_readers.registered():
    for depth in (1, 3):
      with _WATCH.only('.'):
        paths_campaign._from_file(
            specs.load, paths_campaign._wrapped(depth, f'{outside}/secret.npz')
        )()
        assert any(paths_campaign.OFF_LIMITS in path for path in _WATCH.opened)


def test_a_design_within_the_working_directory_may_be_named(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
  monkeypatch.chdir(tmp_path)
  (tmp_path / 'designs').mkdir()
  text = paths_campaign.yaml.safe_dump(paths_campaign._design(providers=[]))
  (tmp_path / 'designs' / 'mine.yaml').write_text(text, encoding='utf-8')
  for name in ('designs/mine.yaml', str(tmp_path / 'designs' / 'mine.yaml')):
    data = paths_campaign._experiment(runs={'one': {'design': name}})
    loaded = paths_campaign._from_file(experiment_specs.load, data)()
    assert loaded.runs['one'].load(is_confined=True).name == 'd'


def test_weights_that_a_design_names_are_looked_for_within_the_directory(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
  monkeypatch.chdir(tmp_path)
  use = paths_campaign._from_file(
      specs.load, paths_campaign._with_weights('/etc/passwd')
  )
  with pytest.raises(errors.SpecError) as caught:
    use()
  assert (
      'given.yaml: providers[0].options.weights: '
      "'/etc/passwd' is outside the working directory"
  ) in str(caught.value)
  # In a call of their own, users name what they like.
  with pytest.raises(errors.SpecError, match='not a network'):
    specs.load(paths_campaign._with_weights('/etc/passwd'))


def test_a_forged_done_file_leads_nowhere(tmp_path: pathlib.Path):
  storage.write_done(tmp_path, {'files': {'../x': '0' * 64}})
  with pytest.raises(
      errors.ResultsError, match=r"'\.\./x' is not a file of a run"
  ):
    storage.is_done(tmp_path)


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
  # A box with which a process of its own tests the renderer.
  assert found == {'renderers.py': 'from_xml_string'}
