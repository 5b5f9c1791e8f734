"""Timing of contestants in turns, and the report of the results."""

import argparse
from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
import functools
import os
import time
from typing import Any, final
from unittest import mock

import mujoco
import numpy as np

from realab_suite.engine import arguments

Contestant = Callable[[], float]
"""Function that does one round of work and returns the seconds per unit."""


def time_rounds(
    contestants: Mapping[str, Contestant], rounds: int
) -> dict[str, np.ndarray]:
  """Times contestants in turns, so that other loads affect all of them alike.

  Args:
    contestants: Functions to time, by name.
    rounds: Number of rounds, after one round that does not count.

  Returns:
    Seconds per unit of work of each contestant, `(rounds,)`.
  """
  samples: dict[str, list[float]] = {name: [] for name in contestants}
  for i in range(rounds + 1):
    for name, contestant in contestants.items():
      seconds = contestant()
      if i:
        samples[name].append(seconds)
  return {name: np.array(taken) for name, taken in samples.items()}


@final
class Stopwatch:
  """Measures the time of functions, without the time of those they call.

  The time of a timed function that another one calls counts only for itself.

  Attributes:
    seconds: Time in each function itself, by label.
    calls: Number of calls of each function, by label.
  """

  def __init__(self, clock: Callable[[], float] | None = None) -> None:
    """Initializes the stopwatch.

    Args:
      clock: Function that returns the time in seconds; `None` for wall time.
    """
    self._clock = clock or time.perf_counter
    self.seconds: dict[str, float] = {}
    self.calls: dict[str, int] = {}
    self._running: list[str] = []
    self._since = 0.0

  def watch(self, label: str, function: Callable[..., Any]) -> Any:
    """Returns a function that calls `function` and times it as `label`."""
    self.seconds.setdefault(label, 0.0)
    self.calls.setdefault(label, 0)

    @functools.wraps(function)
    def watched(*args: Any, **kwargs: Any) -> Any:
      self._add_elapsed()
      self.calls[label] += 1
      self._running.append(label)
      try:
        return function(*args, **kwargs)
      finally:
        self._add_elapsed()
        self._running.pop()

    return watched

  def _add_elapsed(self) -> None:
    """Adds the time since the last call to the innermost running function."""
    now = self._clock()
    if self._running:
      self.seconds[self._running[-1]] += now - self._since
    self._since = now


def split(
    parts: Sequence[tuple[str, Any, str]],
    work: Callable[[], object],
    clock: Callable[[], float] | None = None,
) -> dict[str, tuple[float, int]]:
  """Returns the seconds and the number of calls of each part, by label.

  Args:
    parts: Label, owner and name of each method.
    work: Function to time.
    clock: Function that returns the time in seconds; `None` for wall time.
  """
  watch = Stopwatch(clock)
  with contextlib.ExitStack() as stack:
    for label, owner, name in parts:
      timed = watch.watch(label, getattr(owner, name))
      stack.enter_context(mock.patch.object(owner, name, timed))
    work()
  return {label: (s, watch.calls[label]) for label, s in watch.seconds.items()}


@final
@dataclasses.dataclass(frozen=True)
class Figure:
  """One line of a report.

  Attributes:
    name: Name of the measured quantity.
    samples: One value per round, or a single value.
    unit: Unit of the values.
    target: Largest allowed value, or for a rate the smallest; `None` for no
      target.
    target_is_ratio: True if `target` applies to `ratios` instead of `samples`.
    ratios: Ratio to the raw engine in each round, or `None`.
  """

  name: str
  samples: np.ndarray
  unit: str
  target: float | None = None
  target_is_ratio: bool = False
  ratios: np.ndarray | None = None

  @property
  def verdict(self) -> str:
    """`met` or `missed`; `-` without a target."""
    if self.target is None:
      return '-'
    judged = self.ratios if self.target_is_ratio else self.samples
    median = np.median(judged)
    is_met = (
        median >= self.target if self._is_at_least else median <= self.target
    )
    return 'met' if is_met else 'missed'

  def __str__(self) -> str:
    target = '-'
    if self.target is not None:
      unit = 'x raw' if self.target_is_ratio else self.unit
      sign = '>=' if self._is_at_least else '<='
      target = f'{sign} {self.target:g} {unit}'
    ratio = '-' if self.ratios is None else f'{np.median(self.ratios):.2f} x'
    return _columns(
        self.name,
        f'{np.median(self.samples):.4g} {self.unit}',
        target,
        ratio,
        self.verdict,
        f'{self._best:.4g}',
        _quartiles(self.samples, '{:.4g}'),
        *self._quiet_ratio(),
    )

  @property
  def _best(self) -> float:
    """Value of the least disturbed round."""
    return float(self.samples.max() if self._is_rate else self.samples.min())

  @property
  def _is_rate(self) -> bool:
    return self.unit.startswith('/')

  @property
  def _is_at_least(self) -> bool:
    return self._is_rate and not self.target_is_ratio

  def _quiet_ratio(self) -> tuple[str, str]:
    """Returns the ratio of the best values, and the quartiles of all ratios."""
    if self.ratios is None:
      return '-', '-'
    raw = self.samples / self.ratios
    best = self._best / raw.min()
    return f'{best:.2f} x', _quartiles(self.ratios, '{:.2f}')


def report(figures: Sequence[Figure]) -> None:
  """Prints one line per figure."""
  print(
      f'mujoco {mujoco.__version__}, {arguments.processors()} cores, load'
      f' {os.getloadavg()[0]:.1f}; medians of {len(figures[0].samples)} rounds;'
      ' best: the least disturbed round; 25-75 %: quartiles'
  )
  print(
      _columns(
          'name', 'figure', 'target', 'to raw', 'verdict', 'best', '25-75 %',
          'best/best', 'ratio 25-75 %',
      )
  )  # fmt: skip
  for figure in figures:
    print(figure)


def parse_rounds(
    description: str | None, arguments: Sequence[str] | None, default: int
) -> int:
  """Returns the number of rounds from the command line."""
  parser = argparse.ArgumentParser(description=description, allow_abbrev=False)
  parser.add_argument(
      '--rounds', type=int, default=default, help='number of rounds'
  )
  rounds = parser.parse_args(arguments).rounds
  if rounds < 1:
    parser.error(f'--rounds={rounds}; must be positive integers')
  return rounds


def _columns(*cells: str) -> str:
  widths = (34, 13, 14, 9, 9, 10, 20, 11, 0)
  return ''.join(
      f'{cell:<{width}}' for cell, width in zip(cells, widths, strict=True)
  ).rstrip()


def _quartiles(samples: np.ndarray, style: str) -> str:
  if len(samples) == 1:
    return '-'
  low, high = np.quantile(samples, (0.25, 0.75))
  return f'{style.format(low)} to {style.format(high)}'
