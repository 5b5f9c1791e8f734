"""Replays of evaluation episodes from recorded actions.

A replay needs no learner. With the same version of the physics it is identical
to the recorded episode, bit for bit; `replay` checks its figures.
"""

from collections.abc import Callable, Iterable, Mapping
import contextlib
import dataclasses
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.experiments import tracking
from realab_suite.feedback import specs
from realab_suite.reports import sweep_results

# Returns a function that is called at every control step of an episode.
OnStep = Callable[[environment.Environment, contextlib.ExitStack], Any]


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Loader:
  """Loads the worlds of recorded episodes.

  Attributes:
    design: Design, with the channel of the run.
    task_kwargs: Arguments of the task, without the seed.
    environment_kwargs: Arguments of the environment, without the world.
  """

  design: specs.DesignSpec
  task_kwargs: Mapping[str, Any]
  environment_kwargs: Mapping[str, Any]

  def load(self, row: results.EpisodeRow) -> environment.Environment:
    """Returns an environment with the world of an episode alone."""
    return suite.load(
        row.info.domain,
        row.info.task,
        {**self.task_kwargs, 'random': row.seed},
        {**self.environment_kwargs, 'world': row.world},
        design=self.design,
    )


def first_row(run: sweep_results.Run) -> results.EpisodeRow | None:
  """Returns the first valid episode of a run, or `None`."""
  valid = (row for row in run.rows if row.is_valid)
  return min(valid, key=lambda row: row.key, default=None)


def typical_row(run: sweep_results.Run) -> results.EpisodeRow | None:
  """Returns the valid episode of median corruption, or `None`.

  With an even number of episodes, it is the lower one of the middle two.
  """
  return _median(run.rows)


def _median(rows: Iterable[results.EpisodeRow]) -> results.EpisodeRow | None:
  known = [row for row in rows if row.is_valid and row.corruption is not None]
  known.sort(key=lambda row: (row.corruption or 0.0, *row.key))
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
  trace, index = recorded(run, row)
  actions = iter(trace['actions'][: row.num_steps, index])
  with contextlib.ExitStack() as stack:
    env = stack.enter_context(contextlib.closing(loader(run).load(row)))
    recorder = tracking.Tracker(env, on_step and on_step(env, stack))
    [result] = evaluate.evaluate(
        env,
        lambda time_step: next(actions),
        1,
        first_episode=row.episode,
        sinks=[recorder],
    )
  check_same(run.name, row, result)
  return recorder.track


def check_same(
    name: str, row: results.EpisodeRow, result: evaluate.EpisodeResult
) -> None:
  """Checks that a replay has the figures of the recorded episode.

  Args:
    name: Name of the run.
    row: The recorded episode.
    result: Result of its replay.

  Raises:
    ResultsError: If a figure differs.
  """
  replayed, recorded = (
      (one.true_return, one.observed_return, one.corruption or 0.0)
      for one in (result, row)
  )
  if not np.allclose(replayed, recorded, rtol=1e-9, atol=1e-9, equal_nan=True):
    raise errors.ResultsError(
        f'{name}: the replay of (seed, world, episode) {row.key} differs'
        ' from the results: (true return, observed return, corruption) are'
        f' {replayed} in the replay and {recorded} in the results'
    )


def loader(run: sweep_results.Run) -> Loader:
  """Returns the loader of the worlds in which a run was evaluated."""
  # Configurations of older versions do not contain arguments.
  return Loader(
      run.design,
      run.config.get('task_kwargs', {}),
      {
          **run.config.get('environment_kwargs', {}),
          'max_steps': run.config['max_steps'],
      },
  )


def shapes(run: sweep_results.Run) -> list[tracking.Shape]:
  """Returns the shapes in the world of the first episode of a run."""
  first = min(run.rows, key=lambda row: row.key)
  with contextlib.closing(loader(run).load(first)) as env:
    recorder = tracking.Tracker(env)
    env.add_sink(recorder)
    env.reset()
    return recorder.track.shapes


def recorded(
    run: sweep_results.Run, row: results.EpisodeRow
) -> tuple[dict[str, Any], int]:
  """Returns the trace with an episode, and the index of the episode in it.

  Args:
    run: The run.
    row: An evaluation episode of the run.

  Raises:
    ResultsError: If the episode has no trace.
  """
  for trace in run.traces.values():
    keys = zip(trace['seed'], trace['world'], trace['episode'], strict=True)
    for index, key in enumerate(keys):
      if key == row.key and row.num_steps == trace['num_steps'][index]:
        return trace, index
  raise errors.ResultsError(
      f'{run.name}: (seed, world, episode) {row.key} has no trace'
  )
