"""Many worlds with feedback, stepped together: Python is paid once for all."""

from typing import Any, NamedTuple, final

from dm_control import composer
import dm_env
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import environment
from realab_suite.engine import seeding
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
  `dm_env`. Where the physics of one world fails, its episode ends and the others
  go on.
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
    if (
        isinstance(num_worlds, bool)
        or not isinstance(num_worlds, int)
        or num_worlds < 1
    ):
      raise errors.SpecError(
          f'num_envs: {num_worlds!r}; allowed are positive integers'
      )
    if not isinstance(single.task, base.Task):
      raise errors.SpecError(
          f'{type(single.task).__name__} compiles anew in each episode; a batch'
          ' takes worlds of this package'
      )
    self._single = single
    self._task: base.Task = single.task
    self._mechanism = single.mechanism
    self._physics = batch_physics.BatchPhysics(
        single.thin_physics, num_worlds, num_threads
    )
    self._num_worlds = num_worlds
    self._episodes = np.full(num_worlds, -1)
    self._is_pending = np.ones(num_worlds, bool)
    num_providers = len(self._mechanism.design.providers)
    self._keys = np.zeros((num_providers, num_worlds, 2), np.uint64)
    self._states = self._mechanism.initial_states((num_worlds,))
    self._observation: dict[str, np.ndarray] = {}
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
    self._look()
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
    discount, is_ending = self._control_step(queries, controls)
    has_diverged = self._physics.has_diverged()
    step_count = self._mechanism.step_count(self._physics)
    is_last = is_ending | has_diverged | (step_count == self._single.max_steps)
    step_type = np.where(
        is_last, int(dm_env.StepType.LAST), int(dm_env.StepType.MID)
    )
    step_type[self._is_pending] = int(dm_env.StepType.FIRST)
    discount = np.where(has_diverged | self._is_pending, 1.0, discount)
    last_valid = self._observation
    invalid = has_diverged & ~self._is_pending
    is_last &= ~self._is_pending
    self._begin_episodes()
    self._look()
    for name, value in self._observation.items():
      # Nothing is read off a state that MuJoCo has reset.
      value[invalid] = last_valid[name][invalid]
    self._is_pending = is_last
    return self._time_step(step_type, discount)

  def close(self) -> None:
    """Frees the worlds; closing twice does nothing."""
    self._closed = True
    self._single.close()

  def _control_step(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray]:
    """Does what `Environment` does, in the same order, to all worlds."""
    physics, mechanism, task = self._physics, self._mechanism, self._task
    schedule, n = self._single.schedule, self._single.num_substeps
    task.before_step(physics, controls, None)
    mechanism.write_queries(physics, queries)

    if schedule.meter_substep:
      physics.advance(schedule.meter_substep)
      task.latch_events(physics)
    is_ending = np.array(task.should_terminate_episode(physics))
    mechanism.update_meters(physics)

    if between := schedule.provider_substep - schedule.meter_substep:
      physics.advance(between)
      task.latch_events(physics)
    step = mechanism.step_count(physics)
    keys = [seeding.step_key(key, step) for key in self._keys]
    _, self._states = mechanism.update_providers(
        physics, self._observation, keys, self._states
    )

    physics.advance(n - schedule.provider_substep)
    task.after_step(physics, None)
    reward = np.asarray(task.get_reward(physics))
    discount = np.array(task.get_discount(physics), float)
    is_over = np.asarray(task.should_terminate_episode(physics))
    # Nobody knows of an end that the meters have not seen.
    discount[(discount != 1.0) & ~is_ending & is_over] = 1.0
    mechanism.end_step(physics, np.where(np.isfinite(reward), reward, 0.0))
    return discount, is_ending

  def _begin_episodes(self) -> None:
    """Begins an episode in every world that waits for one."""
    (worlds,) = np.nonzero(self._is_pending)
    if not len(worlds):
      return
    self._physics.reset(worlds)
    for world in worlds:
      self._episodes[world] += 1
      self._initialize(int(world), int(self._episodes[world]))

  def _initialize(self, world: int, episode: int) -> None:
    seed, view = self._single.seed, self._physics.world(world)
    entities = list(self._task.root_entity.iter_entities())
    for attempt in range(environment.MAX_RESET_ATTEMPTS):
      random_state = seeding.random_state(
          seed, world, episode, f'reset/{attempt}'
      )
      try:
        self._task.initialize_episode(view, random_state)
        for entity in entities:
          entity.initialize_episode(view, random_state)
        break
      except composer.EpisodeInitializationError:
        if attempt == environment.MAX_RESET_ATTEMPTS - 1:
          raise
        self._physics.reset(np.array([world]))
    for i in range(len(self._keys)):
      self._keys[i, world] = seeding.episode_key(
          seed, world, episode, f'providers[{i}]'
      )

  def _look(self) -> None:
    """Makes the observation of every world."""
    physics = self._physics
    physics.refresh()
    observation = {
        f'senses/{name}': value
        for name, value in self._task.senses(physics).items()
    }
    if self._single.max_steps is not None:
      spent = self._mechanism.step_count(physics) / self._single.max_steps
      observation['senses/time_left'] = np.asarray(1.0 - spent, np.float32)
    for read in self._mechanism.read_for_agent(physics):
      observation[f'registers/{read.register}'] = read.reading
    self._observation = observation

  def _time_step(
      self, step_type: np.ndarray, discount: np.ndarray
  ) -> BatchTimeStep:
    return BatchTimeStep(
        step_type,
        np.zeros(self._num_worlds),
        discount,
        {name: np.array(value) for name, value in self._observation.items()},
    )

  def _refuse_if_closed(self) -> None:
    if self._closed:
      raise errors.ClosedError('this environment is closed; load another one')
