"""Batches: many worlds with feedback that are stepped together."""

from collections.abc import Sequence
import functools
from typing import Any, final

import dm_env
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite import trees
from realab_suite.engine import action_codec
from realab_suite.engine import arguments
from realab_suite.engine import batch_physics
from realab_suite.engine import batch_time_steps
from realab_suite.engine import control_step
from realab_suite.engine import environment
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import hooks
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import seeding
from realab_suite.engine import snapshots
from realab_suite.entities import axes
from realab_suite.feedback import mechanisms
from realab_suite.policies import action_sets
from realab_suite.tasks import base


@final
class BatchEnvironment:
  """A batch of `num_envs` copies of an environment, with separate episodes.

  World i equals, bit for bit, the single environment with `world=i`. After its
  episode has ended, a world ignores one action and begins the next episode, as
  in `dm_env`. If the physics of a world fails, its episode ends and the other
  worlds continue.
  """

  def __init__(
      self,
      single: environment.Environment,
      num_envs: int,
      num_threads: int = 0,
      sleep: bool = False,
  ) -> None:
    """Initializes the batch. Prefer `suite.load_batch`.

    Args:
      single: New environment with a task of this package. The batch takes
        ownership of it.
      num_envs: Number of worlds.
      num_threads: Number of threads that step them; 0 for all processors.
      sleep: True to let blocks at rest sleep; see `suite.load_batch`.

    Raises:
      SpecError: If the task, a hook or a number is not allowed in a batch.
    """
    num_envs = arguments.num_envs(num_envs)
    num_threads = arguments.num_threads(num_threads)
    sleep = arguments.flag('sleep', sleep)
    hooks.refuse_in_batch(single.task, single.has_extra_hooks)
    self._single = single
    self._task: base.Task = single.task
    self._mechanism = single.mechanism
    self._physics = batch_physics.BatchPhysics(
        single.thin_physics, num_envs, num_threads, sleep
    )
    self._num_envs = num_envs
    self._sleep = sleep
    self._entities = hooks.with_start(self._task)
    self._host = hosts.WorldHost(self._task, (num_envs,))
    self._observer = observing.Observer(
        self._task,
        self._task.sense_spec,
        self._host.sense,
        self._mechanism,
        single.max_steps,
        single.senses,
    )
    self._random_state = seeding.random_state(single.seed, 0, 0, 'batch')
    # `restore` may give several worlds the same number. Arrays of objects keep
    # large seeds.
    self._seeds = seeding.seeds(single.seed, num_envs)
    self._world_numbers = np.arange(num_envs).astype(object)
    self._episodes = np.full(num_envs, -1)
    self._is_pending = np.ones(num_envs, bool)
    # False also for worlds that were restored, of which sinks get nothing.
    self._is_open = np.zeros(num_envs, bool)
    num_providers = len(self._mechanism.design.providers)
    self._keys = np.zeros((num_providers, num_envs, 2), np.uint64)
    self._states = self._mechanism.phases.initial_states((num_envs,))
    self._observation: dict[str, np.ndarray] = {}
    self._sinks: list[events.BatchEventSink] = []
    self._closed = False

  @property
  def original(self) -> environment.Environment:
    """Environment that the worlds are copies of."""
    return self._single

  @property
  def num_envs(self) -> int:
    """Number of worlds."""
    return self._num_envs

  @property
  def sleep(self) -> bool:
    """True if blocks at rest sleep; part of a run's configuration."""
    return self._sleep

  @property
  def physics(self) -> batch_physics.BatchPhysics:
    """Physics of all worlds, for evaluators; agents do not get it."""
    self._refuse_if_unusable()
    return self._physics

  @property
  def action_set(self) -> action_sets.ActionSet:
    """Actions that policies choose from: the design's, or the task's."""
    return self._single.action_set

  @property
  def task(self) -> base.Task:
    """Task of all worlds."""
    return self._task

  @property
  def mechanism(self) -> mechanisms.FeedbackMechanism:
    """Registers, meters and providers."""
    return self._mechanism

  @property
  def codec(self) -> action_codec.ActionCodec:
    """Checks and splits actions."""
    return self._single.codec

  @property
  def sinks(self) -> list[events.BatchEventSink]:
    """Event sinks, in the order in which they were added."""
    return [*self._sinks]

  def add_sink(self, sink: events.BatchEventSink) -> None:
    """Abandons the current episodes and notifies a sink of all later ones."""
    self._refuse_if_unusable()
    self._end_episodes(True, events.End.ABANDONED)
    self._sinks.append(sink)
    self._is_pending = np.ones(self._num_envs, bool)

  def remove_sink(self, sink: events.BatchEventSink) -> None:
    """Undoes `add_sink`."""
    self._sinks.remove(sink)

  def rewind(self, random: int | Sequence[int | None] | None = None) -> None:
    """Abandons the current episodes; the next one of every world is the first.

    Args:
      random: New seed of all worlds, or a seed for each world; `None` for the
        present seeds. In a sequence, the next episode of a world with `None` is
        the one after its current episode.

    Raises:
      SpecError: If a seed is invalid.
    """
    self._refuse_if_unusable()
    seeds = self._seeds
    if random is not None:
      seeds = seeding.seeds(random, self._num_envs)
    is_first = np.array([seed is not None for seed in seeds])
    self._end_episodes(True, events.End.ABANDONED)
    self._seeds = np.where(is_first, seeds, self._seeds)
    self._episodes = np.where(is_first, -1, self._episodes)
    self._is_pending = np.ones(self._num_envs, bool)

  def abandon(self, worlds: Sequence[int]) -> None:
    """Abandons the current episodes of worlds; `step` begins the next ones.

    Args:
      worlds: Indices of the worlds.

    Raises:
      SpecError: If there is no such world.
    """
    self._refuse_if_unusable()
    indices = arguments.indices(worlds, self._num_envs)
    is_abandoned = np.isin(np.arange(self._num_envs), indices)
    self._end_episodes(is_abandoned, events.End.ABANDONED)
    self._is_pending = self._is_pending | is_abandoned

  def action_spec(self) -> specs.Array:
    """Returns the spec of one action; `step` takes `(worlds, *spec.shape)`."""
    return self._single.action_spec()

  def observation_spec(self) -> dict[str, specs.Array]:
    """Returns the observation spec of one world."""
    return self._single.observation_spec()

  def reset(
      self, worlds: Sequence[int] | None = None
  ) -> batch_time_steps.BatchTimeStep:
    """Starts the next episodes of worlds and abandons their current ones.

    Other worlds do not change.

    Args:
      worlds: Indices of the worlds; `None` for all of them.

    Returns:
      The first time steps of these worlds, in their order.

    Raises:
      SpecError: If there is no such world.
    """
    self._refuse_if_unusable()
    indices = arguments.indices(worlds, self._num_envs)
    is_first = np.isin(np.arange(self._num_envs), indices)
    was_pending = self._is_pending
    self._end_episodes(is_first, events.End.ABANDONED)
    # If anything fails here, the next step begins all episodes.
    self._is_pending = np.ones(self._num_envs, bool)
    previous_observation = self._observation
    try:
      self._begin_episodes(is_first)
      reads = self._observe()
    except Exception:
      self._end_episodes(True, events.End.ERROR)
      raise
    for name, value in previous_observation.items():
      # MuJoCo has reset the state of worlds that failed.
      self._observation[name][~is_first] = value[~is_first]
    self._notify(
        {},
        is_first=is_first,
        has_failed=~is_first,
        records=[],
        agent_reads=reads,
        action=np.zeros(self._num_envs),
        true_reward=np.zeros(self._num_envs),
    )
    self._is_pending = was_pending & ~is_first
    self._is_open |= is_first
    first = np.full(self._num_envs, int(dm_env.StepType.FIRST))
    return self._time_step(first, np.ones(self._num_envs)).take(indices)

  def step(self, actions: Any) -> batch_time_steps.BatchTimeStep:
    """Runs one control step of every world.

    Args:
      actions: Actions, `(worlds, *action_spec.shape)`.

    Raises:
      ActionError: If an action does not satisfy `action_spec`; the message
        names the first such world. No world has changed.
    """
    self._refuse_if_unusable()
    queries, controls = self.codec.decode(actions, (self._num_envs,))
    if self._is_pending.all():
      return self.reset()
    is_first = self._is_pending
    # If anything fails here, the next step begins all episodes.
    self._is_pending = np.ones(self._num_envs, bool)
    last_valid = self._observation
    try:
      outcome = control_step.run(
          self._physics,
          self._host,
          self._mechanism.phases,
          self._single.schedule,
          self._single.num_substeps,
          queries=queries,
          controls=controls,
          observation=self._observer.for_providers(
              self._physics, self._observation
          ),
          provider_keys=self._keys,
          provider_states=self._states,
          where=lambda: axes.both(
              ~(is_first | self._physics.has_diverged()), None
          ),
      )
      self._states, ending = outcome.provider_states, outcome.ending
      has_failed = self._physics.has_diverged() & ~is_first
      is_late = outcome.num_steps == self._single.max_steps
      self._begin_episodes(is_first)
      reads = self._observe()
    except Exception:
      # Sinks never get a partial step: all episodes end.
      self._end_episodes(True, events.End.ERROR)
      raise
    is_over = ending.is_ending
    is_signalled = self._mechanism.phases.ends_episode(reads) & ~is_first
    is_last = (has_failed | is_over | is_signalled | is_late) & ~is_first
    ends = episodes.ends_of_step(
        has_failed, is_over, is_signalled, is_last & self._is_open
    )
    for name, value in self._observation.items():
      # MuJoCo has reset the state of worlds that failed.
      value[has_failed] = last_valid[name][has_failed]
    self._notify(
        ends,
        is_first=is_first,
        has_failed=has_failed | ~(is_first | self._is_open),
        records=outcome.records,
        agent_reads=reads,
        action=np.array(actions),
        true_reward=ending.true_reward,
        failure=ending.failure,
    )
    self._is_pending = is_last
    self._is_open = (self._is_open | is_first) & ~is_last
    step_type = np.where(
        is_last, int(dm_env.StepType.LAST), int(dm_env.StepType.MID)
    )
    step_type[is_first] = int(dm_env.StepType.FIRST)
    discount = np.where(is_signalled & ~is_over, 0.0, ending.discount)
    return self._time_step(
        step_type, np.where(has_failed | is_first, 1.0, discount)
    )

  def save(self, worlds: Sequence[int] | None = None) -> snapshots.Snapshot:
    """Returns a snapshot of worlds, from which `restore` continues.

    Args:
      worlds: Indices of the worlds in the batch; `None` for all of them.

    Raises:
      SpecError: If `worlds` is invalid, or if blocks of this batch can sleep.
      StateLayoutError: If a provider's state is not plain data.
    """
    header = self._single.snapshot_header(self._physics.model)
    indices = arguments.indices(worlds, self._num_envs)
    saved = snapshots.WorldStates(
        indices=indices.tolist(),
        physics=self._physics.state[indices],
        seed=self._seeds[indices].tolist(),
        world=self._world_numbers[indices].tolist(),
        episode=self._episodes[indices].tolist(),
        is_pending=self._is_pending[indices].tolist(),
        provider_keys=list(self._keys[:, indices]),
        provider_states=trees.taken(self._states, indices),
        observation=trees.taken(self._observation, indices),
        random_state=None,
    )
    return snapshots.Snapshot(header, saved._asdict())

  def restore(
      self,
      snapshot: snapshots.Snapshot,
      worlds: Sequence[int] | None = None,
  ) -> None:
    """Sets worlds to the states in a snapshot.

    They continue bit for bit like the saved worlds, including later episodes: a
    restored world gets the seed and the number of the saved one, which
    determine its random streams. Worlds that were restored from the same
    snapshot therefore differ only by their actions. Other worlds do not change.
    The current episodes of the restored worlds are abandoned. For sinks, see
    `Environment.restore`.

    Args:
      snapshot: Snapshot of worlds of a batch, or of a single world.
      worlds: Indices of the worlds to restore: as many as were saved, or any
        number for a snapshot of one world; `None` for the saved indices.

    Raises:
      SpecError: If `worlds` is invalid, or if blocks of this batch can sleep.
        The state is unchanged.
      StateLayoutError: If the snapshot does not fit. The state is unchanged.
    """
    self._refuse_if_unusable()
    header = self._single.snapshot_header(self._physics.model)
    saved = snapshots.WorldStates.from_snapshot(snapshot, header)
    indices = saved.indices_for(worlds, self._num_envs)
    rows = np.arange(len(indices)) % len(saved.seed)
    has_begun = bool(saved.observation)
    filled, sources = indices, rows
    if has_begun and not self._observation:
      # No world has begun an episode yet, so the other worlds get copies of the
      # saved states until they begin one.
      filled = np.arange(self._num_envs)
      sources = np.zeros(self._num_envs, int)
      sources[indices] = rows
    if has_begun:
      states, observation = saved.merged_into(
          self._states, self._observation, filled, sources
      )
    # Nothing has changed so far, and nothing fails from here on.
    is_restored = np.isin(np.arange(self._num_envs), indices)
    self._end_episodes(is_restored, events.End.ABANDONED)
    self._is_pending = self._is_pending | is_restored
    if has_begun:
      self._physics.set_state(filled, saved.physics[sources])
      self._states, self._observation = states, observation
      for kept, keys in zip(self._keys, saved.provider_keys, strict=True):
        kept[filled] = keys[sources]
    replaced = snapshots.replaced
    self._seeds = replaced(self._seeds, indices, saved.seed)
    self._world_numbers = replaced(self._world_numbers, indices, saved.world)
    self._episodes = replaced(self._episodes, indices, saved.episode)
    self._is_pending = replaced(self._is_pending, indices, saved.is_pending)

  def render(
      self,
      worlds: Sequence[int] | None = None,
      camera: str = 'top_down',
      height: int = 240,
      width: int = 320,
  ) -> np.ndarray:
    """Renders worlds for people. Observations contain the frames for agents.

    Args:
      worlds: Indices of the worlds in the batch; `None` for all of them.
      camera: Name of a camera of the model.
      height: Height of a frame, in pixels.
      width: Width of a frame, in pixels.

    Returns:
      The frames, `(worlds, height, width, 3)` uint8.

    Raises:
      SpecError: If there is no such world or camera, or the model has no room
        for the size.
      RenderingError: If no renderer is available, or if it fails.
    """
    self._refuse_if_unusable()
    arguments.camera(camera, self._task.root_entity.mjcf_model)
    indices = arguments.indices(worlds, self._num_envs).tolist()
    return self._physics.render(indices, camera, height, width)

  def close(self) -> None:
    """Frees the worlds. Closing them again has no effect."""
    if not self._closed:
      self._end_episodes(True, events.End.ABANDONED)
    self._closed = True
    self._single.close()

  def __reduce__(self) -> Any:
    return self._single.__reduce__()  # It refuses.

  def _begin_episodes(self, where: np.ndarray) -> None:
    """Begins an episode in each world where the mask `(worlds,)` is True."""
    (worlds,) = np.nonzero(where)
    if not len(worlds):
      return
    self._states = self._mechanism.phases.restart_states(
        self._states, worlds, self._num_envs
    )
    self._physics.reset(worlds)
    for world in worlds.tolist():
      self._episodes[world] += 1
      stream = (
          self._seeds[world],
          self._world_numbers[world],
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
    self._single.check_start(view)

  def _observe(self) -> list[Any]:
    """Updates the observation and returns the reads of registers for it."""
    self._observation, reads = self._observer.observe(self._physics)
    return list(reads)

  def _notify(self, ends: dict[int, events.End], **fields: Any) -> None:
    """Notifies the sinks of a control step; see `events.BatchStep`."""
    if not self._sinks:
      return
    step = events.BatchStep(
        seed=self._seeds,
        world=self._world_numbers,
        episode=self._episodes.copy(),
        ends=ends,
        initial=self._mechanism.phases.initial_writes(self._physics),
        **fields,
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _end_episodes(self, where: bool | np.ndarray, end: events.End) -> None:
    """Notifies the sinks that episodes have ended between two steps.

    Args:
      where: Worlds whose episodes end, if they are open, `(worlds,)` bool.
      end: Reason that the sinks get.
    """
    worlds = self._is_open & where
    if not worlds.any():
      return
    self._is_open = self._is_open & ~worlds
    step = events.BatchStep.between(
        self._seeds,
        self._world_numbers,
        self._episodes.copy(),
        {int(world): end for world in np.flatnonzero(worlds)},
    )
    for sink in self._sinks:
      sink.step_ended(step)

  def _time_step(
      self, step_type: np.ndarray, discount: np.ndarray
  ) -> batch_time_steps.BatchTimeStep:
    return batch_time_steps.BatchTimeStep(
        step_type,
        np.zeros(self._num_envs),
        discount,
        observing.copied(observing.frozen(self._observation)),
    )

  def _refuse_if_unusable(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')
    self._physics.refuse_forks()
