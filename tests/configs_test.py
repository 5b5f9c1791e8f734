"""Tests for the designs that ship: they fit the worlds, and run."""

import pathlib

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.config import loading
from realab_suite.feedback import specs
from tests.engine import helpers

_FOLDER = pathlib.Path(__file__).parents[1] / 'configs' / 'designs'
_FILES = sorted(_FOLDER.iterdir())
_DESIGN_FILES = [path for path in _FILES if path.suffix == '.yaml']


def _ids(paths: list[pathlib.Path]) -> list[str]:
  return [path.stem for path in paths]


_every_file = pytest.mark.parametrize(
    'path', _DESIGN_FILES, ids=_ids(_DESIGN_FILES)
)


def test_every_file_is_a_design_that_can_be_loaded_by_name():
  assert specs.DESIGNS == tuple(_ids(_DESIGN_FILES))
  assert len(_DESIGN_FILES) >= 5


@_every_file
def test_a_design_has_the_name_of_its_file_and_is_described(path: pathlib.Path):
  design = specs.load(path)
  assert design.name == path.stem
  assert design.description.endswith('.')
  assert path.read_text(encoding='utf-8').startswith('# ')


def test_no_two_designs_are_the_same():
  def content(path: pathlib.Path) -> str:
    mapping = {**specs.load(path).to_mapping(), 'name': '', 'description': ''}
    return repr(sorted(mapping.items()))

  assert len({content(path) for path in _DESIGN_FILES}) == len(_DESIGN_FILES)


@_every_file
def test_nothing_in_a_design_is_without_use(path: pathlib.Path):
  design = specs.load(path)
  for name, register in design.registers.items():
    own = set(design.ports_by_register[name])
    read = [own <= {*provider.reads} for provider in design.providers]
    written = [own <= {*provider.writes} for provider in design.providers]
    if register.role == 'meter':
      assert own <= {meter.writes for meter in design.meters}
    if register.role in ('meter', 'query', 'memory'):
      assert any(read)
    elif register.role == 'signal':
      assert any(written)
      is_read = name in loading.texts_in(design.learner.model_extra)
      assert is_read or register.ends_episode is not None
    else:
      assert any(written)
      assert name in loading.texts_in(design.learner.model_extra)


@_every_file
def test_applied_values_can_be_read_without_an_agent(path: pathlib.Path):
  # With a still agent no register is corrupted, whatever the design writes.
  world = 'collect_apples', 'far'
  if path.stem in suite.TASKS_BY_DOMAIN:
    world = path.stem, suite.TASKS_BY_DOMAIN[path.stem][0]
  env = suite.load(*world, {'random': 2}, {'max_steps': 20}, design=path)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  ports = env.mechanism.ports
  applied = {name: one.applied(env.physics) for name, one in ports.items()}
  for _ in range(20):
    env.step(helpers.no_op(env))
  for step in sink.steps:
    for record in step.records:
      if hasattr(record, 'applied'):
        applied[record.register] = record.applied
      else:
        expected = applied[record.register]
        np.testing.assert_allclose(record.reading, expected, atol=1e-9)
