"""Benchmarks run and report; how fast things are is not tested here."""

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
from realab_suite import suite
from realab_suite.lab.experiments import requirements


def _assert_lines(out: str, expected: dict[str, str]) -> None:
  """Each figure has a line with its target, and a verdict if it has one."""
  for name, target in expected.items():
    (line,) = (x for x in out.splitlines() if x.startswith(f'{name}  '))
    assert f' {target} ' in line
    judged = {'met', 'missed'} & set(line.split())
    assert bool(judged) == (target != '-')


def test_the_benchmark_of_a_step_prints_a_line_per_figure(
    capsys: pytest.CaptureFixture[str],
) -> None:
  step.main(['--rounds=1'])
  expected = {
      'control step, rays off': '<= 1.3 x raw',
      'control step, rays on': '-',
      'raw control step': '-',
      'control steps, rays off': '-',
  }
  _assert_lines(capsys.readouterr().out, expected)


_FEW_WORLDS = {
    worlds: {'NUM_ENVS': 2},
    batch: {
        '_STEPS': 2, '_STOCK_STEPS': 2,
        '_KINDS': {'free': ('free', False), 'planar, asleep': ('planar', True)},
    },
    batch_growth: {
        '_SIZES': {1: 1, 2: 1}, '_REGISTERS': (1, 2), '_REGISTER_STEPS': 1,
        '_MEMORY_WORLDS': 2,
    },
}  # fmt: skip


@pytest.fixture(name='few_worlds')
def few_worlds_fixture(monkeypatch: pytest.MonkeyPatch) -> None:
  for module, values in _FEW_WORLDS.items():
    for name, value in values.items():
      monkeypatch.setattr(module, name, value)


@pytest.mark.usefixtures('few_worlds')
def test_the_benchmark_of_many_worlds_prints_a_line_per_figure(
    capsys: pytest.CaptureFixture[str],
) -> None:
  batch.main(['--rounds=1'])
  expected = {
      'throughput lost to raw engine': '<= 15 %',
      "a world's step, of a stock step": '<= 6.67 %',
      "a world's reset": '<= 0.2 ms',
      'memory of one of 2 worlds': '<= 1 MiB',
      'steps of 2 worlds': '-',
      'step, registers: 2 planar': '-',
      '2 registers to 1, free': '<= 2 x',
  }
  _assert_lines(capsys.readouterr().out, expected)


def test_the_benchmark_of_clean_contents_prints_a_line_per_figure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  monkeypatch.setattr(clean_contents, '_NUM_ENVS', 2)
  monkeypatch.setattr(clean_contents, '_STEPS', 2)
  clean_contents.main(['--rounds=1'])
  out = capsys.readouterr().out
  expected = {
      'step, reward, one, honest': '<= 1.05 x raw',
      'step, advice, 2, tampering': '<= 1.15 x raw',
  }
  _assert_lines(out, expected)
  calls = {
      line[:34].rstrip(): float(line[34:].split()[0])
      for line in out.splitlines()
      if line.startswith('calls')
  }
  assert [time > 0 for time in calls.values()] == [False, True] * 4


def test_the_benchmark_of_training_prints_a_line_per_figure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  for module in ('jax', 'optax', 'equinox'):
    pytest.importorskip(module, reason=f'{module} is in the extra `agents`')
  monkeypatch.setattr(train, '_PROCESSES', 1)
  monkeypatch.setattr(train, '_WORLDS', 2)
  monkeypatch.setattr(train, '_STEPS', 33)  # One update.
  kinds = {'planar, asleep': ('planar', True)}
  monkeypatch.setattr(train, '_KINDS', kinds)
  train.main(['--rounds=1'])
  figures = {}
  for line in capsys.readouterr().out.splitlines()[2:]:
    figures[line[:34].rstrip()] = line[34:].split()
  assert figures['control steps, planar, asleep'][2:5] == ['>=', '15', '/ms']
  assert figures['control steps, planar, asleep'][6] in ('met', 'missed')
  for kind in kinds:
    for part in ('physics', 'rays', 'network', 'update', 'the rest'):
      assert float(figures[f'  {part}, {kind}'][0]) >= 0
    assert float(figures[f'processor time, {kind}'][0]) >= 0


def test_the_training_benchmark_names_missing_packages(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  monkeypatch.setattr(
      requirements, 'missing', lambda *_, **__: 'jax is missing'
  )
  with pytest.raises(SystemExit) as raised:
    train.main([])
  assert raised.value.code == 2
  assert capsys.readouterr().err == 'error: jax is missing\n'


def test_a_worker_that_fails_ends_the_benchmark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
  monkeypatch.setattr(train, '_PROCESSES', 1)
  monkeypatch.setattr(train, '_KINDS', {'wrong': ('sideways', True)})
  with pytest.raises(EOFError):
    train.main(['--rounds=1'])


@pytest.mark.usefixtures('few_worlds')
@pytest.mark.parametrize(
    ('benchmark', 'differs'), [(batch, 'in qpos'), (step, 'in the final state')]
)
def test_a_raw_engine_that_does_something_else_is_noticed(
    monkeypatch: pytest.MonkeyPatch, benchmark: Any, differs: str
) -> None:
  record = benchmark._record

  def record_carelessly(env: Any, actions: np.ndarray) -> Any:
    raw = record(env, actions)
    writes, _ = raw.steps[-1][1]
    writes[0][1][:] += 1e-12
    return raw

  monkeypatch.setattr(benchmark, '_record', record_carelessly)
  monkeypatch.setattr(batch_growth, 'measure_memory', list)
  with pytest.raises(RuntimeError, match=differs):
    benchmark.main(['--rounds=1'])


def test_an_avatar_that_sees_by_other_means_is_noticed() -> None:
  env = suite.load('unlock_door', 'standard', {'random': 0})
  env.reset()
  blind = step._no_rays(env)
  blind.__enter__()
  with pytest.raises(RuntimeError, match='did not call'):
    blind.__exit__(None, None, None)


def test_a_benchmark_needs_a_round() -> None:
  with pytest.raises(SystemExit):
    step.main(['--rounds=0'])


@pytest.mark.parametrize(
    ('samples', 'ratios', 'target_is_ratio', 'verdict'),
    [
        ([1.0, 1.0, 9.0], [3.0, 3.0, 3.0], False, 'met'),
        ([9.0, 9.0, 1.0], [1.0, 1.0, 1.0], False, 'missed'),
        ([9.0, 9.0, 9.0], [2.0, 2.0, 9.0], True, 'met'),
        ([1.0, 1.0, 1.0], [2.1, 2.1, 1.0], True, 'missed'),
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


@pytest.mark.parametrize(
    ('samples', 'verdict'), [([3.0, 2.0, 1.0], 'met'), ([9, 1, 1], 'missed')]
)
def test_the_target_of_a_rate_is_a_minimum(
    samples: list[float], verdict: str
) -> None:
  figure = timing.Figure('it', np.array(samples), '/s', 2.0)
  assert figure.verdict == verdict
  assert ' >= 2 /s ' in str(figure)


def test_a_stopwatch_attributes_time_to_the_innermost_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
  clock = [0.0]
  monkeypatch.setattr(timing.time, 'perf_counter', lambda: clock[0])
  watch = timing.Stopwatch()

  def work(seconds: float) -> None:
    clock[0] += seconds

  inner = watch.watch('inner', work)

  def outer() -> None:
    work(1.0)
    inner(10.0)
    inner(10.0)
    work(2.0)

  watch.watch('outer', outer)()
  assert watch.seconds == {'inner': 20.0, 'outer': 3.0}
  assert watch.calls == {'inner': 2, 'outer': 1}
