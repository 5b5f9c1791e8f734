"""Many worlds with feedback, stepped together: Python is paid once for all."""

from collections.abc import Sequence
import functools
from typing import Any, NamedTuple, final

from dm_control import composer
import dm_env
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import action_codec
from realab_suite.engine import arguments
from realab_suite.engine import batch_physics
from realab_suite.engine import control_step
from realab_suite.engine import environment
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import hooks
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import seeding
from realab_suite.engine import snapshots
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms
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
  """`num_envs` copies of an environment, each with episodes of its own.

  World i is, bit for bit, the environment that `world=i` makes alone. After the
  end of its episode a world ignores one action and begins the next one, as in
  `dm_env`. Where the physics of one world fails, its episode ends and the
  others go on.
  """

  def __init__(
      self,
      single: environment.Environment,
      num_envs: int,
      num_threads: int = 0,
      sleep: bool = False,
  ) -> None:
    """Multiplies an environment; `suite.load_batch` is easier.

    Args:
      single: A freshly loaded environment with a world of this package. It
        belongs to the batch from now on.
      num_envs: How many worlds.
      num_threads: How many threads step them; 0 for all processors.
      sleep: Whether blocks at rest fall asleep; see `suite.load_batch`.

    Raises:
      SpecError: If there cannot be many of this environment.
    """
    num_envs = arguments.num_envs(num_envs)
    num_threads = arguments.num_threads(num_threads)
    sleep = arguments.flag('sleep', sleep)
    if not isinstance(single.task, base.Task):
      raise errors.SpecError(
          f'{type(single.task).__name__} compiles anew in each episode; a batch'
          ' takes worlds of this package'
      )
    hooks.refuse_in_batch(single.task, single.has_extra_hooks)
    self._single = single
    self._task: base.Task = single.task
    self._mechanism = single.mechanism
    self._physics = batch_physics.BatchPhysics(
        single.thin_physics, num_envs, num_threads, sleep
    )
    self._num_envs = num_envs
    self._sleep = sleep
    self._entities = [
        entity
        for entity in self._task.root_entity.iter_entities()
        if type(entity).initialize_episode
        is not composer.Entity.initialize_episode
    ]
    self._host = hosts.WorldHost(self._task, self._task, None, (num_envs,))
    self._observer = observing.Observer(
        self._host, self._mechanism, single.max_steps
    )
    self._random_state = seeding.random_state(single.seed, 0, 0, 'batch')
    # Restoring may give several worlds one number. Objects: seeds can be large,
    # or salted; `np.full` would drop the salt.
    self._seeds = np.array([single.seed] * num_envs, object)
    self._numbers = np.arange(num_envs).astype(object)
    self._episodes = np.full(num_envs, -1)
    self._is_pending = np.ones(num_envs, bool)
    num_providers = len(self._mechanism.design.providers)
    self._keys = np.zeros((num_providers, num_envs, 2), np.uint64)
    self._states = self._mechanism.initial_states((num_envs,))
    self._observation: dict[str, np.ndarray] = {}
    self._sinks: list[events.BatchEventSink] = []
    self._closed = False

  @property
  def original(self) -> environment.Environment:
    """The environment that the worlds are copies of."""
    return self._single

  @property
  def num_envs(self) -> int:
    """How many worlds there are."""
    return self._num_envs

  @property
  def sleep(self) -> bool:
    """Whether blocks at rest fall asleep; part of a run's configuration."""
    return self._sleep

  @property
  def physics(self) -> batch_physics.BatchPhysics:
    """The worlds themselves, for an evaluator; no agent is handed this."""
    return self._physics

  @property
  def task(self) -> base.Task:
    """The world that all are copies of."""
    return self._task

  @property
  def mechanism(self) -> mechanisms.FeedbackMechanism:
    """The registers, meters and providers."""
    return self._mechanism

  @property
  def codec(self) -> action_codec.ActionCodec:
    """What takes actions apart."""
    return self._single.codec

  def add_sink(self, sink: events.BatchEventSink) -> None:
    """Lets an evaluator hear of everything, from the next episodes on."""
    self._refuse_if_closed()
    self._tell_of_end(~self._is_pending, events.End.ABANDONED)
    self._sinks.append(sink)
    self._is_pending = np.ones(self._num_envs, bool)

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
    self._tell_of_end(~self._is_pending, events.End.ABANDONED)
    # Until the episodes have begun, the next step is to begin them.
    self._is_pending = everywhere = np.ones(self._num_envs, bool)
    self._begin_episodes(everywhere)
    reads = self._observe()
    nothing = np.zeros(self._num_envs)
    self._tell(everywhere, ~everywhere, {}, [], reads, nothing, None)
    self._is_pending = ~everywhere
    return self._time_step(
        np.full(self._num_envs, int(dm_env.StepType.FIRST)),
        np.ones(self._num_envs),
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
    queries, controls = self.codec.decode(actions, (self._num_envs,))
    if self._is_pending.all():
      return self.reset()
    is_first = self._is_pending
    # Until this step is known to be good, the next one begins all episodes.
    self._is_pending = np.ones(self._num_envs, bool)
    last_valid = self._observation
    try:
      records, ending, self._states = control_step.run(
          self._physics,
          self._host,
          self._mechanism,
          self._single.schedule,
          self._single.num_substeps,
          queries=queries,
          controls=controls,
          observation=self._observation,
          provider_keys=self._keys,
          provider_states=self._states,
          idle=lambda: is_first | self._physics.has_diverged(),
      )
      has_failed = self._physics.has_diverged() & ~is_first
      step_count = self._mechanism.step_count(self._physics)
      is_late = step_count == self._single.max_steps
      self._begin_episodes(is_first)
      reads = self._observe()
    except Exception:
      # No sink gets half a step: all episodes are over.
      self._tell_of_end(~is_first, events.End.ERROR)
      raise
    is_last = (ending.is_ending | has_failed | is_late) & ~is_first
    ends = {
        int(world): _end(has_failed[world], ending.is_ending[world])
        for world in np.flatnonzero(is_last)
    }
    for name, value in self._observation.items():
      # Nothing is read from a state that MuJoCo has reset.
      value[has_failed] = last_valid[name][has_failed]
    self._tell(
        is_first,
        has_failed,
        ends,
        records,
        reads,
        ending.true_reward,
        ending.failure,
    )
    self._is_pending = is_last
    step_type = np.where(
        is_last, int(dm_env.StepType.LAST), int(dm_env.StepType.MID)
    )
    step_type[is_first] = int(dm_env.StepType.FIRST)
    return self._time_step(
        step_type, np.where(has_failed | is_first, 1.0, ending.discount)
    )

  def save(self, worlds: Sequence[int] | None = None) -> snapshots.Snapshot:
    """Returns everything that the future of these worlds depends on.

    What the event sinks know of their episodes is part of it.

    Args:
      worlds: The indices of the worlds in the batch; `None` for all of them.

    Raises:
      SpecError: If there are no such worlds, if blocks of this batch fall
        asleep, or if a sink cannot be saved.
      StateLayoutError: If a provider's state is not plain data.
    """
    header = self._single.snapshot_header(self._physics.model)
    indices = arguments.indices(worlds, self._num_envs)
    is_pending = self._is_pending[indices]
    saved = snapshots.WorldStates(
        indices=indices.tolist(),
        physics=self._physics.state[indices],
        seed=self._seeds[indices].tolist(),
        world=self._numbers[indices].tolist(),
        episode=self._episodes[indices].tolist(),
        is_pending=is_pending.tolist(),
        is_open=(~is_pending).tolist(),
        provider_keys=list(self._keys[:, indices]),
        provider_states=snapshots.spread(self._states, indices),
        observation=snapshots.spread(self._observation, indices),
        sinks=[[sink.state_kind, sink.state(indices)] for sink in self._sinks],
        random_state=None,
    )
    return snapshots.Snapshot(header, saved.to_data())

  def restore(
      self,
      snapshot: snapshots.Snapshot,
      worlds: Sequence[int] | None = None,
  ) -> None:
    """Makes worlds what others, or these, were when they were saved.

    What follows is bit for bit what followed there, later episodes included: a
    world gets the seed and the number of the one that was saved, from which its
    random streams follow. So worlds that go on from one snapshot differ by
    their actions alone. All other worlds stay as they are. Episodes that are
    under way are abandoned; for sinks see `Environment.restore`.

    Args:
      snapshot: Of worlds of a batch, or of a world alone.
      worlds: Their indices in this batch: as many as were saved, or any number
        for a snapshot of one world; `None` for where they were.

    Raises:
      SpecError: If there are no such worlds, or if blocks of this batch fall
        asleep. Nothing has changed.
      StateLayoutError: If the snapshot does not fit. Nothing has changed.
    """
    header = self._single.snapshot_header(self._physics.model)
    saved = snapshots.WorldStates.from_data(snapshot.contents_for(header))
    if worlds is None and saved.indices is None:
      raise errors.StateLayoutError(
          'the snapshot is of a world alone; say into which worlds it goes, as'
          ' in restore(snapshot, worlds=[0])'
      )
    indices = arguments.indices(
        saved.indices if worlds is None else worlds, self._num_envs
    )
    if len(saved.seed) not in (1, len(indices)):
      raise errors.StateLayoutError(
          f'the snapshot has {len(saved.seed)} worlds, for {len(indices)} here;'
          ' allowed are as many, or one'
      )
    saved.refuse_other_sinks([sink.state_kind for sink in self._sinks])
    # Where in the snapshot each of the worlds is.
    rows = np.arange(len(indices)) % len(saved.seed)
    has_begun = bool(saved.observation)
    filled, sources = indices, rows
    if has_begun and not self._observation:
      # Every world here waits for its first episode; until that begins, those
      # that stay have to be in some state that makes sense.
      filled = np.arange(self._num_envs)
      sources = np.zeros(self._num_envs, int)
      sources[indices] = rows
    if has_begun:
      states, observation = saved.merged_into(
          self._states, self._observation, filled, sources
      )
    # Nothing has changed so far, and nothing is refused from here on.
    is_restored = np.isin(np.arange(self._num_envs), indices)
    self._tell_of_end(is_restored & ~self._is_pending, events.End.ABANDONED)
    self._is_pending = self._is_pending | is_restored
    if has_begun:
      self._physics.set_state(filled, saved.physics[sources])
      self._states, self._observation = states, observation
      for kept, keys in zip(self._keys, saved.provider_keys, strict=True):
        kept[filled] = keys[sources]
    self._seeds = _with(self._seeds, indices, saved.seed)
    self._numbers = _with(self._numbers, indices, saved.world)
    self._episodes = _with(self._episodes, indices, saved.episode)
    for sink, (_, known) in zip(self._sinks, saved.sinks, strict=False):
      sink.set_state(indices, [known[row] for row in rows])
    self._is_pending = _with(self._is_pending, indices, saved.is_pending)

  def render(
      self,
      worlds: Sequence[int] | None = None,
      camera: str = 'top_down',
      height: int = 240,
      width: int = 320,
  ) -> np.ndarray:
    """Draws worlds for people; what agents see is in their observations.

    Args:
      worlds: The indices of the worlds in the batch; `None` for all of them.
      camera: The name of a camera of the model.
      height: Of a frame, pixels.
      width: Of a frame, pixels.

    Returns:
      `(worlds, height, width, 3)` uint8.

    Raises:
      SpecError: If there is no such world or camera.
      RenderingError: If nothing renders here, or not frames of this size.
    """
    self._refuse_if_closed()
    cameras = self._task.root_entity.mjcf_model.find_all('camera')
    names = [element.full_identifier for element in cameras]
    if camera not in names:
      raise errors.SpecError(f'camera: {camera!r}; allowed are {names}')
    indices = arguments.indices(worlds, self._num_envs).tolist()
    return self._physics.render(indices, camera, height, width)

  def close(self) -> None:
    """Frees the worlds; closing twice does nothing."""
    if not self._closed:
      self._tell_of_end(~self._is_pending, events.End.ABANDONED)
    self._closed = True
    self._single.close()

  def _begin_episodes(self, where: np.ndarray) -> None:
    """Begins an episode in some worlds, `(worlds,)` bool."""
    (worlds,) = np.nonzero(where)
    if not len(worlds):
      return
    self._states = self._mechanism.restart_states(
        self._states, worlds, self._num_envs
    )
    self._physics.reset(worlds)
    for world in worlds.tolist():
      self._episodes[world] += 1
      stream = (
          self._seeds[world],
          self._numbers[world],
          int(self._episodes[world]),
      )
      episodes.begin(
          self._random_state,
          *stream,
          functools.partial(self._initialize, world),
      )
      self._keys[:, world] = episodes.provider_keys(*stream, len(self._keys))

  def _initialize(self, world: int, attempt: int) -> None:
    """Initializes the task and its entities in a world that has been reset."""
    if attempt:
      self._physics.reset(np.array([world]))
    view = self._physics.world(world)
    self._task.initialize_episode(view, self._random_state)
    for entity in self._entities:
      entity.initialize_episode(view, self._random_state)

  def _observe(self) -> list[Any]:
    """Makes the observation of every world; returns the agents' reads."""
    self._physics.refresh()
    self._observation, reads = self._observer.observe(self._physics)
    return list(reads)

  def _tell(
      self,
      is_first: np.ndarray,
      has_failed: np.ndarray,
      ends: dict[int, events.End],
      records: events.Records,
      reads: Sequence[registers.Read],
      reward: np.ndarray,
      failure: str | None,
  ) -> None:
    """Notifies the sinks of a step."""
    if not self._sinks:
      return
    step = events.BatchStep(
        seed=self._seeds,
        world=self._numbers,
        episode=self._episodes.copy(),
        is_first=is_first,
        has_failed=has_failed,
        ends=ends,
        initial=self._mechanism.initial_writes(self._physics),
        records=records,
        agent_reads=reads,
        true_reward=reward,
        failure=failure,
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _tell_of_end(self, worlds: np.ndarray, end: events.End) -> None:
    """Tells the sinks that episodes are over, between two steps."""
    if not worlds.any():
      return
    step = events.BatchStep.between(
        self._seeds,
        self._numbers,
        self._episodes.copy(),
        {int(world): end for world in np.flatnonzero(worlds)},
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _time_step(
      self, step_type: np.ndarray, discount: np.ndarray
  ) -> BatchTimeStep:
    return BatchTimeStep(
        step_type,
        np.zeros(self._num_envs),
        discount,
        observing.copied(observing.frozen(self._observation)),
    )

  def _refuse_if_closed(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')


def _with(values: np.ndarray, indices: np.ndarray, others: Any) -> np.ndarray:
  """Returns a copy of an array, some of whose elements are others."""
  copy = np.array(values)
  copy[indices] = others
  return copy


def _end(has_failed: bool, is_ending: bool) -> events.End:
  """Why the episode of a world has ended."""
  if has_failed:
    return events.End.DIVERGENCE
  return events.End.TERMINATED if is_ending else events.End.TIMEOUT
