"""One world with feedback, as a `dm_env` environment without a reward channel.

This file alone touches private parts of `composer.Environment`; they are those
of dm_control 1.0.50, and a test says so when they change.
"""

import math
from typing import Any, final

from dm_control import composer
from dm_control.rl import control
import dm_env
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import actions
from realab_suite.engine import events
from realab_suite.engine import physics as engine_physics
from realab_suite.engine import seeding
from realab_suite.engine import senses as sense_kinds
from realab_suite.engine import snapshot as snapshots
from realab_suite.feedback import action_sets
from realab_suite.feedback import mechanism as feedback_mechanism
from realab_suite.feedback import specs as specs_lib
from realab_suite.tasks import base

# How often the beginning of an episode is tried, with another draw each time.
MAX_RESET_ATTEMPTS = 10


@final
class Environment(composer.Environment):
  """A world, a feedback mechanism, and what passes between them and an agent.

  `reward` is the constant 0.0; feedback comes as observations
  `registers/<name>`. The true reward goes to the event sinks only.

  One control step is the list in `docs/architecture.md`.
  """

  def __init__(
      self,
      task: composer.Task,
      mechanism: feedback_mechanism.FeedbackMechanism,
      *,
      seed: int,
      world: int = 0,
      max_steps: int | None = None,
  ) -> None:
    """Makes the environment; `suite.load` and `suite.embed` are easier.

    Args:
      task: The world, with `mechanism` attached to its root entity.
      mechanism: The feedback.
      seed: From which, with `world`, every random stream follows.
      world: Which world of a batch this is.
      max_steps: After how many control steps an episode is cut off, or `None`.
    """
    self._physics: engine_physics.Physics
    self._mechanism = mechanism
    self._seed, self._world, self._episode = seed, world, -1
    self._max_steps = max_steps
    self._sinks: list[events.EventSink] = []
    self._closed = False
    # A world of ours has no hooks in substeps and compiles once. Somebody
    # else's is treated as Composer would.
    self._is_ours = isinstance(task, base.Task)
    if isinstance(task, base.Task):
      _refuse_substep_hooks(task)
    super().__init__(
        task,
        random_state=seeding.random_state(seed, world, 0, 'construction'),
        max_reset_attempts=MAX_RESET_ATTEMPTS,
        recompile_mjcf_every_episode=not self._is_ours,
        legacy_step=False,
    )
    self._senses: sense_kinds.Senses
    if isinstance(task, base.Task):
      self._senses = sense_kinds.WorldSenses(task)
    else:
      self._senses = sense_kinds.ObservableSenses(task)
      self._senses.restart(self._physics, self._random_state)
    if max_steps is not None and 'time_left' in self._senses.spec:
      raise errors.SpecError(
          "the task has an observable 'time_left' of its own; allowed names are"
          ' all others, or max_steps=None'
      )
    self._schedule = mechanism.design.schedule_for(self._n_sub_steps)
    chosen = mechanism.design.action_set
    self._codec = actions.ActionCodec(
        task.action_spec(self._physics),
        [register.value_spec for register in mechanism.queries],
        None
        if chosen is None
        else action_sets.get(chosen.name, chosen.version),
    )
    self._observation: dict[str, np.ndarray] = {}
    self._provider_keys: list[np.ndarray] = []
    self._provider_states: list[Any] = []
    self._episode_is_open = False

  # What the evaluator and the launcher use; no agent is handed this object.

  @property
  def mechanism(self) -> feedback_mechanism.FeedbackMechanism:
    """The registers, meters and providers."""
    return self._mechanism

  @property
  def seed(self) -> int:
    """From which every random stream follows."""
    return self._seed

  @property
  def world(self) -> int:
    """Which world of a batch this is; 0 for one alone."""
    return self._world

  @property
  def max_steps(self) -> int | None:
    """After how many control steps an episode is cut off."""
    return self._max_steps

  @property
  def num_substeps(self) -> int:
    """How many substeps of the physics make a control step."""
    return self._n_sub_steps

  @property
  def codec(self) -> actions.ActionCodec:
    """What takes actions apart."""
    return self._codec

  @property
  def schedule(self) -> specs_lib.ScheduleSpec:
    """When meters and providers act."""
    return self._schedule

  @property
  def thin_physics(self) -> engine_physics.ThinPhysics:
    """The physics itself, which is compiled once.

    Raises:
      SpecError: If the world is somebody else's.
    """
    if not isinstance(self._physics, engine_physics.ThinPhysics):
      raise errors.SpecError(
          f'{type(self._task).__name__} is stepped as Composer would step it'
      )
    return self._physics

  def add_sink(self, sink: events.EventSink) -> None:
    """Lets an evaluator hear of everything, from the next episode on."""
    self._refuse_if_closed()
    self._abandon()
    self._sinks.append(sink)
    self._reset_next_step = True

  def remove_sink(self, sink: events.EventSink) -> None:
    """Ends what `add_sink` began."""
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

    What the event sinks know of the episode is part of it.

    Raises:
      SpecError: If the world is somebody else's, or a sink cannot be saved.
      StateLayoutError: If a provider's state is not plain data.
    """
    header = self.snapshot_header()
    worlds = snapshots.Worlds(
        places=None,
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
    return snapshots.Snapshot(header, worlds._asdict())

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
    saved = snapshots.Worlds(**snapshot.contents_for(header))
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
    self._provider_keys = [np.array(key[0]) for key in saved.provider_keys]
    self._provider_states = (
        saved.provider_states
        if saved.places is None
        else snapshots.of_world(saved.provider_states)
    )
    self._keep(
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

  def action_spec(self) -> specs.Array:
    self._refuse_if_closed()
    return self._codec.spec

  def reward_spec(self) -> specs.BoundedArray:
    self._refuse_if_closed()
    return specs.BoundedArray((), np.float64, 0.0, 0.0, name='reward')

  def discount_spec(self) -> specs.BoundedArray:
    self._refuse_if_closed()
    return specs.BoundedArray((), np.float64, 0.0, 1.0, name='discount')

  def observation_spec(self) -> dict[str, specs.Array]:
    self._refuse_if_closed()
    spec = {
        f'senses/{name}': part.replace(name=f'senses/{name}')
        for name, part in self._senses.spec.items()
    }
    if self._max_steps is not None:
      spec[sense_kinds.TIME_LEFT] = specs.BoundedArray(
          (), np.float32, 0.0, 1.0, name=sense_kinds.TIME_LEFT
      )
    for name in self._mechanism.read_by_agent:
      key = f'registers/{name}'
      spec[key] = specs.Array((), np.float64, name=key)
    return spec

  def reset(self) -> dm_env.TimeStep:
    """Starts the next episode and returns its FIRST time step."""
    self._refuse_if_closed()
    self._abandon()
    # Whatever goes wrong from here on, the next step starts with a reset.
    self._reset_next_step = True
    self._episode += 1
    for attempt in range(MAX_RESET_ATTEMPTS):
      seeding.reseed(
          self._random_state,
          self._seed,
          self._world,
          self._episode,
          f'reset/{attempt}',
      )
      try:
        self._initialize_episode()
        break
      except composer.EpisodeInitializationError:
        if attempt == MAX_RESET_ATTEMPTS - 1:
          raise
    providers = self._mechanism.design.providers
    self._provider_keys = [
        seeding.episode_key(
            self._seed, self._world, self._episode, f'providers[{i}]'
        )
        for i in range(len(providers))
    ]
    self._provider_states = self._mechanism.initial_states(())
    records: list[Any] = [*self._mechanism.initial_writes(self._physics)]
    records += self._observe()
    start = events.Start(self._seed, self._world, self._episode, records)
    for sink in self._sinks:
      sink.episode_started(start, self._physics_proxy)
    # Unless all have heard of its beginning, there is no episode.
    self._reset_next_step = False
    self._episode_is_open = True
    return dm_env.restart(self._copy_of_observation())

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
      step, discount, terminated = self._control_step(queries, controls)
    except control.PhysicsError:
      self._end(events.End.DIVERGENCE)
      # The agent learns that time is up and nothing else: no register is read
      # off a state that MuJoCo has reset.
      return dm_env.truncation(0.0, self._copy_of_observation(), 1.0)
    except Exception:
      self._end(events.End.ERROR)
      raise
    for sink in self._sinks:
      sink.step_ended(step, self._physics_proxy)
    if terminated:
      self._end(events.End.TERMINATED)
      return dm_env.TimeStep(
          dm_env.StepType.LAST, 0.0, discount, self._copy_of_observation()
      )
    if self._mechanism.step_count(self._physics) == self._max_steps:
      self._end(events.End.TIMEOUT)
      return dm_env.truncation(0.0, self._copy_of_observation(), discount)
    self._reset_next_step = False
    return dm_env.transition(0.0, self._copy_of_observation(), discount)

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

  # One control step, in order.

  def _control_step(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> tuple[events.Step, float, bool]:
    physics, mechanism = self._physics, self._mechanism
    n, schedule = self._n_sub_steps, self._schedule
    was_over = is_ending = self._is_over()
    self._hooks.before_step(physics, controls, self._random_state)
    self._senses.begin_step()
    records: list[Any] = [*mechanism.write_queries(physics, queries)]

    self._advance(schedule.meter_substep, controls)
    self._latch(schedule.meter_substep)
    if self._is_ours:
      is_ending = self._is_over()
    records += mechanism.update_meters(physics)

    between = schedule.provider_substep - schedule.meter_substep
    self._advance(between, controls)
    self._latch(between)
    step = int(mechanism.step_count(physics))
    feedback, self._provider_states = mechanism.update_providers(
        physics,
        self._observation,
        [seeding.step_key(key, step) for key in self._provider_keys],
        self._provider_states,
    )
    records += feedback

    self._advance(n - schedule.provider_substep, controls)
    self._hooks.after_step(physics, self._random_state)
    physics.forward()
    reward = 0.0 if was_over else self._true_reward()
    discount = float(self._task.get_discount(physics))
    if not is_ending:
      discount = 1.0  # Of an end that the meters have not seen, nobody knows.
    mechanism.end_step(physics, reward if math.isfinite(reward) else 0.0)
    records += self._observe()
    return events.Step(records, np.array(reward)), discount, is_ending

  def _true_reward(self) -> float:
    """Returns the true reward, or nan where the task fails to give one.

    An exception would reach the agent, and tell it something: only the
    evaluator hears that there is no reward, and that the episode is not valid.
    """
    try:
      return float(self._task.get_reward(self._physics))
    except Exception:  # Whatever a task does wrong is not the agent's business.
      return float('nan')

  def _is_over(self) -> bool:
    """Whether the task has ended.

    The episode does so with the control step whose meters can know of it: what
    ends an episode is often what matters most, and feedback on it would never
    reach the agent otherwise.
    """
    return bool(self._task.should_terminate_episode(self._physics))

  def _latch(self, num_substeps: int) -> None:
    """Records what has happened, in the worlds that keep such a record."""
    if num_substeps and self._is_ours:
      self._task.latch_events(self._physics)

  def _advance(self, num_substeps: int, controls: np.ndarray) -> None:
    """Steps the physics."""
    if self._is_ours:
      if num_substeps:
        self._physics.advance(num_substeps)
      return
    physics = self._physics_proxy
    for _ in range(num_substeps):
      self._hooks.before_substep(physics, controls, self._random_state)
      self._physics.advance(1)
      self._physics.forward()
      self._hooks.after_substep(physics, self._random_state)
      self._senses.end_substep()

  def _observe(self) -> list[feedback_mechanism.Read]:
    """Looks once, and returns what was read off registers."""
    observation, reads = sense_kinds.observe(
        self._senses.sense(self._physics),
        self._mechanism,
        self._physics,
        self._max_steps,
    )
    self._keep(observation)
    return reads

  def _keep(self, observation: dict[str, np.ndarray]) -> None:
    """Remembers what the next action is an answer to."""
    for value in observation.values():
      # Providers look at these arrays themselves; the agent gets copies.
      value.setflags(write=False)
    self._observation = observation

  def _copy_of_observation(self) -> dict[str, np.ndarray]:
    """The agent may do what it likes with what it gets."""
    return {key: value.copy() for key, value in self._observation.items()}

  # Episodes.

  def _initialize_episode(self) -> None:
    if self._recompile_mjcf_every_episode:
      self._hooks.initialize_episode_mjcf(self._random_state)
      self._recompile_physics_and_update_observables()
    with self._physics.reset_context():
      self._hooks.initialize_episode(self._physics_proxy, self._random_state)
    self._senses.restart(self._physics_proxy, self._random_state)

  def _recompile_physics(self) -> None:
    """Compiles the model into a physics of this package's engine."""
    if getattr(self, '_physics', None):
      self._physics.free()
    kind = (
        engine_physics.ThinPhysics
        if self._is_ours
        else engine_physics.ForeignPhysics
    )
    self._physics = kind.from_mjcf_model(self._task.root_entity.mjcf_model)
    self._physics.legacy_step = False

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


def _refuse_substep_hooks(task: base.Task) -> None:
  """Refuses hooks that nobody would call: there is no Python in a substep."""
  parts = [(task, composer.Task)]
  parts += [(e, composer.Entity) for e in task.root_entity.iter_entities()]
  for part, kind in parts:
    for hook in ('before_substep', 'after_substep'):
      if getattr(type(part), hook) is not getattr(kind, hook):
        raise errors.SpecError(
            f'{type(part).__name__}.{hook}: worlds of this package have no'
            ' hooks in substeps; use latch_events'
        )
