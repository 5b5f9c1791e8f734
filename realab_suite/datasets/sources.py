"""Sources of datasets: runs whose evaluation episodes can be replayed."""

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
from typing import Any, NamedTuple, final

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.evaluation import attribution
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.evaluation import traces
from realab_suite.experiments import aiming
from realab_suite.experiments import run_infos
from realab_suite.feedback import specs
from realab_suite.reports import sweep_results

# Number of episodes that are attributed in one batch.
_CHUNK = 16


@final
class Recorded(NamedTuple):
  """An episode whose actions are known.

  Attributes:
    row: Its result.
    trace: Trace that contains it; see `traces`.
    position: Index of the episode in the trace.
  """

  row: results.EpisodeRow
  trace: Mapping[str, Any]
  position: int

  @property
  def actions(self) -> Any:
    """Actions, `(steps, *action_spec.shape)`."""
    num_steps = self.trace['num_steps'][self.position]
    return self.trace['actions'][:num_steps, self.position]


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Source:
  """Recorded episodes of one run.

  Attributes:
    name: Name of the run.
    is_learned: True if a learner chose the actions, False for a scripted
      policy.
    design: Design, with the channel of the run.
    task_kwargs: Arguments of the task, without the seed.
    environment_kwargs: Arguments of the environment, without the world.
    episodes: The episodes, by seed and world.
  """

  name: str
  is_learned: bool
  design: specs.DesignSpec
  task_kwargs: Mapping[str, Any]
  environment_kwargs: Mapping[str, Any]
  episodes: tuple[Recorded, ...]

  def load(self, episode: Recorded) -> environment.Environment:
    """Returns an environment with the world of an episode alone."""
    info = episode.row.info
    return suite.load(
        info.domain,
        info.task,
        {**self.task_kwargs, 'random': episode.row.seed},
        {**self.environment_kwargs, 'world': episode.row.world},
        design=self.design,
    )

  def attribute(self) -> list[attribution_metrics.Attribution | None]:
    """Returns the attribution of each episode; see `attribution.attribute`.

    Raises:
      ResultsError: If a replay differs from its trace.
      SpecError: If the design or the task does not permit attribution.
    """
    found: list[attribution_metrics.Attribution | None] = []
    while len(found) < len(self.episodes):
      first = self.episodes[len(found)]
      chunk = [
          one.position
          for one in self.episodes[len(found) : len(found) + _CHUNK]
          if one.trace is first.trace
      ]

      def load_batch(
          num_envs: int, row: results.EpisodeRow = first.row
      ) -> batch_environment.BatchEnvironment:
        return suite.load_batch(
            row.info.domain,
            row.info.task,
            {**self.task_kwargs, 'random': row.seed},
            self.environment_kwargs,
            num_envs=num_envs,
            num_threads=1,
            design=self.design,
        )

      found += attribution.attribute(load_batch, first.trace, chunk)
    return found


def of_run(run: sweep_results.Run, num_episodes: int) -> Source:
  """Returns the source with the first episodes of each seed of a run.

  Args:
    run: A run of a sweep.
    num_episodes: Largest number of episodes per seed.

  Raises:
    ResultsError: If a seed has not finished, or a trace is damaged or does not
      contain an episode.
  """
  missing = [job.seed for job in run.jobs if job.seed not in run.folders]
  if missing:
    raise errors.ResultsError(
        f'run {run.name}: seeds {missing} have not finished; run the same sweep'
        ' to its end first'
    )
  known = {
      (seed, world, episode): (trace, index)
      for trace in run.traces.values()
      for index, (seed, world, episode) in enumerate(
          zip(trace['seed'], trace['world'], trace['episode'], strict=True)
      )
      if trace['num_steps'][index] > 0
  }
  by_seed: dict[int, list[Recorded]] = {}
  for row in sorted(run.rows, key=lambda row: _key(row)):
    chosen = by_seed.setdefault(row.seed, [])
    if len(chosen) == num_episodes:
      continue
    if _key(row) not in known:
      raise errors.ResultsError(
          f'{run.name}: (seed, world, episode) {_key(row)} has no trace'
      )
    chosen.append(Recorded(row, *known[_key(row)]))
  return Source(
      run.name,
      not run.is_scripted,
      run.design,
      # Configurations of older versions do not contain arguments.
      run.config.get('task_kwargs', {}),
      {
          **run.config.get('environment_kwargs', {}),
          'max_steps': run.config['max_steps'],
      },
      tuple(one for chosen in by_seed.values() for one in chosen),
  )


def of_policy(
    name: str,
    policy: str,
    design: specs.DesignSpec,
    world: tuple[str, str],
    *,
    seeds: Sequence[int],
    num_episodes: int,
    task_kwargs: Mapping[str, Any],
    environment_kwargs: Mapping[str, Any],
) -> Source:
  """Runs a scripted policy, and returns the source with its episodes.

  Args:
    name: Name of the run.
    policy: Name of the policy. A saboteur attacks the first feedback register.
    design: Design.
    world: Names of the domain and the task.
    seeds: Seeds of the worlds.
    num_episodes: Number of episodes per seed: the first one of each world.
    task_kwargs: Arguments of the task, without the seed.
    environment_kwargs: Arguments of the environment.

  Raises:
    SpecError: If the policy cannot act with the design, or an argument is
      wrong.
  """
  episodes: list[Recorded] = []
  for seed in seeds:
    kwargs = {**task_kwargs, 'random': seed}
    with contextlib.ExitStack() as stack:
      env = stack.enter_context(
          contextlib.closing(
              suite.load(*world, kwargs, environment_kwargs, design=design)
          )
      )
      actor = aiming.make_policy(policy, env, None, 0)
      info = run_infos.of(env, world, policy=policy, run=name, baseline=None)
      batch = stack.enter_context(
          contextlib.closing(
              suite.load_batch(
                  *world,
                  kwargs,
                  environment_kwargs,
                  num_envs=num_episodes,
                  num_threads=1,
                  design=design,
              )
          )
      )
      tracer = traces.Tracer(
          batch, batch_actors.BatchPolicyActor(actor, batch, seed)
      )
      batch.add_sink(tracer)
      found = evaluate.evaluate_batch(batch, tracer)
      trace = tracer.trace()
      episodes += [
          Recorded(results.row(info, result), trace, index)
          for index, result in enumerate(found)
      ]
  return Source(
      name,
      False,
      design,
      task_kwargs,
      environment_kwargs,
      tuple(episodes),
  )


def _key(row: results.EpisodeRow) -> tuple[int, int, int]:
  return row.seed, row.world, row.episode
