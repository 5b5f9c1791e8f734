"""Campaign C20 in small, and that it can fail."""

from collections.abc import Iterator
import contextlib
import copy
import itertools
import os
import pathlib
import threading
from typing import Any

import pytest
import yaml

from campaigns import spec_fuzz_campaign
from realab_suite import errors
from realab_suite.experiments import experiment_specs
from realab_suite.feedback import specs

_CONFIGS = pathlib.Path(__file__).parents[2] / 'configs'


def test_whatever_a_design_or_an_experiment_says_it_runs_or_is_refused():
  judged = list(spec_fuzz_campaign.campaign(500, 50, 10, seed=1, num_workers=1))
  assert not [(o.problem, case) for case, o in judged if o.problem]
  outcomes = [outcome for _, outcome in judged]
  assert (
      max(outcome.calls for outcome in outcomes) <= spec_fuzz_campaign.MAX_CALLS
  )
  assert (
      max(outcome.grown for outcome in outcomes) <= spec_fuzz_campaign.MAX_BYTES
  )
  for stage, number in (('validate', 500), ('compile', 50), ('step', 10)):
    of_stage = [o for o in outcomes if o.stage == stage]
    assert len(of_stage) == number
    assert any(not o.refusal for o in of_stage)
    assert stage == 'step' or any(o.refusal for o in of_stage)
  kinds = {(case.kind, isinstance(case.source, bytes)) for case, _ in judged}
  assert len(kinds) == 4


# Values that no spec holds, and how a message shows them.
_STRANGE = {
    'zzq': "'zzq'", -7.25: '-7.25', 987654: '987654', True: 'True',
    ('zzq',): "['zzq']",
}  # fmt: skip


@pytest.mark.parametrize(
    ('kind', 'load'),
    [('designs', specs.load), ('experiments', experiment_specs.load)],
)
def test_a_refusal_names_the_key_and_the_value(kind: str, load: Any):
  strange = itertools.cycle(_STRANGE.items())
  num_refused = 0
  for path in sorted((_CONFIGS / kind).glob('*.yaml')):
    data = yaml.safe_load(path.read_text())
    for keys in _leaves(data):
      value, shown = next(strange)
      changed = copy.deepcopy(data)
      node = changed
      for key in keys[:-1]:
        node = node[key]
      node[keys[-1]] = list(value) if isinstance(value, tuple) else value
      refusal = _refusal(load, changed)
      if not refusal:
        continue
      num_refused += 1
      assert shown in refusal, (path.name, keys)
      owner = [key for key in keys if isinstance(key, str)][-1]
      # An override is named by what it says.
      if owner != 'overrides':
        assert owner in refusal, (path.name, keys)
  assert num_refused >= 80


def _refusal(load: Any, source: Any) -> str:
  """Returns with which words something is refused, or ''."""
  try:
    load(source)
  except errors.SpecError as error:
    return str(error)
  return ''


def _leaves(node: Any) -> Iterator[tuple[Any, ...]]:
  """Yields the keys that lead to each value of a spec."""
  for key in node if isinstance(node, dict) else range(len(node)):
    if isinstance(node[key], dict | list) and node[key]:
      yield from ((key, *keys) for keys in _leaves(node[key]))
    else:
      yield (key,)


def _answer(connection: Any) -> None:
  """Does to a child what the seed of its case says."""
  while (job := connection.recv()) is not None:
    case, stage = job
    if case.seed == 1:
      os._exit(11)
    if case.seed == 2:
      threading.Event().wait()
    connection.send(spec_fuzz_campaign.Outcome(stage, '', ''))


def test_a_child_that_dies_or_hangs_is_a_bad_outcome_and_is_replaced():
  case = spec_fuzz_campaign.Case('design', {}, ('unlock_door', 'near'), 0)
  with contextlib.closing(spec_fuzz_campaign.Child(_answer)) as child:
    assert not child.judge(case, 'compile').problem
    found = child.judge(case._replace(seed=1), 'compile')
    assert found.problem == 'the process died'
    assert not child.judge(case, 'compile').problem
    child._patience = 0.5
    assert 'no answer' in child.judge(case._replace(seed=2), 'compile').problem


def _judged(error: Exception, monkeypatch: Any, folder: pathlib.Path) -> str:
  def load(*unused: Any) -> Any:
    raise error

  monkeypatch.setattr(specs, 'load', load)
  case = spec_fuzz_campaign.Case('design', b'a: 1', ('unlock_door', 'near'), 0)
  return spec_fuzz_campaign.judge(case, 'validate', folder).problem


def test_other_errors_and_unclear_ones_are_bad_outcomes(tmp_path, monkeypatch):
  for error, problem in (
      (OverflowError('x'), 'OverflowError: x'),
      (MemoryError(), 'MemoryError: '),
      (errors.SpecError('two\nlines'), 'not one line'),
      (errors.SpecError('bad'), 'names no file'),
      (errors.SpecError('given.yaml: it is bad'), 'names no place'),
      (errors.SpecError('given.yaml: range: must be finite'), ''),
  ):
    found = _judged(error, monkeypatch, tmp_path)
    assert found.startswith(problem) if problem else not found


def test_memory_that_a_case_takes_is_measured(tmp_path, monkeypatch):
  def load(*unused: Any) -> Any:
    return bytearray(700 * 2**20)

  monkeypatch.setattr(specs, 'load', load)
  case = spec_fuzz_campaign.Case('design', {}, ('unlock_door', 'near'), 0)
  assert spec_fuzz_campaign.judge(case, 'validate', tmp_path).grown > 0
