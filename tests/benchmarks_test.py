"""Benchmarks run and report; how fast things are is not tested here."""

import re

import pytest

from benchmarks import batch
from benchmarks import clean_contents
from benchmarks import step
from benchmarks import worlds


@pytest.mark.parametrize(
    ('module', 'short', 'line'),
    [
        (step, {}, 'control step, rays off .* <= 1.3 x raw .*(met|missed)'),
        (
            batch,
            {
                '_STEPS': 2,
                '_STOCK_STEPS': 2,
                '_KINDS': {'free': ('free', False)},
            },
            'throughput lost to raw engine .* <= 15 % .*(met|missed)',
        ),
        (
            clean_contents,
            {'_NUM_ENVS': 2, '_STEPS': 2},
            'step, reward, one, honest .* <= 1.05 x raw .*(met|missed)',
        ),
    ],
    ids=['step', 'batch', 'clean contents'],
)
def test_a_benchmark_judges_its_figures(
    module, short, line, monkeypatch, capsys
):
  monkeypatch.setattr(worlds, 'NUM_ENVS', 2)
  for name, value in short.items():
    monkeypatch.setattr(module, name, value)
  module.main(['--rounds=1'])
  assert re.search(line, capsys.readouterr().out)
