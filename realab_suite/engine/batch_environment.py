"""Many worlds with feedback, stepped together: Python is paid once for all."""

from typing import Any, NamedTuple, final

from dm_control import composer
import dm_env
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.feedback import mechanism as feedback_mechanism
from realab_suite.tasks import base


@final
class BatchTimeStep(NamedTuple):
  """Like `dm_env.TimeStep`, with a leading axis of worlds.

  Attributes:
    step_type: `(worlds,)`, int: 0 where an episode begins, 1 within, 2 at the
      end; see `dm_env.StepType`.
    reward: `(worlds,)`: always 0.0, there is no reward channel.
    discount: `(worlds,)`; 1.0 where an episode begins.
    observation: By name, each `(worlds, ...)`.
  """

  step_type: np.ndarray
  reward: np.ndarray
  discount: np.ndarray
  observation: dict[str, np.ndarray]


@final
class BatchEnvironment:
  """`num_worlds` copies of an environment, each with episodes of its own.

  World i is, bit for bit, the environment that `world=i` makes alone. After the
  end of its episode a world ignores one action and begins the next one, as in
  `dm_env`. Where the physics of one world fails, its episode ends and the
  others go on.
  """

  def __init__(
      self,
      single: environment.Environment,
      num_worlds: int,
      num_threads: int = 0,
  ) -> None:
    """Multiplies an environment; `suite.load_batch` is easier.

    Args:
      single: A freshly loaded environment with a world of this package. It
        belongs to the batch from now on.
      num_worlds: How many worlds.
      num_threads: How many threads step them; 0 for all processors.

    Raises:
      SpecError: If there cannot be many of this environment.
    """
    if type(num_worlds) is not int or num_worlds < 1:
      raise errors.SpecError(
          f'num_envs: {num_worlds!r}; allowed are positive integers'
      )
    if type(num_threads) is not int or num_threads < 0:
      raise errors.SpecError(
          f'num_threads: {num_threads!r}; allowed are integers from 0 on'
      )
    if not isinstance(single.task, base.Task):
      raise errors.SpecError(
          f'{type(single.task).__name__} compiles anew in each episode; a batch'
          ' takes worlds of this package'
      )
    _refuse_step_hooks(single.task)
    self._single = single
    self._task: base.Task = single.task
    self._mechanism = single.mechanism
    self._physics = batch_physics.BatchPhysics(
        single.thin_physics, num_worlds, num_threads
    )
    self._num_worlds = num_worlds
    self._entities = [
        entity
        for entity in self._task.root_entity.iter_entities()
        if type(entity).initialize_episode
        is not composer.Entity.initialize_episode
    ]
    self._random_state = seeding.random_state(single.seed, 0, 0, 'batch')
    self._episodes = np.full(num_worlds, -1)
    self._is_pending = np.ones(num_worlds, bool)
    num_providers = len(self._mechanism.design.providers)
    self._keys = np.zeros((num_providers, num_worlds, 2), np.uint64)
    self._states = self._mechanism.initial_states((num_worlds,))
    self._observation: dict[str, np.ndarray] = {}
    self._sinks: list[events.BatchEventSink] = []
    self._closed = False

  @property
  def num_worlds(self) -> int:
    """How many worlds there are."""
    return self._num_worlds

  @property
  def physics(self) -> batch_physics.BatchPhysics:
    """The worlds themselves, for an evaluator; no agent is handed this."""
    return self._physics

  @property
  def task(self) -> base.Task:
    """The world that all are copies of."""
    return self._task

  @property
  def mechanism(self) -> feedback_mechanism.FeedbackMechanism:
    """The registers, meters and providers."""
    return self._mechanism

  def add_sink(self, sink: events.BatchEventSink) -> None:
    """Lets an evaluator hear of everything, from the next episodes on."""
    self._refuse_if_closed()
    self._sinks.append(sink)
    self._is_pending[:] = True

  def remove_sink(self, sink: events.BatchEventSink) -> None:
    """Ends what `add_sink` began."""
    self._sinks.remove(sink)

  def action_spec(self) -> specs.Array:
    """The spec of one world's action; actions are `(worlds, *spec.shape)`."""
    return self._single.action_spec()

  def observation_spec(self) -> dict[str, specs.Array]:
    """The specs of one world's observation."""
    return self._single.observation_spec()

  def reset(self) -> BatchTimeStep:
    """Starts the next episode of every world."""
    self._refuse_if_closed()
    self._is_pending[:] = True
    self._begin_episodes()
    reads = self._look()
    everywhere = np.ones(self._num_worlds, bool)
    nothing = np.zeros(self._num_worlds)
    self._tell(everywhere, ~everywhere, {}, [], reads, nothing)
    self._is_pending[:] = False
    return self._time_step(
        np.full(self._num_worlds, int(dm_env.StepType.FIRST)),
        np.ones(self._num_worlds),
    )

  def step(self, actions: Any) -> BatchTimeStep:
    """Runs one control step of every world.

    Args:
      actions: `(worlds, *action_spec.shape)`.

    Raises:
      ActionError: If an action does not fit; the first bad world is named, and
        no world has moved.
    """
    self._refuse_if_closed()
    queries, controls = self._single.codec.decode(actions, (self._num_worlds,))
    if self._is_pending.all():
      return self.reset()
    is_first = self._is_pending
    # Until this step is known to be good, the next one begins all episodes.
    self._is_pending = np.ones(self._num_worlds, bool)
    try:
      records, reward, discount, is_ending = self._control_step(
          queries, controls, is_first
      )
    except Exception:
      self._tell_of_end(~is_first, events.End.ERROR)
      raise
    has_failed = self._physics.has_diverged() & ~is_first
    step_count = self._mechanism.step_count(self._physics)
    is_late = step_count == self._single.max_steps
    is_last = (is_ending | has_failed | is_late) & ~is_first
    ends = {
        int(world): _end(has_failed[world], is_ending[world])
        for world in np.flatnonzero(is_last)
    }
    last_valid = self._observation
    self._is_pending = is_first
    self._begin_episodes()
    reads = self._look()
    for name, value in self._observation.items():
      # Nothing is read off a state that MuJoCo has reset.
      value[has_failed] = last_valid[name][has_failed]
    self._tell(is_first, has_failed, ends, records, reads, reward)
    self._is_pending = is_last
    step_type = np.where(
        is_last, int(dm_env.StepType.LAST), int(dm_env.StepType.MID)
    )
    step_type[is_first] = int(dm_env.StepType.FIRST)
    return self._time_step(
        step_type, np.where(has_failed | is_first, 1.0, discount)
    )

  def close(self) -> None:
    """Frees the worlds; closing twice does nothing."""
    if not self._closed:
      self._tell_of_end(~self._is_pending, events.End.ABANDONED)
    self._closed = True
    self._single.close()

  def _control_step(
      self, queries: np.ndarray, controls: np.ndarray, is_first: np.ndarray
  ) -> tuple[list[Any], np.ndarray, np.ndarray, np.ndarray]:
    """Does what `Environment` does, in the same order, to all worlds.

    Worlds that begin an episode next (`is_first`) go along, for nothing that
    happens in them counts; nor may it do harm.

    Returns:
      What was written and read, the true reward, the discount, and where the
      episode ends.
    """
    physics, mechanism, task = self._physics, self._mechanism, self._task
    schedule, n = self._single.schedule, self._single.num_substeps
    was_over = self._of_all(task.should_terminate_episode(physics), bool)
    task.before_step(physics, controls, None)
    records: list[Any] = [*mechanism.write_queries(physics, queries)]

    if schedule.meter_substep:
      physics.advance(schedule.meter_substep)
      task.latch_events(physics)
    is_ending = self._of_all(task.should_terminate_episode(physics), bool)
    idle = is_first | physics.has_diverged()
    records += mechanism.update_meters(physics, idle)

    if between := schedule.provider_substep - schedule.meter_substep:
      physics.advance(between)
      task.latch_events(physics)
    step = mechanism.step_count(physics)
    keys = [seeding.step_key(key, step) for key in self._keys]
    feedback, self._states = mechanism.update_providers(
        physics,
        self._observation,
        keys,
        self._states,
        is_first | physics.has_diverged(),
    )
    records += feedback

    physics.advance(n - schedule.provider_substep)
    task.after_step(physics, None)
    reward = self._true_reward()
    reward[was_over] = 0.0
    discount = self._of_all(task.get_discount(physics), float)
    is_over = self._of_all(task.should_terminate_episode(physics), bool)
    # Nobody knows of an end that the meters have not seen.
    discount[(discount != 1.0) & ~is_ending & is_over] = 1.0
    mechanism.end_step(physics, np.where(np.isfinite(reward), reward, 0.0))
    return records, reward, discount, is_ending

  def _true_reward(self) -> np.ndarray:
    """Returns the true reward, or nan where the task fails to give one."""
    try:
      return self._of_all(self._task.get_reward(self._physics), float)
    except Exception:  # Whatever a task does wrong is not the agent's business.
      return np.full(self._num_worlds, np.nan)

  def _of_all(self, value: Any, dtype: type) -> np.ndarray:
    """Returns what a task says, `(worlds,)`; it may say one thing of all."""
    return np.array(np.broadcast_to(value, (self._num_worlds,)), dtype)

  def _begin_episodes(self) -> None:
    """Begins an episode in every world that waits for one."""
    (worlds,) = np.nonzero(self._is_pending)
    if not len(worlds):
      return
    self._physics.reset(worlds)
    fresh = self._mechanism.initial_states((self._num_worlds,))
    self._states = [
        _begin_anew(state, initial, worlds)
        for state, initial in zip(self._states, fresh, strict=True)
    ]
    for world in worlds:
      self._episodes[world] += 1
      self._initialize(int(world), int(self._episodes[world]))

  def _initialize(self, world: int, episode: int) -> None:
    seed, view = self._single.seed, self._physics.world(world)
    for attempt in range(environment.MAX_RESET_ATTEMPTS):
      seeding.reseed(
          self._random_state, seed, world, episode, f'reset/{attempt}'
      )
      try:
        self._task.initialize_episode(view, self._random_state)
        for entity in self._entities:
          entity.initialize_episode(view, self._random_state)
        break
      except composer.EpisodeInitializationError:
        if attempt == environment.MAX_RESET_ATTEMPTS - 1:
          raise
        self._physics.reset(np.array([world]))
    for i in range(len(self._keys)):
      self._keys[i, world] = seeding.episode_key(
          seed, world, episode, f'providers[{i}]'
      )

  def _look(self) -> list[feedback_mechanism.Read]:
    """Makes the observation of every world; returns what agents read."""
    physics = self._physics
    physics.refresh()
    observation = {
        f'senses/{name}': value
        for name, value in self._task.senses(physics).items()
    }
    if self._single.max_steps is not None:
      spent = self._mechanism.step_count(physics) / self._single.max_steps
      observation['senses/time_left'] = np.asarray(1.0 - spent, np.float32)
    reads = self._mechanism.read_for_agent(physics)
    for read in reads:
      observation[f'registers/{read.register}'] = np.array(read.reading)
    self._observation = observation
    return reads

  def _tell(
      self,
      is_first: np.ndarray,
      has_failed: np.ndarray,
      ends: dict[int, events.End],
      records: events.Records,
      reads: events.Records,
      reward: np.ndarray,
  ) -> None:
    """Tells the sinks what happened in a step."""
    if not self._sinks:
      return
    step = events.BatchStep(
        seed=self._single.seed,
        episode=self._episodes.copy(),
        is_first=is_first,
        has_failed=has_failed,
        ends=ends,
        initial=self._mechanism.initial_writes(self._physics),
        records=records,
        agent_reads=reads,
        true_reward=reward,
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _tell_of_end(self, worlds: np.ndarray, end: events.End) -> None:
    """Tells the sinks that episodes are over, between two steps."""
    nowhere = np.zeros(self._num_worlds, bool)
    step = events.BatchStep(
        seed=self._single.seed,
        episode=self._episodes.copy(),
        is_first=nowhere,
        has_failed=~nowhere,
        ends={int(world): end for world in np.flatnonzero(worlds)},
        initial=[],
        records=[],
        agent_reads=[],
        true_reward=np.zeros(self._num_worlds),
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _time_step(
      self, step_type: np.ndarray, discount: np.ndarray
  ) -> BatchTimeStep:
    for value in self._observation.values():
      # Providers look at these arrays themselves; agents get copies.
      value.setflags(write=False)
    return BatchTimeStep(
        step_type,
        np.zeros(self._num_worlds),
        discount,
        {name: np.array(value) for name, value in self._observation.items()},
    )

  def _refuse_if_closed(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')


def _begin_anew(state: Any, initial: Any, worlds: np.ndarray) -> Any:
  """Returns a provider's state, with the initial one in some worlds."""
  if isinstance(state, dict):
    return {
        key: _begin_anew(part, initial[key], worlds)
        for key, part in state.items()
    }
  if isinstance(state, tuple | list):
    return type(state)(
        _begin_anew(part, first, worlds)
        for part, first in zip(state, initial, strict=True)
    )
  begun = np.array(state)
  begun[worlds] = np.asarray(initial)[worlds]
  return begun


def _refuse_step_hooks(task: base.Task) -> None:
  """Refuses entities that want to be called in each step: nobody would."""
  for entity in task.root_entity.iter_entities():
    for hook in ('before_step', 'after_step'):
      if getattr(type(entity), hook) is not getattr(composer.Entity, hook):
        raise errors.SpecError(
            f'{type(entity).__name__}.{hook}: a batch calls the hooks of the'
            ' task only'
        )


def _end(has_failed: bool, is_ending: bool) -> events.End:
  """Why the episode of a world has ended."""
  if has_failed:
    return events.End.DIVERGENCE
  return events.End.TERMINATED if is_ending else events.End.TIMEOUT
