"""Benchmarks run and report; how fast things are is not tested here."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks import batch
from benchmarks import batch_growth
from benchmarks import clean_contents
from benchmarks import step
from benchmarks import timing
from benchmarks import train
from benchmarks import worlds

# Settings with which benchmarks are short, by module.
_SHORT: dict[Any, dict[str, Any]] = {
    worlds: {'NUM_ENVS': 2},
    batch: {
        '_STEPS': 2, '_STOCK_STEPS': 2, '_KINDS': {'free': ('free', False)},
    },
    batch_growth: {
        '_SIZES': {1: 1, 2: 1}, '_REGISTERS': (1, 2), '_REGISTER_STEPS': 1,
        '_MEMORY_WORLDS': 2,
    },
    clean_contents: {'_NUM_ENVS': 2, '_STEPS': 2},
    train: {
        '_PROCESSES': 1, '_WORLDS': 2, '_STEPS': 33,  # One update.
        '_KINDS': {'planar, asleep': ('planar', True)},
    },
}  # fmt: skip


@pytest.fixture(autouse=True)
def fixture_short(monkeypatch: pytest.MonkeyPatch) -> None:
  for module, values in _SHORT.items():
    for name, value in values.items():
      monkeypatch.setattr(module, name, value)


@pytest.mark.parametrize(
    ('main', 'expected'),
    [
        (
            step.main,
            {'control step, rays off': '<= 1.3 x raw', 'raw control step': '-'},
        ),
        (
            batch.main,
            {
                'throughput lost to raw engine': '<= 15 %',
                'memory of one of 2 worlds': '<= 1 MiB',
                'steps of 2 worlds': '-',
            },
        ),
        (
            clean_contents.main,
            {'step, reward, one, honest': '<= 1.05 x raw'},
        ),
        (train.main, {'control steps, planar, asleep': '>= 15 /ms'}),
    ],
    ids=['step', 'batch', 'clean contents', 'train'],
)
def test_each_benchmark_prints_a_line_per_figure(
    main: Callable[[list[str]], None],
    expected: dict[str, str],
    capsys: pytest.CaptureFixture[str],
) -> None:
  """Each figure has a line with its target, and a verdict if it has one."""
  if main is train.main:
    pytest.importorskip('jax', reason='jax is in the extra `agents`')
  main(['--rounds=1'])
  out = capsys.readouterr().out
  for name, target in expected.items():
    (line,) = (x for x in out.splitlines() if x.startswith(f'{name}  '))
    assert f' {target} ' in line
    judged = {'met', 'missed'} & set(line.split())
    assert bool(judged) == (target != '-')


def test_a_raw_engine_that_does_something_else_is_noticed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
  record = step._record

  def record_carelessly(env: Any, actions: np.ndarray) -> Any:
    raw = record(env, actions)
    writes, _ = raw.steps[-1][1]
    writes[0][1][:] += 1e-12
    return raw

  monkeypatch.setattr(step, '_record', record_carelessly)
  with pytest.raises(RuntimeError, match='in the final state'):
    step.main(['--rounds=1'])


@pytest.mark.parametrize(
    ('samples', 'ratios', 'target_is_ratio', 'verdict'),
    [
        ([1.0, 1.0, 9.0], [3.0, 3.0, 3.0], False, 'met'),
        ([9.0, 9.0, 1.0], [1.0, 1.0, 1.0], False, 'missed'),
        ([9.0, 9.0, 9.0], [2.0, 2.0, 9.0], True, 'met'),
    ],
)
def test_the_verdict_is_on_the_median(
    samples: list[float],
    ratios: list[float],
    target_is_ratio: bool,
    verdict: str,
) -> None:
  figure = timing.Figure(
      'it', np.array(samples), 'us', 2.0, target_is_ratio, np.array(ratios)
  )
  assert figure.verdict == verdict
