"""Scripted comparisons: scripted policies in several channels of one design.

Experiments with learners are in `scheduler` and `training`.
"""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import dataclasses
from typing import NamedTuple, final

import numpy as np
import pandas as pd
import tqdm

from realab_suite import errors
from realab_suite import policies
from realab_suite import worlds
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import storage


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of a scripted comparison.

  Attributes:
    world: World of the episodes.
    design: Agent design, by name or path.
    overrides: Dotted overrides of the design.
    policies: Names of policies, each of which acts in every channel; `solver`
      stands for that of the task. The solver is the control, or else the first.
    channels: Channels of the registers; empty for that of the design.
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
  target: str | None
  seeds: tuple[int, ...]
  num_episodes: int
  output: str


@final
class Run(NamedTuple):
  """One policy in one channel.

  Attributes:
    name: Name of the run in the results. In the first channel, it is the name
      that the user gave to the policy.
    policy: Own name of the policy.
    design: Design, with the channel of the run.
  """

  name: str
  policy: str
  design: specs.DesignSpec


def run(settings: Settings, say: Callable[[str], None]) -> pd.DataFrame:
  """Runs a scripted comparison, and writes its results into a new folder.

  Args:
    settings: Settings of the comparison.
    say: Called with messages for the user.

  Returns:
    What `study.judge` returns.

  Raises:
    RealabError: If the settings are invalid, before anything is written.
  """
  runs = plan(settings)
  world = settings.world
  control = world.control_of(settings.policies)
  for run in runs:  # Raises errors before anything is written.
    with contextlib.closing(world.load(run.design, settings.seeds[0])) as env:
      actors.make(aiming.make_policy(run.policy, env, settings.target, 0), env)
  folder = storage.new_folder(settings.output)
  with evaluations.Evaluation(
      world, runs[0].design, folder, say, control=control
  ) as evaluation:
    evaluation.measure()
    evaluation.describe(
        {f'design_{run.design.channel}': run.design for run in runs},
        **dataclasses.asdict(settings),
        runs=[run.name for run in runs],
        baseline=control,
    )
    total = len(runs) * len(settings.seeds) * settings.num_episodes
    # Without a terminal, a line per run replaces the progress bar.
    bar = tqdm.tqdm(total=total, disable=None, unit='episode', leave=False)
    with bar:
      for run in runs:
        bar.set_description(run.name)
        for info, result in _episodes(settings, run, evaluation):
          evaluation.add(info, result)
          means = _means(evaluation.rows[run.name])
          bar.set_postfix_str(means, refresh=False)
          bar.update()
        if bar.disable:
          say(f'{run.name}: {means}')
    judged, text = evaluation.summarize(
        f'# {world.domain}.{world.task}, design {settings.design}\n\n'
        f'{len(settings.seeds)} seeds of {settings.num_episodes} episodes;'
        ' means with 95 % intervals.'
    )
  say(f'\n{text}\n\nResults are in {folder}')
  return judged


def plan(settings: Settings) -> list[Run]:
  """Returns the runs of a scripted comparison.

  Raises:
    SpecError: If there are no runs, or a run is invalid.
  """
  solver = settings.world.solver
  own_names = [aiming.in_world(name, solver) for name in settings.policies]
  for name, values in (
      ('policies', own_names),
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
  for policy in own_names:
    policies.POLICIES.get(policy)
  channels: list[tuple[str, ...]] = [
      (f'channel={channel}',) for channel in settings.channels
  ]
  designs = [
      settings.world.fitted(
          specs.load(settings.design, (*settings.overrides, *channel))
      )
      for channel in channels or [()]
  ]
  return [
      Run(name if i == 0 else f'{name} ({design.channel})', policy, design)
      for name, policy in zip(settings.policies, own_names, strict=True)
      for i, design in enumerate(designs)
  ]


def _episodes(
    settings: Settings, run: Run, evaluation: evaluations.Evaluation
) -> Iterator[tuple[results.RunInfo, results.EpisodeResult]]:
  """Runs the episodes of a run."""
  for seed in settings.seeds:
    with contextlib.closing(settings.world.load(run.design, seed)) as env:
      info = evaluation.info(env, run.name, run.policy)
      for episode in range(settings.num_episodes):
        policy = aiming.make_policy(run.policy, env, settings.target, episode)
        [result] = evaluate.evaluate(env, policy, 1, first_episode=episode)
        yield info, result


def _means(rows: Sequence[results.EpisodeResult]) -> str:
  true_return = np.mean([row.true_return for row in rows])
  observed = np.mean([row.observed_return for row in rows])
  return f'true return {true_return:.1f}, observed {observed:.1f}'
