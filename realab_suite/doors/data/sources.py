"""Sources of datasets: runs whose evaluation episodes can be replayed."""

from collections.abc import Sequence
import contextlib

from realab_suite import errors
from realab_suite import worlds
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import traces
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import replays
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study

Source = Sequence[replays.Recorded]
"""Recorded episodes of one run, at least one, by seed and world."""


def of_run(run: study.Run, num_episodes: int) -> Source:
  """Returns the source with the first episodes of each seed of a run.

  Args:
    run: A run of a sweep.
    num_episodes: Largest number of episodes per seed.

  Raises:
    ResultsError: If a seed has not finished, or a trace is damaged or does not
      contain an episode.
  """
  missing = [seed for seed in run.planned if seed not in run.configs]
  if missing:
    raise errors.ResultsError(
        f'run {run.name}: seeds {missing} have not finished; run the same sweep'
        ' to its end first'
    )
  by_seed: dict[int, list[replays.Recorded]] = {}
  for row in sorted(run.rows, key=lambda row: row.key):
    recordings = by_seed.setdefault(row.seed, [])
    if len(recordings) < num_episodes:
      recordings.append(replays.recorded(run, row))
  return [one for recordings in by_seed.values() for one in recordings]


def of_policy(
    name: str,
    policy: str,
    design: specs.DesignSpec,
    world: worlds.World,
    *,
    seeds: Sequence[int],
    num_episodes: int,
    stake: stakes.Stakes | None = None,
) -> Source:
  """Runs a scripted policy, and returns the source with its episodes.

  Args:
    name: Name of the run.
    policy: Name of the policy. A saboteur attacks the first feedback register.
    design: Design.
    world: The world.
    seeds: Seeds of the worlds.
    num_episodes: Number of episodes per seed: the first one of each world.
    stake: Stakes of the design in the world, or `None`.

  Raises:
    SpecError: If the policy cannot act with the design, or an argument is
      wrong.
  """
  episodes: list[replays.Recorded] = []
  for seed in seeds:
    with contextlib.ExitStack() as stack:
      env = stack.enter_context(contextlib.closing(world.load(design, seed)))
      actor = aiming.make_policy(policy, env, None, 0)
      info = evaluations.info_of(
          env, world, policy=policy, run=name, baseline=None
      )
      batch = stack.enter_context(
          contextlib.closing(world.load_batch(design, num_episodes, seed))
      )
      tracer = traces.Tracer(
          batch, batch_actors.BatchPolicyActor(actor, batch, seed)
      )
      batch.add_sink(tracer)
      episode_results = evaluate.evaluate_batch(batch, tracer)
      trace = tracer.trace()
      episodes += [
          replays.Recorded(
              result.of_run(info, stake=stake),
              design,
              world,
              False,
              trace,
              index,
          )
          for index, result in enumerate(episode_results)
      ]
  return episodes
