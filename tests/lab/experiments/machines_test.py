"""Tests of the description of a machine, and of its threads."""

import json
import os

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import threads

# ---- Descriptions -----------------------------------------------------------


def test_the_description_of_a_machine_is_stable_plain_data():
  here = machines.here()
  assert json.loads(json.dumps(here)) == here == machines.here()
  assert here['processor']
  assert here['system'].startswith(('Linux ', 'Darwin '))


@pytest.mark.parametrize('name', ['OPENBLAS_CORETYPE', 'XLA_FLAGS'])
def test_a_variable_that_changes_results_is_described(monkeypatch, name):
  monkeypatch.delenv(name, raising=False)
  before = machines.here()
  monkeypatch.setenv(name, '--something=else')
  assert machines.here() == {**before, name: '--something=else'}


@pytest.mark.parametrize(
    ('text', 'processor'),
    [
        ('processor : 0\nmodel name\t: Xeon 3\nflags : a b\n', 'Xeon 3'),
        ('CPU implementer : 0x41\nCPU part\t: 0xd0c\n', '0xd0c'),
        (None, 'fallback'),
    ],
)
def test_the_processor_is_named(tmp_path, monkeypatch, text, processor):
  path = tmp_path / 'cpuinfo'
  if text is not None:
    path.write_text(text)
  monkeypatch.setattr(machines, '_CPU_INFO', path)
  monkeypatch.setattr(machines.platform, 'processor', lambda: 'fallback')
  assert machines.here()['processor'] == processor


def test_what_jax_compiles_is_kept_for_each_machine(tmp_path, monkeypatch):
  folders = []
  for name in ('one', 'two'):
    monkeypatch.setattr(machines.platform, 'node', lambda name=name: name)
    monkeypatch.setattr(os, 'environ', {})
    for _ in range(2):
      machines.keep_compiled(tmp_path)
    folders.append(os.environ['JAX_COMPILATION_CACHE_DIR'])
  assert {os.path.dirname(one) for one in folders} == {f'{tmp_path}/compiled'}
  assert len({*folders}) == 2
  monkeypatch.setattr(os, 'environ', {'JAX_COMPILATION_CACHE_DIR': 'mine'})
  machines.keep_compiled(tmp_path)
  assert os.environ == {'JAX_COMPILATION_CACHE_DIR': 'mine'}


# ---- Threads ----------------------------------------------------------------


@pytest.mark.parametrize('given', ['', '--a=1   --b=2'])
def test_xla_flags_are_kept_and_one_thread_is_added(monkeypatch, given):
  monkeypatch.setattr(os, 'environ', {'XLA_FLAGS': given})
  for _ in range(2):  # A sweep does it, and then each of its runs.
    threads.use_one()
    assert os.environ['XLA_FLAGS'].split() == [
        *given.split(), '--xla_cpu_multi_thread_eigen=false',
    ]  # fmt: skip
    assert threads.xla_flags() == given.split()
  monkeypatch.setattr(os, 'environ', {'XLA_FLAGS': '--a=1 b=1'})
  with pytest.raises(errors.SpecError, match="XLA_FLAGS: 'b=1'"):
    threads.use_one()
