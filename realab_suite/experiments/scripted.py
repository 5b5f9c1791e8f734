"""Scripted comparisons: scripted policies in several channels of one design.

The caller passes the functions that draw pictures, so this module needs neither
a renderer nor a plotting library. Experiments with learners are in `scheduler`
and `training`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import pathlib
from typing import Any, NamedTuple, final

import numpy as np
import tqdm

from realab_suite import errors
from realab_suite import policies
from realab_suite import worlds
from realab_suite.audit import aiming
from realab_suite.engine import environment
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.experiments import evaluations
from realab_suite.experiments import result_tables
from realab_suite.experiments import storage
from realab_suite.experiments import tracking
from realab_suite.feedback import specs


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of a scripted comparison.

  Attributes:
    world: World of the episodes.
    design: Agent design, by name or path.
    overrides: Dotted overrides of the design.
    policies: Names of policies, each of which acts in every channel.
    channels: Channels of the registers; empty for that of the design.
    baseline: Name of the run to compare with, or `None` for the default.
    target: Register that saboteurs attack, or `None` for the first feedback
      register.
    seeds: Seeds of the episodes.
    num_episodes: Number of episodes per seed.
    output: New folder for the results.
  """

  world: worlds.World
  design: str
  overrides: tuple[str, ...]
  policies: tuple[str, ...]
  channels: tuple[str, ...]
  baseline: str | None
  target: str | None
  seeds: tuple[int, ...]
  num_episodes: int
  output: str


OnStep = Callable[[Any, tracking.Track], None]
"""Called with the physics and the track, at the start and after every step."""


@final
class Pictures(NamedTuple):
  """Functions that make the pictures of a comparison.

  Attributes:
    draw: Draws plots of the first episode of each run into a new folder, or
      `None` for no plots.
    film: Opens the films of an episode, given its environment, a folder and the
      name of the run, and yields a function that adds a control step; or `None`
      for no films.
  """

  draw: Callable[[Mapping[str, tracking.Track], pathlib.Path], None] | None
  film: (
      Callable[
          [environment.Environment, pathlib.Path, str],
          contextlib.AbstractContextManager[OnStep],
      ]
      | None
  )


NO_PICTURES = Pictures(None, None)


@final
class Run(NamedTuple):
  """One policy in one channel.

  Attributes:
    name: Name of the run in the results.
    policy: Name of the policy.
    design: Design, with the channel of the run.
    is_first: True for the first run of the policy, which is filmed.
  """

  name: str
  policy: str
  design: specs.DesignSpec
  is_first: bool


def run(
    settings: Settings,
    say: Callable[[str], None],
    pictures: Pictures = NO_PICTURES,
) -> list[result_tables.Line]:
  """Runs a scripted comparison, and writes its results into a new folder.

  Args:
    settings: Settings of the comparison.
    say: Called with messages for the user.
    pictures: Functions that make its pictures.

  Returns:
    The summary of each run.

  Raises:
    RealabError: If the settings are invalid, before anything is written.
  """
  runs = plan(settings)
  control = _control(settings, runs)
  _check_runs(settings, runs)
  folder = storage.new_folder(settings.output)
  world = settings.world
  with evaluations.Evaluation(
      world, runs[0].design, folder, say, control=control
  ) as evaluation:
    evaluation.measure()
    evaluation.describe(
        {f'design_{run.design.channel}': run.design for run in runs},
        settings={
            **dataclasses.asdict(settings),
            'plots': pictures.draw is not None,
            'videos': pictures.film is not None,
        },
        runs=[run.name for run in runs],
        baseline=control,
    )
    job = _Job(settings, evaluation, folder, say, pictures)
    job.run(runs)
    if pictures.draw is not None:
      pictures.draw(job.tracks, folder / 'plots')
    lines, text = evaluation.summarize(
        f'# {world.domain}.{world.task}, design {settings.design}\n\n'
        f'{len(settings.seeds)} seeds of {settings.num_episodes} episodes;'
        ' means with 95 % intervals.'
    )
  say(f'\n{text}\n\nResults are in {folder}')
  return lines


def plan(settings: Settings) -> list[Run]:
  """Returns the runs of a scripted comparison.

  Raises:
    SpecError: If there are no runs, or a run is invalid.
  """
  for name, values in (
      ('policies', settings.policies),
      ('seeds', settings.seeds),
      ('channels', settings.channels),
  ):
    if len(set(values)) != len(values):
      raise errors.SpecError(f'{name}: {list(values)} has duplicates')
  if not settings.policies or not settings.seeds or settings.num_episodes < 1:
    raise errors.SpecError(
        'a comparison needs a policy, a seed and an episode; given are'
        f' policies {list(settings.policies)}, seeds {list(settings.seeds)} and'
        f' {settings.num_episodes} episodes'
    )
  for policy in settings.policies:
    policies.POLICIES.get(policy)
  designs = _designs(settings)
  return [
      Run(
          policy if i == 0 else f'{policy} ({design.channel})',
          policy,
          design,
          i == 0,
      )
      for policy in settings.policies
      for i, design in enumerate(designs)
  ]


def _designs(settings: Settings) -> list[specs.DesignSpec]:
  if not settings.channels:
    return [specs.load(settings.design, settings.overrides)]
  return [
      specs.load(settings.design, (*settings.overrides, f'channel={channel}'))
      for channel in settings.channels
  ]


def _control(settings: Settings, runs: Sequence[Run]) -> str:
  names = [run.name for run in runs]
  if settings.baseline is None:
    solver = settings.world.solver
    return solver if solver in names else names[0]
  if settings.baseline not in names:
    raise errors.SpecError(
        f'baseline {settings.baseline!r} is not a run; allowed are {names}'
    )
  return settings.baseline


def _check_runs(settings: Settings, runs: Sequence[Run]) -> None:
  """Loads each run once, to raise errors before anything is written."""
  for run in runs:
    with contextlib.closing(
        settings.world.load(run.design, settings.seeds[0])
    ) as env:
      policy = aiming.make_policy(run.policy, env, settings.target, 0)
      actors.make(policy, env)


@final
class _Job:
  """Execution of a scripted comparison, which writes its episodes."""

  def __init__(
      self,
      settings: Settings,
      evaluation: evaluations.Evaluation,
      folder: pathlib.Path,
      say: Callable[[str], None],
      pictures: Pictures,
  ) -> None:
    self._settings = settings
    self._evaluation = evaluation
    self._folder = folder
    self._say = say
    self._pictures = pictures
    # The first episode of each run.
    self.tracks: dict[str, tracking.Track] = {}

  def run(self, runs: Sequence[Run]) -> None:
    """Runs all episodes of all runs."""
    settings = self._settings
    total = len(runs) * len(settings.seeds) * settings.num_episodes
    # Without a terminal, a line per run replaces the progress bar.
    with tqdm.tqdm(
        total=total, disable=None, unit='episode', leave=False
    ) as bar:
      for run in runs:
        bar.set_description(run.name)
        for means in self._episodes(run):
          bar.set_postfix_str(means, refresh=False)
          bar.update()
        if bar.disable:
          self._say(f'{run.name}: {means}')

  def _episodes(self, run: Run) -> Iterator[str]:
    """Runs the episodes of a run, and yields the mean returns so far."""
    for seed in self._settings.seeds:
      with contextlib.closing(
          self._settings.world.load(run.design, seed)
      ) as env:
        info = self._evaluation.info(env, run.name, run.policy)
        for episode in range(self._settings.num_episodes):
          self._evaluation.add(info, self._episode(run, env, episode))
          yield _means(self._evaluation.rows[run.name])

  def _episode(
      self, run: Run, env: environment.Environment, episode: int
  ) -> evaluate.EpisodeResult:
    policy = aiming.make_policy(run.policy, env, self._settings.target, episode)
    with contextlib.ExitStack() as stack:
      trackers = []
      if run.name not in self.tracks:
        trackers.append(tracking.Tracker(env, self._film(run, env, stack)))
      [result] = evaluate.evaluate(
          env, policy, 1, first_episode=episode, sinks=trackers
      )
    for tracker in trackers:
      self.tracks[run.name] = tracker.track
    return result

  def _film(
      self,
      run: Run,
      env: environment.Environment,
      stack: contextlib.ExitStack,
  ) -> OnStep | None:
    """Opens the films of an episode, or returns `None`."""
    if self._pictures.film is None or not run.is_first:
      return None
    folder = self._folder / 'videos'
    folder.mkdir(exist_ok=True)
    return stack.enter_context(self._pictures.film(env, folder, run.name))


def _means(rows: Sequence[results.EpisodeRow]) -> str:
  true_return = np.mean([row.true_return for row in rows])
  observed = np.mean([row.observed_return for row in rows])
  return f'true return {true_return:.1f}, observed {observed:.1f}'
