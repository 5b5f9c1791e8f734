"""The environment of one world: `dm_env` with feedback but no reward channel.

Only this module and `foreign` use private attributes of `composer.Environment`.
They are those of dm_control 1.0.50, and a test fails when they change.
"""

import abc
from collections.abc import Callable, Sequence
import contextlib
from typing import TYPE_CHECKING, Any, ClassVar, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer import observation as composer_observation
from dm_control.rl import control
import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.engine import action_codec
from realab_suite.engine import control_step
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import hooks
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import placement
from realab_suite.engine import seeding
from realab_suite.engine import single_physics
from realab_suite.entities import registers
from realab_suite.entities import state
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.tasks import base

if TYPE_CHECKING:
  from realab_suite.engine import snapshots


class Environment(composer.Environment, abc.ABC):
  """An environment with one world, a feedback mechanism and event sinks.

  `reward` is the constant 0.0. The observations `registers/<name>` contain the
  feedback. Event sinks get the true reward, and meters the score.
  `docs/architecture.md` lists the parts of a control step.

  Attributes:
    PHYSICS: Class of the physics.
    IS_RECOMPILED: True if the model may change between episodes, and the
      physics is stepped as in Composer, from derived quantities.
  """

  PHYSICS: ClassVar[type[mjcf.Physics]]
  IS_RECOMPILED: ClassVar[bool]

  def __init__(
      self,
      task: composer.Task,
      mechanism: mechanisms.FeedbackMechanism,
      *,
      seed: int,
      world: int = 0,
      max_steps: int | None = None,
      senses: Sequence[str] | None = None,
  ) -> None:
    """Initializes the environment. Prefer `suite.load` or `suite.embed`.

    Args:
      task: Task with `mechanism` attached to its root entity.
      mechanism: Registers, meters and providers.
      seed: Seed of every random stream, together with `world`.
      world: Number of the world in a batch.
      max_steps: Maximum length of an episode in control steps, or `None`.
      senses: Names of the agent's senses; `None` for the default ones.
    """
    self._selected_senses = senses
    self._physics: Any
    self._mechanism = mechanism
    self._phases = mechanism.phases
    self._max_steps = max_steps
    self._closed = False
    self._has_extra_hooks = False
    state.manage_room(task.root_entity.mjcf_model)
    super().__init__(
        task,
        random_state=seeding.random_state(seed, world, 0, 'construction'),
        recompile_mjcf_every_episode=self.IS_RECOMPILED,
    )
    self._fit_to_world()
    self._seed, self._world, self._episode = seed, world, -1
    # True after the sinks were notified of the start of an episode, until they
    # are notified of its end.
    self._is_open = False
    self._keys = self._new_keys(0)
    self._states: list[Any] = []
    self._observation: dict[str, np.ndarray] = {}
    self._sinks: list[events.EventSink] = []

  # The interface for evaluators and launchers. Agents do not get this object.

  @abc.abstractmethod
  def check_placement(self) -> None:
    """Checks the places of registers, before the first episode.

    Raises:
      SpecError: If something is in the way of a register.
    """

  @property
  def mechanism(self) -> mechanisms.FeedbackMechanism:
    """Registers, meters and providers."""
    return self._mechanism

  @property
  def seed(self) -> int:
    """Seed of every random stream."""
    return self._seed

  @property
  def world(self) -> int:
    """Number of the world in a batch; 0 for a single world."""
    return self._world

  @property
  def max_steps(self) -> int | None:
    """Maximum length of an episode in control steps, or `None`."""
    return self._max_steps

  @property
  def action_set(self) -> action_sets.ActionSet:
    """Actions that policies choose from: the design's, or the task's."""
    return action_codec.action_set_of(self._task, self._mechanism.design)

  @property
  def senses(self) -> tuple[str, ...]:
    """Names of the agent's senses."""
    return self._observer.senses

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
    """True if `add_extra_hook` was called."""
    return self._has_extra_hooks

  @property
  def physics(self) -> Any:
    """Physics of the world, in which poses are up to date."""
    self._refuse_if_closed()
    if isinstance(self._physics, single_physics.ThinPhysics):
      self._physics.update_poses()
    return super().physics

  @property
  def thin_physics(self) -> single_physics.ThinPhysics:
    """Physics of a task of this package, which is compiled once.

    Raises:
      SpecError: If the task is a foreign task.
    """
    self._refuse_if_closed()
    if not isinstance(self._physics, single_physics.ThinPhysics):
      raise errors.SpecError(
          f'{type(self._task).__name__} is not a task of this package'
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
    hooks.refuse_unused(self._task, hook_name)
    super().add_extra_hook(hook_name, hook_callable)
    self._has_extra_hooks = True

  @property
  def sinks(self) -> list[events.EventSink]:
    """Event sinks, in the order in which they were added."""
    return [*self._sinks]

  def add_sink(self, sink: events.EventSink) -> None:
    """Abandons the current episode and notifies a sink of all later ones."""
    self.abandon()
    self._sinks.append(sink)

  def remove_sink(self, sink: events.EventSink) -> None:
    """Undoes `add_sink`."""
    self._sinks.remove(sink)

  def rewind(self, episode: int = 0, random: Any = None) -> None:
    """Abandons the current episode and sets the number of the next one.

    Args:
      episode: Number of the next episode.
      random: New seed, or `None` for the present one.

    Raises:
      SpecError: If the number or the seed is invalid.
    """
    self._refuse_if_closed()
    episode = integers.check('episode', episode, 0)
    if random is not None:
      self._seed = seeding.as_seed(random)
    self.abandon()
    self._episode = episode - 1

  def abandon(self, end: events.End = events.End.ABANDONED) -> None:
    """Ends the current episode, if there is one. The next step resets.

    Args:
      end: Reason that the sinks get.
    """
    self._refuse_if_closed()
    self._end(end)
    self._reset_next_step = True

  def save(self) -> 'snapshots.Snapshot':
    """Returns a snapshot of this world, from which `restore` continues.

    Raises:
      SpecError: If the task is foreign.
      StateLayoutError: If a provider's state is not plain data.
    """
    from realab_suite.engine import snapshots

    header = self.snapshot_header()
    worlds = snapshots.WorldStates(
        indices=None,
        physics=snapshots.get_state(self._physics)[np.newaxis],
        seed=[self._seed],
        world=[self._world],
        episode=[self._episode],
        is_pending=[self._reset_next_step],
        provider_keys=[key[np.newaxis] for key in self._keys],
        provider_states=self._states,
        observation=snapshots.of_batch(self._observation),
        random_state=self._random_state.get_state(legacy=False),
    )
    return snapshots.Snapshot(header, worlds._asdict())

  def restore(self, snapshot: 'snapshots.Snapshot') -> None:
    """Sets this world to the state in a snapshot.

    It continues bit for bit like the saved world, including later episodes,
    because the seed is restored as well. The current episode is abandoned. The
    sinks are not notified of the restored one: they would miss its beginning,
    and what an agent has done could be undone.

    Args:
      snapshot: Snapshot of a single world, or of one world of a batch.

    Raises:
      SpecError: If the task is a foreign task.
      StateLayoutError: If the snapshot does not fit. The state is unchanged.
    """
    from realab_suite.engine import snapshots

    header = self.snapshot_header()
    saved = snapshots.WorldStates.from_snapshot(snapshot, header)
    if len(saved.seed) != 1:
      raise errors.StateLayoutError(
          f'the snapshot has {len(saved.seed)} worlds; must have one, as'
          ' in batch.save([3])'
      )
    # If anything fails from here on, the next step starts with a reset.
    self.abandon()
    snapshots.set_state(self._physics, saved.physics[0])
    (self._seed,), (self._world,) = saved.seed, saved.world
    (self._episode,) = saved.episode
    if saved.random_state is None:  # A world of a batch has no generator.
      stream = self._seed, self._world, 0, 'construction'
      seeding.reseed(self._random_state, *stream)
    else:
      self._random_state.set_state(saved.random_state)
    for key, saved_key in zip(self._keys, saved.provider_keys, strict=True):
      key[:] = saved_key[0]
    self._states = saved.provider_states_of_world()
    self._observation = observing.frozen(saved.observation_of_world())
    (self._reset_next_step,) = saved.is_pending

  @abc.abstractmethod
  def check_start(self, physics: Any) -> None:
    """Checks an episode that has just been initialized.

    Args:
      physics: Physics of this world, or of a world of a batch.

    Raises:
      EpisodeInitializationError: If something is inside a register.
    """

  def snapshot_header(self, model: Any = None) -> dict[str, Any]:
    """Returns the header that a snapshot needs to fit this environment.

    Args:
      model: Compiled model, as `physics.model`; `None` for that of this world.

    Raises:
      SpecError: If the task is foreign, or if its bodies can sleep.
    """
    from realab_suite.engine import snapshots

    self._refuse_if_closed()
    model = self._physics.model if model is None else model
    return {
        **snapshots.describe(self._task, model),
        'design': self._mechanism.design.digest(),
        'num_substeps': self._n_sub_steps,
        'max_steps': self._max_steps,
        'observation': self._observer.layout(),
    }

  # The interface for agents: `dm_env.Environment`.

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
    """Abandons the current episode and starts the next one.

    Raises:
      EpisodeInitializationError: If every attempt of the task failed.
    """
    # If anything fails from here on, the next step starts with a reset.
    self.abandon()
    self._episode += 1
    episodes.begin(
        self._random_state,
        self._seed,
        self._world,
        self._episode,
        self._initialize_episode,
    )
    self._keys = self._new_keys(self._episode)
    self._states = self._phases.initial_states(())
    records: list[registers.Record] = []
    records += self._phases.initial_writes(self._physics)
    records += self._observe()
    start = events.Start(self._seed, self._world, self._episode, records)
    self._notify(lambda sink: sink.episode_started(start, self._physics))
    # The episode is open only after every sink was notified without an error.
    self._is_open = True
    self._reset_next_step = False
    return dm_env.restart(observing.copied(self._observation))

  def step(self, action: Any) -> dm_env.TimeStep:
    """Runs one control step and returns its time step.

    Raises:
      ActionError: If the action violates `action_spec`. Nothing has changed.
      FeedbackProviderError: If a provider failed. The episode is over.
      RegisterValueError: If a provider wrote a value that cannot be stored. The
        episode is over.
    """
    self._refuse_if_closed()
    queries, controls = self._codec.decode(action)
    if self._reset_next_step:
      return self.reset()
    # If anything fails here, the next step starts with a reset.
    self._reset_next_step = True
    try:
      outcome = self._run(queries, controls)
      reads = self._observe()
    except control.PhysicsError:
      self._end(events.End.DIVERGENCE)
      # MuJoCo has reset the state. The agent gets the previous observation.
      return episodes.time_step(events.End.DIVERGENCE, 1.0, self._observation)
    except Exception:
      self._end(events.End.ERROR)
      raise
    self._states, ending = outcome.provider_states, outcome.ending
    if self._is_open and self._sinks:
      step = events.Step(
          [*outcome.records, *reads],
          np.array(action),
          np.array(ending.true_reward),
          ending.failure,
      )
      self._notify(lambda sink: sink.step_ended(step, self._physics))
    end = episodes.end_of_step(
        False,
        ending.is_ending,
        self._phases.ends_episode(reads),
        outcome.num_steps == self._max_steps,
    )
    if end is not None:
      self._end(end)
    self._reset_next_step = end is not None
    return episodes.time_step(end, float(ending.discount), self._observation)

  def close(self) -> None:
    """Frees the world. Closing it again has no effect."""
    if self._closed:
      return
    self.abandon()
    self._closed = True
    super().close()

  def __reduce__(self) -> Any:
    raise TypeError(
        'environments cannot be pickled or copied; pass the design and load the'
        ' environment where it is used'
    )

  def _observe(self) -> list[registers.Read]:
    """Updates the observation and returns the reads of registers for it."""
    observation, reads = self._observer.observe(self._physics)
    self._observation = observing.frozen(observation)
    return reads

  def _notify(self, notify: Callable[[events.EventSink], None]) -> None:
    """Notifies the sinks, which may read the physics."""
    if self._sinks:
      with self._unchanged():
        for sink in self._sinks:
          notify(sink)

  def _end(self, end: events.End) -> None:
    """Notifies the sinks of the end of the episode, if there is one."""
    if self._is_open:
      self._is_open = False
      for sink in self._sinks:
        sink.episode_ended(end)

  def _new_keys(self, episode: int) -> np.ndarray:
    """Returns the random key of each provider in an episode."""
    number = len(self._mechanism.design.providers)
    return episodes.provider_keys(self._seed, self._world, episode, number)

  def _initialize_episode(self, unused_attempt: int) -> None:
    if self._recompile_mjcf_every_episode:
      self._hooks.initialize_episode_mjcf(self._random_state)
      self._recompile_physics_and_update_observables()
      self._fit_to_world()
    with self._initializing():
      self._hooks.initialize_episode(self._physics_proxy, self._random_state)
    self.check_start(self._physics)
    self._observation_updater.reset(self._physics_proxy, self._random_state)

  def _initializing(self) -> contextlib.AbstractContextManager[Any]:
    """Returns the context in which an episode is initialized."""
    return self._physics.reset_context()

  def _unchanged(self) -> contextlib.AbstractContextManager[None]:
    """Returns a context in which reads do not change later steps."""
    return contextlib.nullcontext()

  @abc.abstractmethod
  def _run(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> control_step.Outcome:
    """Runs a control step of the task and the mechanism.

    Args:
      queries: Values for the query registers, `(queries,)`.
      controls: Controls of the task, `(controls,)`.
    """

  def _observation_for_providers(self) -> dict[str, np.ndarray]:
    """Returns what the action responds to, and what providers alone sense."""
    return self._observer.for_providers(self._physics, self._observation)

  @abc.abstractmethod
  def _sensed(self) -> tuple[dict[str, dm_env_specs.Array], observing.Sense]:
    """Returns the specs of senses in the compiled world, and what senses."""

  def _fit_to_world(self) -> None:
    """Makes what depends on the compiled world.

    A foreign task may change its timesteps, actions and observables for each
    episode.

    Raises:
      SpecError: If the design or the selected senses do not fit the world.
    """
    self._observer = observing.Observer(
        self._task,
        *self._sensed(),
        self._mechanism,
        self._max_steps,
        self._selected_senses,
    )
    self._schedule = self._mechanism.design.schedule_for(self._n_sub_steps)
    self._codec = action_codec.for_design(
        self._task.action_spec(self._physics_proxy), self._mechanism
    )

  def _recompile_physics(self) -> None:
    """Compiles the model into a physics class of this engine."""
    if getattr(self, '_physics', None):
      self._physics.free()
    model = self._task.root_entity.mjcf_model
    with state.room_for_slots(model):
      self._physics = self.PHYSICS.from_mjcf_model(model)
    self._physics.legacy_step = self.IS_RECOMPILED

  def _refuse_if_closed(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')


@final
class WorldEnvironment(Environment):
  """The environment of a task of this package."""

  PHYSICS = single_physics.ThinPhysics
  IS_RECOMPILED = False  # Steps begin from the state; see `ThinPhysics`.

  def __init__(
      self,
      task: base.Task,
      mechanism: mechanisms.FeedbackMechanism,
      **options: Any,
  ) -> None:
    """Initializes the environment; see `Environment`."""
    mechanism.leave_phases()
    hooks.refuse_uncalled(task)
    self._host = hosts.WorldHost(task)
    super().__init__(task, mechanism, **options)
    self._host.call_hooks(self._hooks, self._random_state)
    self._placement = placement.Placement(self._physics, task, mechanism)

  def check_placement(self) -> None:
    self._refuse_if_closed()
    self._placement.check(self._physics)

  def check_start(self, physics: Any) -> None:
    self._placement.check_start(physics)

  def _run(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> control_step.Outcome:
    return control_step.run(
        self._physics,
        self._host,
        self._phases,
        self._schedule,
        self._n_sub_steps,
        queries=queries,
        controls=controls,
        observation=self._observation_for_providers(),
        provider_keys=self._keys,
        provider_states=self._states,
    )

  def _sensed(self) -> tuple[dict[str, dm_env_specs.Array], observing.Sense]:
    return self._task.sense_spec, self._host.sense

  def _make_observation_updater(self) -> Any:
    return composer_observation.Updater({})  # The task makes its senses.
