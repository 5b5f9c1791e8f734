"""Replays of evaluation episodes from recorded actions.

A replay needs no learner. With the same version of the physics it is identical
to the recorded episode, bit for bit; `play` checks its figures.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from typing import Any, NamedTuple, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import worlds
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import tables
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import study

# Returns a function that is called at every control step of an episode.
OnStep = Callable[[environment.Environment, contextlib.ExitStack], Any]


@final
class Recorded(NamedTuple):
  """An episode whose actions are known.

  Attributes:
    row: Its result.
    design: Design, with the channel of the run.
    world: World of the run.
    is_learned: True if a learner chose the actions, False for a scripted
      policy.
    trace: Trace that contains it; see `traces`.
    position: Index of the episode in the trace.
  """

  row: results.EpisodeResult
  design: specs.DesignSpec
  world: worlds.World
  is_learned: bool
  trace: Mapping[str, Any]
  position: int

  @property
  def actions(self) -> Any:
    """Actions, `(steps, *action_spec.shape)`."""
    num_steps = self.trace['num_steps'][self.position]
    return self.trace['actions'][:num_steps, self.position]

  def load(self) -> environment.Environment:
    """Returns an environment with the world of the episode alone."""
    return self.world.load(self.design, self.row.seed, self.row.world)


def typical_row(run: study.Run) -> results.EpisodeResult | None:
  """Returns the valid episode of median corruption, or `None`.

  With an even number of episodes, it is the lower one of the middle two. An
  episode in which no register was read counts as one without corruption.
  """
  valid = [row for row in run.rows if row.is_valid]
  valid.sort(key=lambda row: (row.corruption or 0.0, *row.key))
  return valid[(len(valid) - 1) // 2] if valid else None


def words(row: results.EpisodeResult) -> str:
  """Returns the numbers and the figures of an episode as text."""
  return (
      f'seed {row.seed}, world {row.world}, episode {row.episode}:'
      f' true return {tables.text(row.true_return)}, observed'
      f' {tables.text(row.observed_return)}, corruption'
      f' {tables.text(row.corruption)} m'
  )


def replay(
    run: study.Run,
    row: results.EpisodeResult,
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
  episode = recorded(run, row)
  with contextlib.ExitStack() as stack:
    env = stack.enter_context(contextlib.closing(episode.load()))
    recorder = tracking.Tracker(env, on_step and on_step(env, stack))
    play(env, episode, [recorder])
  return recorder.track


def play(
    env: environment.Environment,
    one: Recorded,
    sinks: Sequence[events.EventSink],
) -> list[dm_env.TimeStep]:
  """Plays an episode again, through the view that agents get.

  Args:
    env: Environment with the world of the episode.
    one: The episode.
    sinks: Event sinks of the environment while it is played.

  Returns:
    The time steps of the agent.

  Raises:
    ResultsError: If its length or a figure differs from the recorded one, for
      example because the version of the physics does.
  """
  row = one.row
  differs = (
      f'{row.info.run}: the replay of (seed, world, episode) {row.key} differs'
  )
  view = agent_view.AgentView(env)
  time_steps: list[dm_env.TimeStep] = []

  def act(unused_episode: int) -> Iterator[None]:
    time_steps.append(view.reset())
    for action in one.actions:
      if time_steps[-1].last():
        break
      time_steps.append(view.step(action))
      yield
    num_steps = len(time_steps) - 1
    if not time_steps[-1].last() or num_steps != len(one.actions):
      raise errors.ResultsError(
          f'{differs} from its trace: it has {num_steps} control steps; allowed'
          f' are {len(one.actions)}, as with the same version of the physics'
      )

  [result] = evaluate.results_of(
      env, act, 1, first_episode=row.episode, sinks=sinks
  )
  replayed, expected = (
      (each.true_return, each.observed_return, each.corruption or 0.0)
      for each in (result, row)
  )
  if not np.allclose(replayed, expected, rtol=1e-9, atol=1e-9, equal_nan=True):
    raise errors.ResultsError(
        f'{differs} from the results: (true return, observed return,'
        f' corruption) are {replayed} in the replay and {expected} in the'
        ' results'
    )
  return time_steps


def recorded(run: study.Run, row: results.EpisodeResult) -> Recorded:
  """Returns an episode with its actions.

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
        learned = run.is_learned
        return Recorded(row, run.design, run.world, learned, trace, index)
  raise errors.ResultsError(
      f'{run.name}: (seed, world, episode) {row.key} has no trace'
  )
