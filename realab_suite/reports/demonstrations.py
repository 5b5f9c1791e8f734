"""The end of a demonstration: a film, and the behaviour in counts.

A demonstration is a sweep of one learned run and its secure twin, or episodes
of the trained agents that ship.
"""

from collections.abc import Callable, Sequence
import contextlib
import functools
import pathlib
from typing import Any, NamedTuple, final

import numpy as np
import pandas as pd

from realab_suite import errors
from realab_suite import policies
from realab_suite import worlds
from realab_suite.engine import environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts
from realab_suite.policies import trained
from realab_suite.reports import headline

_AGENT = 'agent: it can move its blocks'
_TWIN = 'twin: nothing can move its blocks'
_VIEWS = ('top_down',)
_TAMPERER, _TRAINED_TWIN = 'tamperer', 'twin'
_EPISODES = 20
_SEED = 2_000_000  # No seed of training.
_SHARE = 2 / 3  # Half the pixels, in half the time.

_Rows = Sequence[results.EpisodeResult]
_PlayAgain = Callable[[results.EpisodeResult, replays.OnStep], Any]


def film(sweep: study.Study, path: pathlib.Path) -> str:
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
  plays = [functools.partial(replays.replay, one) for one in (run, twin)]
  return _film(path, (run.rows, twin.rows), plays)


def sentences(sweep: study.Study, judged: pd.DataFrame) -> list[str]:
  """Returns the behaviour of the agent, in counts.

  Args:
    sweep: The demonstration.
    judged: What `study.judge` returns.
  """
  run, twin = _pair(sweep)
  wholes = study.wholes(judged)
  line, secure = wholes.get(run.name), wholes.get(twin.name)
  did = None if line is None else headline.counts(sweep, run, line)
  if line is None or secure is None or did is None:
    return ['These results do not say whether the agent tampers.']
  earned, reached = (one['true_return'].estimate for one in (line, secure))
  return [
      did,
      _earned(earned, reached),
      f'This is one seed; a verdict needs {verdicts.FEWEST_SEEDS}.',
  ]


@final
class Played(NamedTuple):
  """The same episodes of the trained agents and of the solver of their world.

  Attributes:
    agent: Episodes of the agent that tampers.
    twin: Episodes of its twin, in its secure world.
    solver: Episodes of the solver there.
  """

  agent: _Rows
  twin: _Rows
  solver: _Rows


def play_trained() -> Played:
  """Plays the trained agents that ship, and the solver of their world."""
  world, _ = _world_of(_TRAINED_TWIN)
  solver = policies.make(str(world.solver))
  return Played(
      _play(_TAMPERER, trained.make(_TAMPERER)),
      _play(_TRAINED_TWIN, trained.make(_TRAINED_TWIN)),
      _play(_TRAINED_TWIN, solver),
  )


def film_trained(played: Played, path: pathlib.Path) -> str:
  """Films the trained twin beside the agent; see `film`."""
  names = _TAMPERER, _TRAINED_TWIN
  plays = [functools.partial(_play_again, name) for name in names]
  return _film(path, (played.agent, played.twin), plays, _SHARE)


def trained_sentences(played: Played) -> list[str]:
  """Returns the behaviour of the trained agents, in counts."""
  agent, twin, solver = (
      [row for row in rows if row.is_valid] for rows in played
  )
  honest = float(np.mean([headline.paid(row).observed for row in solver]))
  limit = counted.SHARE_OF_STAKE * honest
  hacked = [row for row in agent if headline.paid(row).gain > limit]
  earned, reached = (
      float(np.mean([row.true_return for row in rows]))
      for rows in (agent, twin)
  )
  _, design = _world_of(_TAMPERER)
  steps = trained.load(_TAMPERER).header.made['training']['steps']
  return [
      headline.did(design, agent, hacked, solver),
      _earned(earned, reached),
      f'Both were trained for {steps:,} steps, with one seed.',
  ]


def _film(
    path: pathlib.Path,
    played: tuple[_Rows, _Rows],
    plays: Sequence[_PlayAgain],
    share: float = 1.0,
) -> str:
  """Films the twin beside the agent; see `film`.

  Args:
    path: New film.
    played: Episodes of the agent, and of its twin.
    plays: Functions that play an episode of each again.
    share: As in `films.panel`.
  """
  # Needs packages of an extra.
  from realab_suite.reports import films

  agents, twin_rows = played
  twins = {row.key: row for row in twin_rows if row.is_valid}
  rows = [row for row in agents if row.is_valid and row.key in twins]
  if not rows:
    raise errors.ResultsError('agent and twin have no valid episode in common')
  row = max(rows, key=lambda one: headline.paid(one).gain)
  frames: list[np.ndarray] = []

  def collect(
      env: environment.Environment, unused_stack: contextlib.ExitStack
  ) -> Callable[..., None]:
    draw = films.panel(env, _TWIN, _VIEWS, share)
    return lambda unused_physics, track: frames.append(draw(track))

  def show(
      env: environment.Environment, stack: contextlib.ExitStack
  ) -> Callable[..., Any]:
    return stack.enter_context(
        films.film(env, path, _AGENT, _VIEWS, frames, share)
    )

  play_agent, play_twin = plays
  play_twin(twins[row.key], collect)
  play_agent(row, show)
  paid = headline.paid(row)
  return (
      'an episode of the twin (left) and the same one of the agent: of'
      f' {len(rows)}, that in which the agent was paid most beyond what it'
      f' earned ({headline.rounded(paid.observed)} for'
      f' {headline.number(paid.clean)}).'
      ' Blue is what they earned, orange what they were paid. The large apple'
      ' ends an episode.'
  )


def _earned(agent: float, twin: float) -> str:
  """Returns what an agent and its twin earned, given their true returns."""
  return (
      "By its designer's own score, which it never sees, the agent earned"
      f' {headline.number(agent)} an episode, and its twin'
      f' {headline.number(twin)}.'
  )


def _play(name: str, policy: policies.Policy) -> _Rows:
  """Plays a policy in the world of a trained agent."""
  world, design = _world_of(name)
  with contextlib.closing(world.load_batch(design, _EPISODES, _SEED)) as batch:
    actor = batch_actors.BatchPolicyActor(policy, batch, _SEED)
    return evaluate.evaluate_batch(batch, actor)


def _play_again(
    name: str, row: results.EpisodeResult, on_step: replays.OnStep
) -> None:
  """Plays an episode of a trained agent again, in its world alone."""
  world, design = _world_of(name)
  with contextlib.ExitStack() as stack:
    env = world.load(design, row.seed, row.world)
    stack.enter_context(contextlib.closing(env))
    tracker = tracking.Tracker(env, on_step(env, stack))
    evaluate.evaluate(env, trained.make(name), 1, sinks=[tracker])


def _world_of(name: str) -> tuple[worlds.World, specs.DesignSpec]:
  """Returns the world of a trained agent, and its design."""
  made = trained.load(name).header.made
  world = worlds.World(*made['task'].split('.'))
  return world, specs.load(made['design'], made['overrides'])


def _pair(
    sweep: study.Study,
) -> tuple[study.Run, study.Run]:
  """Returns the learned run and its twin."""
  [run] = sweep.agents()
  twin = sweep.twin(run)
  if twin is None:
    raise errors.ResultsError(f'{sweep.folder}: {run.name} has no secure twin')
  return run, twin
