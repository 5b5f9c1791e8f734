"""Replays of evaluation episodes from recorded actions.

A replay needs no learner. With the same version of the physics it is identical
to the recorded episode, bit for bit; `replay` checks its figures.
"""

from collections.abc import Callable
import contextlib
import math
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.experiments import tracking
from realab_suite.reports import sweep_results

# Returns a function that is called at every control step of an episode.
OnStep = Callable[[environment.Environment, contextlib.ExitStack], Any]


def first_row(run: sweep_results.Run) -> results.EpisodeRow | None:
  """Returns the first valid episode of a run, or `None`."""
  valid = (row for row in run.rows if row.is_valid)
  return min(valid, key=_key, default=None)


def typical_row(run: sweep_results.Run) -> results.EpisodeRow | None:
  """Returns the valid episode of median corruption, or `None`.

  With an even number of episodes, it is the lower one of the middle two.
  """
  known = [
      row for row in run.rows if row.is_valid and not math.isnan(row.corruption)
  ]
  known.sort(key=lambda row: (row.corruption, *_key(row)))
  return known[(len(known) - 1) // 2] if known else None


def replay(
    run: sweep_results.Run,
    row: results.EpisodeRow,
    on_step: OnStep | None = None,
) -> tracking.Track:
  """Replays an episode.

  Args:
    run: The run.
    row: An evaluation episode of the run.
    on_step: Returns a function that is called with the physics and the track,
      at the start of the episode and after every control step.

  Returns:
    The track of the episode.

  Raises:
    ResultsError: If the episode has no trace, or the replay differs, for
      example because the version of the physics does.
  """
  actions = iter(_actions(run, row))
  with contextlib.ExitStack() as stack:
    env = stack.enter_context(contextlib.closing(load(run, row)))
    recorder = tracking.Tracker(env, on_step and on_step(env, stack))
    [result] = evaluate.evaluate(
        env,
        lambda time_step: next(actions),
        1,
        first_episode=row.episode,
        sinks=[recorder],
    )
  replayed = (result.true_return, result.observed_return, result.corruption)
  recorded = (row.true_return, row.observed_return, row.corruption)
  if not np.allclose(replayed, recorded, rtol=1e-9, atol=1e-9, equal_nan=True):
    raise errors.ResultsError(
        f'{run.name}: the replay of (seed, world, episode) {_key(row)} differs'
        ' from the results: (true return, observed return, corruption) are'
        f' {replayed} in the replay and {recorded} in the results'
    )
  return recorder.track


def load(
    run: sweep_results.Run, row: results.EpisodeRow
) -> environment.Environment:
  """Returns an environment with the world of an episode alone."""
  return suite.load(
      row.info.domain,
      row.info.task,
      # Configurations of older versions do not contain arguments.
      {**run.config.get('task_kwargs', {}), 'random': row.seed},
      {
          **run.config.get('environment_kwargs', {}),
          'max_steps': row.info.max_steps,
          'world': row.world,
      },
      design=run.design,
  )


def shapes(run: sweep_results.Run) -> list[tracking.Shape]:
  """Returns the shapes in the world of the first episode of a run."""
  with contextlib.closing(load(run, min(run.rows, key=_key))) as env:
    recorder = tracking.Tracker(env)
    env.add_sink(recorder)
    env.reset()
    return recorder.track.shapes


def _actions(
    run: sweep_results.Run, row: results.EpisodeRow
) -> list[np.ndarray]:
  """Returns the actions of an episode."""
  for trace in run.traces.values():
    keys = zip(trace['seed'], trace['world'], trace['episode'], strict=True)
    for index, key in enumerate(keys):
      if key != _key(row):
        continue
      actions = trace['actions'][: trace['num_steps'][index], index]
      if len(actions) == row.num_steps:
        return list(actions)
  raise errors.ResultsError(
      f'{run.name}: (seed, world, episode) {_key(row)} has no trace'
  )


def _key(row: results.EpisodeRow) -> tuple[int, int, int]:
  return row.seed, row.world, row.episode
