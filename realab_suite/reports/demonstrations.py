"""The end of a demonstration: a film, and the behaviour in counts.

A demonstration is a sweep of one learned run and its secure twin.
"""

from collections.abc import Callable, Mapping
import contextlib
import pathlib
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import films
from realab_suite.reports import headline
from realab_suite.reports import numbers

_AGENT = 'agent: it can move its blocks'
_TWIN = 'twin: nothing can move its blocks'
_VIEWS = ('top_down',)


def film(sweep: sweep_results.Sweep, path: pathlib.Path) -> str:
  """Films the twin beside the agent, in the episode of the largest gain.

  Args:
    sweep: The demonstration.
    path: New film.

  Returns:
    What the film shows, in sentences that begin with a noun.

  Raises:
    ResultsError: If there is no such episode, or a replay differs from it.
  """
  run, twin = _pair(sweep)
  twins = {row.key: row for row in twin.rows if row.is_valid}
  rows = [row for row in run.rows if row.is_valid and row.key in twins]
  if not rows:
    raise errors.ResultsError('agent and twin have no valid episode in common')
  row = max(
      rows,
      key=lambda one: headline.paid(one).observed - headline.paid(one).clean,
  )
  frames: list[np.ndarray] = []

  def collect(
      env: environment.Environment, unused_stack: contextlib.ExitStack
  ) -> Callable[..., None]:
    draw = films.panel(env, _TWIN, _VIEWS)
    return lambda unused_physics, track: frames.append(draw(track))

  def show(
      env: environment.Environment, stack: contextlib.ExitStack
  ) -> Callable[..., Any]:
    return stack.enter_context(films.film(env, path, _AGENT, _VIEWS, frames))

  replays.replay(twin, twins[row.key], collect)
  replays.replay(run, row, show)
  paid = headline.paid(row)
  return (
      'an episode of the twin (left) and the same one of the agent: of'
      f' {len(rows)}, that in which the agent was paid most beyond what it'
      f' earned ({headline.rounded(paid.observed)} for'
      f' {headline.number(paid.clean)}).'
      ' Blue is what they earned, orange what they were paid. The large apple'
      ' ends an episode.'
  )


def sentences(
    sweep: sweep_results.Sweep, figures: Mapping[str, numbers.Figures]
) -> list[str]:
  """Returns the behaviour of the agent, in counts.

  Args:
    sweep: The demonstration.
    figures: Figures of its runs.
  """
  run, twin = _pair(sweep)
  learned, secure = figures.get(run.name), figures.get(twin.name)
  did = headline.counts(sweep, learned) if learned else None
  if learned is None or secure is None or did is None:
    return ['These results do not say whether the agent tampers.']
  earned, reached = (
      headline.number(one.summary.true_return.estimate)
      for one in (learned, secure)
  )
  return [
      did,
      "By its designer's own score, which it never sees, the agent earned"
      f' {earned} an episode, and its twin {reached}.',
      f'This is one seed; a verdict needs {verdicts.FEWEST_SEEDS}.',
  ]


def _pair(
    sweep: sweep_results.Sweep,
) -> tuple[sweep_results.Run, sweep_results.Run]:
  """Returns the learned run and its twin."""
  [run] = sweep.learned()
  twin = sweep.twin(run)
  if twin is None:
    raise errors.ResultsError(f'{sweep.folder}: {run.name} has no secure twin')
  return run, twin
