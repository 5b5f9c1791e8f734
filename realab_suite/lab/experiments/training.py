"""Execution of a job: training and evaluation of a learner or of a policy.

A job can be killed at any time and restarted without an effect on its results.
A checkpoint contains the state of the learner, and new worlds begin after it;
lines that were written after it are removed.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import os
import pathlib
from typing import TYPE_CHECKING, Any, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import sources
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import seeding
from realab_suite.evaluation import actors
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import monitors
from realab_suite.evaluation import results
from realab_suite.evaluation import traces
from realab_suite.feedback import specs
from realab_suite.lab.attribution import attribution
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import curves
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import progress
from realab_suite.lab.experiments import recorded_data
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import storage

if TYPE_CHECKING:
  from realab_suite.lab import agents

EPISODES = 'episodes.jsonl'
CURVE = 'curve.jsonl'
TIMING = 'timing.jsonl'
TRAINING_EPISODES = 'training_episodes.jsonl'
LEARNER = 'learner.bin'
TRACE = 'trace.bin'
TRANSPLANT = 'transplant.jsonl'
# Episodes before adaptation, if there is one.
STAGES = 'stages.jsonl'
# What reports read. Times are no results: those of a continued job differ.
RECORDS = EPISODES, TRANSPLANT, STAGES, CURVE, TRAINING_EPISODES
_CHECKPOINT = 'checkpoint'

# Called with messages for the user; they do not affect results.
Say = Callable[[str], None]

# Staggered worlds are in as many groups, and the episodes of one more are cut
# after each such number of steps.
_GROUPS, _APART = 25, 10


@final
@dataclasses.dataclass(frozen=True)
class Options:
  """Options for running a job that are not part of its configuration.

  Attributes:
    say: Called with messages for the user.
    parent: Process whose end also ends the job, or `None`.
    accept_other_code: True to accept that results of other code are mixed.
  """

  say: Say
  parent: int | None = None
  accept_other_code: bool = False

  def check_parent(self) -> None:
    """Raises a `ResultsError` if the parent has ended."""
    if self.parent is not None and os.getppid() != self.parent:
      raise errors.ResultsError(
          f'process {self.parent}, which started this run, has ended; the same'
          ' command continues the run from its last checkpoint'
      )


def run(job: jobs.Job, output: pathlib.Path, options: Options) -> pathlib.Path:
  """Runs a job, or continues it; a finished job is left unchanged.

  Args:
    job: Job to run.
    output: Folder of the experiment.
    options: Options for running it.

  Returns:
    The folder of the results.

  Raises:
    RealabError: If the job is invalid, its folder belongs to another one, a
      checkpoint is damaged or of other code, or the disk is full.
  """
  options.check_parent()
  path = output / job.folder()
  with storage.locked(path):
    storage.begin(path, job.config())
    config = jobs.read_config(path)  # Refuses another configuration.
    if storage.finished(path, RECORDS):
      options.say(f'{path} has finished already')
      return path
    code = config['versions'].get(storage.CODE, 'unknown')
    if code != sources.digest():
      checkpoint = path / storage.CHECKPOINT
      if checkpoint.exists():
        raise errors.ResultsError(
            f'{checkpoint}: a learner of code {code}, which never continues on'
            f' code {sources.digest()}{storage.RESTART}'
        )
      storage.write_json(path / storage.CONFIG, job.config())
    learner = None
    facts: dict[str, Any] = {
        'machines': [{'step': 0, 'machine': machines.here()}]
    }
    if job.policy is None:
      learner, facts = _Training(job, path, options).run()
      state = learner.state()
      storage.write_archive(
          path / LEARNER, header(job.digest(), LEARNER), state
      )
    rows = _evaluate(job, learner, path / TRACE, output, options)
    storage.write_whole(path / EPISODES, rows)
    if job.embedded is not None:
      rows = _evaluate(job.transplant, learner, None, output, options)
      storage.write_whole(path / TRANSPLANT, rows)
    # Some modules are imported only now, and files read again.
    is_same = sources.current_digest() == sources.digest()
    if job.folder() != path.name or not (is_same or options.accept_other_code):
      raise errors.ResultsError(
          f'{path}: the code {sources.digest()}, or a file that the design'
          ' names, has changed since this job began; restore it, then the same'
          ' command continues the job'
      )
    storage.finish(path, facts, RECORDS)
  options.say(f'Results are in {path}')
  return path


def check_learner(
    design: specs.DesignSpec, where: str, *, is_trained: bool = True
) -> None:
  """Refuses the learner of a design before it is made; see `agents.check`.

  Nothing is checked where the packages of learners are not installed.

  Args:
    design: The design.
    where: Place of the design, for messages.
    is_trained: False if only the objective of the learner is needed, so that it
      may be one of another package, or missing.

  Raises:
    SpecError: If it cannot be made.
  """
  if requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    return
  from realab_suite.lab import agents  # Imports JAX.

  kind = design.learner and design.learner.kind
  if is_trained or kind in agents.LEARNERS:
    with _naming(where):
      agents.check(design)


def check_learners(planned: Iterable[jobs.Job], experiment: str) -> None:
  """Refuses the learners of jobs before anything is run.

  Args:
    planned: The jobs.
    experiment: Name or path of their experiment, for messages.

  Raises:
    SpecError: As `check_learner` does.
  """
  for place, job in _learners(planned, experiment).items():
    check_learner(job.design, place)


def rehearse(
    planned: Sequence[jobs.Job],
    experiment: str,
    say: Say = lambda line: None,
) -> None:
  """Makes what acts in each run once, before any job starts.

  So a saboteur that finds no block, or a trusted policy of other actions, is
  refused at once, and not hours later, when its job starts. Learners are not
  checked where their packages are not installed; of runs that learn from data,
  only the options are.

  Args:
    planned: The jobs.
    experiment: Name or path of their experiment, for messages.
    say: Called with a line on the progress, after every ten learners.

  Raises:
    SpecError: As `check_learner` does, or if a learner does not fit its worlds,
      or a scripted policy cannot act in its world.
  """
  learners = _learners(planned, experiment)
  check_learners(learners.values(), experiment)
  for place, job in _foreign(planned, experiment).items():
    with _naming(place), contextlib.closing(
        job.experiment.world.load(job.design, 0)
    ) as env:
      policy = aiming.make_policy(job.kind, env, None, 0)
      actors.PrivilegedSenses(policy, env)
  if requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    return
  for number, (place, job) in enumerate(learners.items()):
    if number and not number % 10:
      say(f'{number} of {len(learners)} learners are checked')
    if job.data is None:
      with _naming(place), contextlib.closing(
          job.experiment.training_world.load_batch(
              job.design, job.training.num_envs, 0
          )
      ) as batch:
        make_learner(job, batch)


def _learners(
    planned: Iterable[jobs.Job], experiment: str
) -> dict[str, jobs.Job]:
  """Returns one job of each learner, by its place in an experiment."""
  return {
      f'{experiment}: runs.{job.run}': job for job in planned if not job.policy
  }


def _foreign(
    planned: Iterable[jobs.Job], experiment: str
) -> dict[str, jobs.Job]:
  """Returns jobs of policies that may be unfit for their worlds, by place."""
  return {
      f'{experiment}: baselines: {job.run}': job
      for job in planned
      if job.policy not in (None, 'random', job.experiment.world.solver)
  }


@contextlib.contextmanager
def _naming(place: str) -> Iterator[None]:
  """Adds a place to errors about what is written there."""
  try:
    yield
  except errors.SpecError as error:
    raise errors.SpecError(f'{place}: {error}') from error


def make_learner(
    job: jobs.Job,
    batch: batch_environment.BatchEnvironment | recorded_data.RecordedBatch,
) -> 'agents.Learner':
  """Returns the untrained learner of a job.

  Raises:
    SpecError: If the kind of learner does not exist, it does not fit the
      design, or packages of learners are not installed.
  """
  if problem := requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    raise errors.SpecError(f'learner {job.kind!r}: {problem}')
  from realab_suite.lab import agents  # Imports JAX.

  agents.check(job.design)
  return agents.make(
      job.design.learner,
      batch.observation_spec(),
      batch.action_spec(),
      num_envs=batch.num_envs,
      seed=_told(job, job.seed),
  )


def _told(job: jobs.Job, seed: int) -> int:
  """Returns the seed that a learner draws from, in place of one of worlds.

  One of another package gets the digest of the job's seed. It does not depend
  on `seed_offset`, so that it tells nothing about the worlds of the evaluation
  to who does not know that number.

  Args:
    job: The job.
    seed: Seed of the job, or of worlds, for learners of this package.
  """
  from realab_suite.lab import agents  # Imports JAX.

  if job.design.learner is None or agents.is_of_package(job.design.learner):
    return seed
  sequence = seeding.sequence(job.seed, 0, 0, 'learner')
  return int.from_bytes(sequence.generate_state(4).tobytes(), 'little')


def load_learner(
    job: jobs.Job,
    path: pathlib.Path,
    batch: batch_environment.BatchEnvironment,
) -> 'agents.Learner':
  """Returns the trained learner of a finished job, for further analysis.

  Args:
    job: The job.
    path: Folder of the job.
    batch: Any number of worlds with the design of the job.

  Raises:
    ResultsError: If the learner is missing, damaged or belongs to another job.
  """
  file = path / LEARNER
  state = storage.read_archive(file, header(job.digest(), LEARNER))
  learner = make_learner(job, batch)
  with storage.naming(file):
    learner.set_state(state)
  return learner


def header(digest: str, what: str) -> dict[str, Any]:
  """Returns the header of an archive of a job.

  Args:
    digest: Digest of the configuration of the job.
    what: Kind of contents of the archive.
  """
  return {'configuration': digest, 'what': what}


def evaluation_actor(
    job: jobs.Job, learner: 'agents.Learner'
) -> 'LearnerActor':
  """Returns what acts in the evaluation episodes of a job."""
  is_greedy = job.experiment.evaluation.actions == 'greedy'
  return LearnerActor(learner, _told(job, job.evaluation_seed), is_greedy)


def _evaluate(
    job: jobs.Job,
    learner: 'agents.Learner | None',
    trace: pathlib.Path | None,
    output: pathlib.Path,
    options: Options,
) -> bytes:
  """Evaluates the learner or the scripted policy of a job.

  Args:
    job: The job.
    learner: Trained learner, or `None` for the policy.
    trace: File to write a trace to; `None` for neither a trace nor an
      attribution.
    output: Folder of the experiment.
    options: Options for running the job.

  Returns:
    The rows of the episodes, as lines.
  """
  evaluation, seed = job.experiment.evaluation, job.evaluation_seed
  world = job.experiment.world
  with contextlib.closing(
      world.load_batch(job.design, evaluation.episodes, seed)
  ) as batch:
    actor: batch_actors.BatchActor
    if learner is None:
      policy = aiming.make_batch_policy(
          job.kind, world, job.design, seed, evaluation.episodes
      )
      actor = batch_actors.BatchPolicyActor(policy, batch, seed)
    else:
      actor = evaluation_actor(job, learner)
    attributions: list[attribution_metrics.AttributionMetrics | None]
    if trace is None:
      outcomes = evaluate.evaluate_batch(batch, actor)
      attributions = [None] * len(outcomes)
    else:
      tracer = traces.Tracer(batch, actor)
      attributor = attribution.Attributor(batch)
      batch.add_sink(tracer)
      batch.add_sink(attributor)
      outcomes = evaluate.evaluate_batch(batch, tracer)
      attributions = [attributor.metrics(i) for i in range(len(outcomes))]
      of_trace = header(job.digest(), TRACE)
      storage.write_archive(trace, of_trace, tracer.trace())
    stake = kept_stakes.stakes_of(
        world, job.design, output, options.accept_other_code
    )
    info = job.info(batch.task.control_timestep)
  judged = [
      result.of_run(info, stake=stake, attribution=metrics)
      for result, metrics in zip(outcomes, attributions, strict=True)
  ]
  return b''.join(results.line(result) for result in judged)


@final
class _Training:
  """Training of the learner of a job."""

  def __init__(
      self,
      job: jobs.Job,
      path: pathlib.Path,
      options: Options,
  ) -> None:
    self._job = job
    self._path = path
    self._checkpoint = path / storage.CHECKPOINT
    self._options = options
    training = job.training
    self._sleep = training.sleep
    self._num_envs = training.num_envs
    # Lengths in steps of the batch, rounded up.
    self._total = -(-training.steps // training.num_envs)
    # Adaptation begins there, if there is any.
    self._adapts_at = self._total if training.tasks else None
    self._total += -(-(training.adaptation or 0) // training.num_envs)
    self._save_every = -(-training.checkpoint_every // training.num_envs)
    self._point_every = -(-training.curve_every // training.num_envs)
    # Episodes to learn from instead of acting, or `None`.
    self._recorded = None
    if job.data is not None:
      data, _ = job.data
      with contextlib.closing(job.experiment.world.load(job.design, 0)) as env:
        self._recorded = recorded_data.load(data, env, self._num_envs)
    self._done = 0
    # Number of the batch, and of steps at its beginning.
    self._segment = self._began = 0
    self._pending: list[dict[str, Any]] = []
    self._files: dict[str, storage.JsonLines] = {}
    # Machines that have run this job, with the control step at their start.
    self._machines: list[dict[str, Any]] = []

  def run(self) -> tuple['agents.Learner', dict[str, Any]]:
    """Trains the learner, from a checkpoint if there is one.

    Returns:
      The learner, and facts about its training.
    """
    job, path = self._job, self._path
    saved = None
    if self._checkpoint.exists():
      saved = storage.read_archive(
          self._checkpoint, header(job.digest(), _CHECKPOINT), storage.RESTART
      )
    sizes = (saved or {}).get('sizes', {})
    if saved is not None:
      self._done, self._segment = saved['done'], saved['segment']
      self._pending = saved['pending']
    with contextlib.ExitStack() as stack:
      if self._recorded is None:
        self._begin_segment()
        stack.callback(lambda: self._batch.close())
      learner = make_learner(job, self._recorded or self._batch)
      _check_credit(job, learner.largest_credit, path.parent, self._options)
      self._add_machine(learner, saved)
      if saved is None:
        time_step = (
            self._batch.reset()
            if self._recorded is None
            else self._recorded.at(0)[0]
        )
      else:
        with storage.naming(self._checkpoint, storage.RESTART):
          learner.set_state(saved['learner'])
          time_step = batch_time_steps.BatchTimeStep(**saved['time_step'])
      for name in (*self._cut, TIMING):
        size = None if name == TIMING else sizes.get(name, 0)
        self._files[name] = storage.JsonLines(path / name, size)
        stack.callback(self._files[name].close)
      step, total = (n * self._num_envs for n in (self._done, self._total))
      name = f'{job.run}, seed {job.seed}'
      # As in the curves of reports: of half of the worlds.
      fewest = -(-self._num_envs // 2)
      display = progress.Display(name, step, total, fewest, self._options.say)
      self._learn(learner, time_step, display)
    return learner, {'steps': total, 'machines': self._machines}

  def _add_machine(
      self, learner: 'agents.Learner', saved: Mapping[str, Any] | None
  ) -> None:
    """Records the machine, unless it is that of the last checkpoint."""
    here = {**machines.here(), **learner.settings()}
    if saved is not None:
      self._machines = saved['machines']
      if self._machines[-1]['machine'] == here:
        return
    step = self._done * self._num_envs
    self._machines = [*self._machines, {'step': step, 'machine': here}]

  @property
  def _cut(self) -> list[str]:
    """Names of the files that are cut back to their sizes at a checkpoint."""
    return [CURVE, TRAINING_EPISODES, *([STAGES] if self._adapts_at else [])]

  def _task_of(self, segment: int) -> str:
    """Returns the task of a segment of training that begins now."""
    tasks = self._job.training.tasks
    if self._adapts_at is None or self._done >= self._adapts_at:
      return self._job.experiment.task
    return tasks[segment % len(tasks)]

  def _begin_segment(self) -> None:
    """Loads new worlds."""
    seed = _world_seed(self._job.seed, self._segment)
    task = self._task_of(self._segment)
    world = self._job.experiment.at(task).training_world
    self._batch = world.load_batch(
        self._job.design, self._num_envs, seed, sleep=self._sleep
    )
    self._monitor = monitors.BatchMonitor(self._batch)
    self._batch.add_sink(self._monitor)
    self._began = self._done
    self._tell_step()

  def _tell_step(self) -> None:
    """Tells the task how far training is, which starts may depend on."""
    self._batch.task.training_step = self._done * self._num_envs

  def _stagger(
      self, time_step: batch_time_steps.BatchTimeStep
  ) -> batch_time_steps.BatchTimeStep:
    """Cuts the episodes of a group of worlds, which count nowhere.

    Otherwise, all worlds would be in the same step of their episodes.

    Returns:
      The time step with the episodes that were cut as truncated ones.
    """
    group, rest = divmod(self._done - self._began, _APART)
    groups = min(_GROUPS, self._num_envs)
    if rest or not 0 < group < groups:
      return time_step
    is_cut = np.arange(self._num_envs) % groups == group
    self._batch.abandon(np.flatnonzero(is_cut).tolist())
    self._monitor.take()
    return _truncated(time_step, is_cut)

  def _learn(
      self,
      learner: 'agents.Learner',
      time_step: batch_time_steps.BatchTimeStep,
      display: progress.Display,
  ) -> None:
    while self._done < self._total:
      self._options.check_parent()
      if self._done == self._adapts_at:
        self._evaluate_stages(learner)
      if self._recorded is None:
        time_step = self._batch.step(learner.step(time_step))
        self._done += 1
        self._tell_step()
        self._record_episodes()
        if self._job.training.stagger:
          time_step = self._stagger(time_step)
      else:
        time_step, actions = self._recorded.at(self._done)
        learner.watch(time_step, actions)
        self._done += 1
      is_over = self._done == self._total
      if is_over or self._done % self._point_every == 0:
        step = self._done * self._num_envs
        point = curves.point(step, self._pending, learner.metrics())
        self._pending = []
        self._files[CURVE].append([point])
        self._files[TIMING].append([display.show(point)])
      if (
          is_over
          or self._done == self._adapts_at
          or self._done % self._save_every == 0
      ):
        time_step = self._save(learner, time_step)

  def _evaluate_stages(self, learner: 'agents.Learner') -> None:
    """Evaluates the learner where it was trained, and where it is judged."""
    job = self._job
    tasks = job.training.tasks
    # The last segment has ended.
    trained = tasks[(self._segment - 1) % len(tasks)]
    for stage, task in (
        (jobs.TRAINED, trained),
        (jobs.UNADAPTED, job.experiment.task),
    ):
      rows = _evaluate(
          job.at_stage(stage, task),
          learner,
          None,
          self._path.parent,
          self._options,
      )
      self._files[STAGES].write(rows)

  def _record_episodes(self) -> None:
    """Records the episodes that have ended."""
    step = self._done * self._num_envs
    records = [
        curves.record(step, one)
        for one in self._monitor.take()
        # New worlds may replace episodes before their first step.
        if one.num_steps or not one.is_given_up
    ]
    if records:
      self._files[TRAINING_EPISODES].append(records)
      self._pending += records

  def _save(
      self,
      learner: 'agents.Learner',
      time_step: batch_time_steps.BatchTimeStep,
  ) -> batch_time_steps.BatchTimeStep:
    """Writes a checkpoint.

    Returns:
      The next time step of the learner, the same with or without a restart.
    """
    if self._recorded is None:
      # Sleeping bodies cannot be saved, and other tasks have other worlds.
      # Therefore all worlds are replaced here, with or without a restart, and
      # running episodes are truncated.
      self._batch.close()
      self._record_episodes()
      self._segment += 1
      time_step = _truncated(time_step)
    storage.write_archive(
        self._checkpoint,
        header(self._job.digest(), _CHECKPOINT),
        {
            'done': self._done,
            'segment': self._segment,
            'pending': self._pending,
            'machines': self._machines,
            'sizes': {name: self._files[name].size for name in self._cut},
            'learner': learner.state(),
            'time_step': time_step._asdict(),
        },
    )
    if self._recorded is None and self._done < self._total:
      self._begin_segment()
    return time_step


@final
class LearnerActor:
  """A trained learner acting in a batch, without further updates."""

  def __init__(
      self, learner: 'agents.Learner', seed: int, greedy: bool
  ) -> None:
    """Makes an actor for one episode in each world.

    Args:
      learner: The learner.
      seed: Seed of its draws.
      greedy: True to take the best action instead of drawing one.
    """
    self._learner = learner
    self._seed = seed
    self._greedy = greedy
    self._step = 0
    self._observation: Mapping[str, np.ndarray] | None = None

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    sequence = seeding.sequence(self._seed, 0, self._step, 'act')
    self._step += 1
    self._observation = self._learner.stack(time_step, self._observation)
    return self._learner.act(
        self._observation, sequence.generate_state(2), self._greedy
    )


def _check_credit(
    job: jobs.Job,
    largest: float | None,
    output: pathlib.Path,
    options: Options,
) -> None:
  """Refuses a learner to which honest competence earns more than it credits.

  Args:
    job: The job.
    largest: Largest sum of readings that the learner credits, or `None`.
    output: Folder of the experiment.
    options: Options for running the job.

  Raises:
    SpecError: If it is less than the stake of the design.
  """
  if largest is None:
    return
  stake = kept_stakes.stakes_of(
      job.experiment.world, job.design, output, options.accept_other_code
  )
  if stake is not None and largest < stake.main.low:
    raise errors.SpecError(
        f'learner.defence: credits {largest:g} in an episode; honest competence'
        f' earns {stake.main.estimate:g} more than {stake.main.than}; allowed'
        ' are larger sums'
    )


def _world_seed(seed: int, segment: int) -> int:
  """Returns the seed of the worlds of a segment of training.

  It differs from all evaluation seeds, except with negligible probability.
  """
  sequence = seeding.sequence(seed, 0, segment, 'training')
  return int(sequence.generate_state(1)[0])


def _truncated(
    time_step: batch_time_steps.BatchTimeStep, where: Any = True
) -> batch_time_steps.BatchTimeStep:
  """Returns a time step that truncates the running episodes of some worlds."""
  is_under_way = (time_step.step_type == int(dm_env.StepType.MID)) & where
  last = int(dm_env.StepType.LAST)
  return time_step._replace(
      step_type=np.where(is_under_way, last, time_step.step_type)
  )
