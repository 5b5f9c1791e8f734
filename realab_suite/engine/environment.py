"""One world with feedback, as a `dm_env` environment without a reward channel.

This module and `foreign` alone use private parts of `composer.Environment`;
they are those of dm_control 1.0.50, and a test fails when they change.
"""

import contextlib
from typing import Any, final

from dm_control import composer
from dm_control.rl import control
import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import action_codec
from realab_suite.engine import control_step
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import foreign
from realab_suite.engine import hooks
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import seeding
from realab_suite.engine import single_physics
from realab_suite.engine import snapshots
from realab_suite.entities import state
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.tasks import base


@final
class Environment(composer.Environment):
  """A world, a feedback mechanism, and the data channel of an agent.

  `reward` is the constant 0.0; feedback comes as observations
  `registers/<name>`. The true reward goes to the event sinks only.

  One control step is the list in `docs/architecture.md`.
  """

  def __init__(
      self,
      task: composer.Task,
      mechanism: mechanisms.FeedbackMechanism,
      *,
      seed: int,
      world: int = 0,
      max_steps: int | None = None,
  ) -> None:
    """Makes the environment; `suite.load` and `suite.embed` are easier.

    Args:
      task: The world, with `mechanism` attached to its root entity.
      mechanism: The feedback.
      seed: Seed of every random stream, together with `world`.
      world: Number of the world in a batch.
      max_steps: Length of an episode in control steps, or `None`.
    """
    self._physics: single_physics.ThinPhysics | foreign.ForeignPhysics
    self._mechanism = mechanism
    self._seed, self._world, self._episode = seed, world, -1
    self._max_steps = max_steps
    self._sinks: list[events.EventSink] = []
    self._closed = False
    self._has_extra_hooks = False
    # Worlds of this package compile once and have no hooks in substeps. Other
    # tasks are treated as Composer does.
    self._is_ours = isinstance(task, base.Task)
    if isinstance(task, base.Task):
      hooks.refuse_in_substeps(task)
    super().__init__(
        task,
        random_state=seeding.random_state(seed, world, 0, 'construction'),
        recompile_mjcf_every_episode=not self._is_ours,
        strip_singleton_obs_buffer_dim=True,
    )
    self._host: hosts.Host
    if isinstance(task, base.Task):
      self._host = hosts.WorldHost(task, self._hooks, self._random_state, ())
    else:
      self._host = foreign.ForeignHost(
          task,
          self._hooks,
          self._random_state,
          lambda: self._observation_updater,
          has_registers=bool(mechanism.registers),
      )
    self._observer = observing.Observer(self._host, mechanism, max_steps)
    self._schedule = mechanism.design.schedule_for(self._n_sub_steps)
    chosen = mechanism.design.action_set
    self._codec = action_codec.ActionCodec(
        task.action_spec(self._physics_proxy),
        [register.value_spec for register in mechanism.queries],
        None
        if chosen is None
        else action_sets.get(chosen.name, chosen.version),
        mechanism.design.integer_queries(),
    )
    self._observation: dict[str, np.ndarray] = {}
    self._provider_keys = self._new_provider_keys()
    self._provider_states: list[Any] = []
    self._episode_is_open = False

  # The evaluator's and the launchers' side; no agent gets this object.

  @property
  def mechanism(self) -> mechanisms.FeedbackMechanism:
    """The registers, meters and providers."""
    return self._mechanism

  @property
  def seed(self) -> int:
    """Seed of every random stream."""
    return self._seed

  @property
  def world(self) -> int:
    """Number of the world in a batch; 0 for one alone."""
    return self._world

  @property
  def max_steps(self) -> int | None:
    """Length of an episode in control steps, or `None`."""
    return self._max_steps

  @property
  def num_substeps(self) -> int:
    """Number of physics substeps in a control step."""
    return self._n_sub_steps

  @property
  def codec(self) -> action_codec.ActionCodec:
    """Checks and splits actions."""
    return self._codec

  @property
  def schedule(self) -> specs.ScheduleSpec:
    """Substeps after which meters and providers act."""
    return self._schedule

  @property
  def has_extra_hooks(self) -> bool:
    """Whether `add_extra_hook` was called."""
    return self._has_extra_hooks

  @property
  def thin_physics(self) -> single_physics.ThinPhysics:
    """The physics itself, which is compiled once.

    Raises:
      SpecError: If the task is not one of this package's worlds.
    """
    if not isinstance(self._physics, single_physics.ThinPhysics):
      raise errors.SpecError(
          f'{type(self._task).__name__} is stepped as Composer would step it'
      )
    return self._physics

  def add_extra_hook(self, hook_name: str, hook_callable: Any) -> None:
    """Adds a hook, as in `composer.Environment`.

    Args:
      hook_name: One of `composer.HOOK_NAMES`.
      hook_callable: Function with the arguments of the task's own hook.

    Raises:
      SpecError: If this environment never calls such a hook.
    """
    self._refuse_if_closed()
    if isinstance(self._task, base.Task):
      hooks.refuse_unused(self._task, hook_name)
    super().add_extra_hook(hook_name, hook_callable)
    self._has_extra_hooks = True

  def add_sink(self, sink: events.EventSink) -> None:
    """Notifies a sink of all events, from the next episode on."""
    self._refuse_if_closed()
    self._abandon()
    self._sinks.append(sink)
    self._reset_next_step = True

  def remove_sink(self, sink: events.EventSink) -> None:
    """Undoes `add_sink`."""
    self._sinks.remove(sink)

  def rewind(self, episode: int = 0) -> None:
    """Makes `episode` the next one; paired comparisons start from the same."""
    self._refuse_if_closed()
    if episode < 0:
      raise errors.SpecError(f'episode: {episode}; allowed are 0 and more')
    self._abandon()
    self._episode = episode - 1
    self._reset_next_step = True

  def abandon(self, end: events.End = events.End.ABANDONED) -> None:
    """Ends the episode that is under way, if one is; the next step resets.

    Args:
      end: Why.
    """
    self._refuse_if_closed()
    self._abandon(end)
    self._reset_next_step = True

  def save(self) -> snapshots.Snapshot:
    """Returns everything that the future of this world depends on.

    The event sinks' records of the episode are part of it.

    Raises:
      SpecError: If the world is somebody else's, or a sink cannot be saved.
      StateLayoutError: If a provider's state is not plain data.
    """
    header = self.snapshot_header()
    worlds = snapshots.WorldStates(
        indices=None,
        physics=snapshots.get_state(self._physics)[np.newaxis],
        seed=[self._seed],
        world=[self._world],
        episode=[self._episode],
        is_pending=[self._reset_next_step],
        is_open=[self._episode_is_open],
        provider_keys=[key[np.newaxis] for key in self._provider_keys],
        provider_states=self._provider_states,
        observation=snapshots.of_batch(self._observation),
        sinks=[[sink.state_kind, [sink.state()]] for sink in self._sinks],
        random_state=self._random_state.get_state(legacy=False),
    )
    return snapshots.Snapshot(header, worlds.to_data())

  def restore(self, snapshot: snapshots.Snapshot) -> None:
    """Makes this world what another one, or this one, was when it was saved.

    What follows is bit for bit what followed there, later episodes included:
    the seed is restored, too. The episode that is under way is abandoned. An
    environment without sinks takes any snapshot that fits; one with sinks,
    those that were saved with sinks of the same kinds.

    Args:
      snapshot: Of one world, alone or of a batch.

    Raises:
      SpecError: If the world is somebody else's.
      StateLayoutError: If the snapshot does not fit. Nothing has changed.
    """
    header = self.snapshot_header()
    saved = snapshots.WorldStates.from_data(snapshot.contents_for(header))
    if len(saved.seed) != 1:
      raise errors.StateLayoutError(
          f'the snapshot has {len(saved.seed)} worlds; allowed here is one, as'
          ' in batch.save([3])'
      )
    saved.refuse_other_sinks([sink.state_kind for sink in self._sinks])
    self._abandon()
    # Whatever goes wrong from here on, the next step starts with a reset.
    self._reset_next_step = True
    snapshots.set_state(self._physics, saved.physics[0])
    (self._seed,), (self._world,) = saved.seed, saved.world
    (self._episode,) = saved.episode
    if saved.random_state is None:  # A world of a batch has no generator.
      seeding.reseed(
          self._random_state, self._seed, self._world, 0, 'construction'
      )
    else:
      self._random_state.set_state(saved.random_state)
    for here, there in zip(
        self._provider_keys, saved.provider_keys, strict=True
    ):
      here[:] = there[0]
    self._provider_states = (
        saved.provider_states
        if saved.indices is None
        else snapshots.of_world(saved.provider_states)
    )
    self._observation = observing.frozen(
        {key: np.array(value[0]) for key, value in saved.observation.items()}
    )
    for sink, (_, states) in zip(self._sinks, saved.sinks, strict=False):
      sink.set_state(states[0])
    (self._episode_is_open,) = saved.is_open
    (self._reset_next_step,) = saved.is_pending

  def snapshot_header(self, model: Any = None) -> dict[str, Any]:
    """Returns what a snapshot and this environment have to have in common.

    Args:
      model: The compiled model, as `physics.model`; `None` for this one's own.

    Raises:
      SpecError: If there are no snapshots of this environment.
    """
    self._refuse_if_closed()
    if not isinstance(self._task, base.Task):
      raise errors.SpecError(
          f'{type(self._task).__name__} cannot be saved or restored: a task'
          ' that is no realab_suite.tasks.base.Task may compile its model anew'
          ' and keep state in Python'
      )
    return {
        **snapshots.describe(self._physics.model if model is None else model),
        'task': type(self._task).__name__,
        'dynamics': self._task.DYNAMICS_VERSION,
        'design': self._mechanism.design.digest(),
        'num_substeps': self._n_sub_steps,
        'max_steps': self._max_steps,
        'observation': {
            key: f'{spec.dtype} {spec.shape}'
            for key, spec in self.observation_spec().items()
        },
    }

  # The agent's side: `dm_env.Environment`.

  def action_spec(self) -> dm_env_specs.Array:
    self._refuse_if_closed()
    return self._codec.spec

  def reward_spec(self) -> dm_env_specs.BoundedArray:
    self._refuse_if_closed()
    return dm_env_specs.BoundedArray((), np.float64, 0.0, 0.0, name='reward')

  def discount_spec(self) -> dm_env_specs.BoundedArray:
    self._refuse_if_closed()
    return dm_env_specs.BoundedArray((), np.float64, 0.0, 1.0, name='discount')

  def observation_spec(self) -> dict[str, dm_env_specs.Array]:
    self._refuse_if_closed()
    return self._observer.spec()

  def reset(self) -> dm_env.TimeStep:
    """Starts the next episode and returns its FIRST time step."""
    self._refuse_if_closed()
    self._abandon()
    # Whatever goes wrong from here on, the next step starts with a reset.
    self._reset_next_step = True
    self._episode += 1
    episodes.begin(
        self._random_state,
        self._seed,
        self._world,
        self._episode,
        self._initialize_episode,
    )
    self._provider_keys = self._new_provider_keys()
    self._provider_states = self._mechanism.initial_states(())
    records: list[Any] = [*self._mechanism.initial_writes(self._physics)]
    records += self._observe()
    start = events.Start(self._seed, self._world, self._episode, records)
    with self._undisturbed():
      for sink in self._sinks:
        sink.episode_started(start, self._physics_proxy)
    # Unless every sink took its beginning, there is no episode.
    self._reset_next_step = False
    self._episode_is_open = True
    return dm_env.restart(observing.copied(self._observation))

  def step(self, action: Any) -> dm_env.TimeStep:
    """Runs one control step and returns its time step.

    Raises:
      ActionError: If the action does not fit `action_spec`. Nothing has moved.
      FeedbackProviderError: If a provider failed. The episode is over.
      RegisterValueError: If a provider wrote what cannot be stored. The episode
        is over.
    """
    self._refuse_if_closed()
    queries, controls = self._codec.decode(action)
    if self._reset_next_step:
      return self.reset()
    # Until this step is known to be good, the next one starts with a reset.
    self._reset_next_step = True
    try:
      outcome = self._control_step(queries, controls)
      records = outcome.records + self._observe()
    except control.PhysicsError:
      self._end(events.End.DIVERGENCE)
      # The agent learns that time is up and nothing else: no register is read
      # from a state that MuJoCo has reset.
      return dm_env.truncation(0.0, observing.copied(self._observation), 1.0)
    except Exception:
      self._end(events.End.ERROR)
      raise
    ending = outcome.ending
    self._provider_states = outcome.provider_states
    with self._undisturbed():
      step = events.Step(records, np.array(ending.true_reward), ending.failure)
      for sink in self._sinks:
        sink.step_ended(step, self._physics_proxy)
    observation = observing.copied(self._observation)
    if ending.is_ending:
      self._end(events.End.TERMINATED)
      return dm_env.TimeStep(
          dm_env.StepType.LAST, 0.0, float(ending.discount), observation
      )
    if self._mechanism.step_count(self._physics) == self._max_steps:
      self._end(events.End.TIMEOUT)
      return dm_env.truncation(0.0, observation, 1.0)
    self._reset_next_step = False
    return dm_env.transition(0.0, observation, float(ending.discount))

  def close(self) -> None:
    """Frees the world; closing twice does nothing."""
    if self._closed:
      return
    self._abandon()
    self._closed = True
    super().close()

  def __reduce__(self) -> Any:
    raise TypeError(
        'environments cannot be pickled or copied; pass a design on and build'
        ' the environment where it is used'
    )

  def __deepcopy__(self, memo: Any) -> Any:
    return self.__reduce__()

  def _control_step(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> control_step.Outcome:
    return control_step.run(
        # Composer hands its hooks a proxy.
        self._physics if self._is_ours else self._physics_proxy,
        self._host,
        self._mechanism,
        self._schedule,
        self._n_sub_steps,
        queries=queries,
        controls=controls,
        observation=self._observation,
        provider_keys=self._provider_keys,
        provider_states=self._provider_states,
    )

  def _observe(self) -> list[Any]:
    """Makes the next observation; returns the reads of registers for it."""
    observation, reads = self._observer.observe(self._physics)
    self._observation = observing.frozen(observation)
    return list(reads)

  def _undisturbed(self) -> contextlib.AbstractContextManager[None]:
    """Returns a context in which sinks may look at the physics."""
    if isinstance(self._physics, foreign.ForeignPhysics) and self._sinks:
      return self._physics.unchanged()
    return contextlib.nullcontext()

  # Episodes.

  def _new_provider_keys(self) -> np.ndarray:
    return episodes.provider_keys(
        self._seed,
        self._world,
        max(self._episode, 0),
        len(self._mechanism.design.providers),
    )

  def _initialize_episode(self, attempt: int) -> None:
    del attempt  # Every attempt resets the physics.
    if self._recompile_mjcf_every_episode:
      self._hooks.initialize_episode_mjcf(self._random_state)
      self._recompile_physics_and_update_observables()
    with self._physics.reset_context():
      self._hooks.initialize_episode(self._physics_proxy, self._random_state)
    if not self._is_ours:
      self._observation_updater.reset(self._physics_proxy, self._random_state)

  def _recompile_physics(self) -> None:
    """Compiles the model into a physics of this package's engine."""
    if getattr(self, '_physics', None):
      self._physics.free()
    kind: type[single_physics.ThinPhysics | foreign.ForeignPhysics] = (
        single_physics.ThinPhysics if self._is_ours else foreign.ForeignPhysics
    )
    model = self._task.root_entity.mjcf_model
    with state.room_for_slots(model):
      self._physics = kind.from_mjcf_model(model)
    # Worlds of this package step from the state; see `ThinPhysics.advance`.
    self._physics.legacy_step = not self._is_ours

  def _abandon(self, end: events.End = events.End.ABANDONED) -> None:
    if self._episode_is_open:
      self._end(end)

  def _end(self, end: events.End) -> None:
    self._episode_is_open = False
    for sink in self._sinks:
      sink.episode_ended(end)

  def _refuse_if_closed(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')
