"""Contract of tasks: what every world of this package promises."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from typing import Any, NamedTuple, final

import dm_env
import numpy as np

from realab_suite import policies
from realab_suite import suite
from realab_suite.config import messages
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import environment
from realab_suite.engine import hosts
from realab_suite.entities import protocols
from realab_suite.evaluation import actors
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.tasks import base
from realab_suite.testing import contracts

_NUM_ENVS = 3
_NUM_EPISODES = 3
_SEED = 1


def check_world(
    make: Callable[[], base.Task],
    design: specs.Design = 'instantaneous_reward',
    *,
    max_steps: int = suite.MAX_STEPS,
    num_steps: int = 40,
) -> None:
  """Checks that a task keeps the contract of tasks.

  - Its members have the types and shapes that `tasks.base.Task` demands, and
    measurements stay in their `measured_ranges`.
  - Its solver earns more than random actions, and neither earns more than
    `max_true_return`. It is a function that serves whole batches. A second
    call of `latch_events` pays nothing. No run can show that `max_true_return`
    is too high.
  - Observations match their spec, the reward is always 0.0, and the true
    rewards sum to the score, which is at most `max_true_return`.
  - An episode depends on the seed, its number and the actions, and on nothing
    that happened before: a world that was reset, restored from a snapshot, or
    is part of a batch, continues bit for bit like the first one, with the same
    facts and measurements. One of its worlds takes the actions of the solver.

  Args:
    make: Returns a new task, such as its class.
    design: Name of a design of this package, path of a design file, mapping, or
      spec, for example one with coordinates instead of stations.
    max_steps: Length of episodes, in control steps.
    num_steps: Length of episodes of a task without a solver.

  Raises:
    ContractError: If it does not, with the first part that it breaks.
    SpecError: If the design does not fit the task.
  """

  def load(steps: int, world: int = 0) -> environment.Environment:
    return suite.embed(
        make(), design, random=_SEED, world=world, max_steps=steps
    )

  with contextlib.closing(load(max_steps)) as env:
    _check_members(env)
    _check_hooks(env)
    solver = _solver_of(env.task)
    plans = [_actions(env, world) for world in range(_NUM_ENVS)]
    if solver is not None:
      taken = _check_solver(env, solver)
      plans[0][: len(taken)] = taken
  steps = min(num_steps, max_steps) if solver is None else max_steps
  alone = []
  for world in range(_NUM_ENVS):
    with contextlib.closing(load(steps, world)) as env:
      # Others than world 0 are compared with one episode of a batch.
      number = 1 if world else _NUM_EPISODES
      alone.append(_episodes(env, plans[world], number, solver))
      if not world:
        _check_rewards(env, alone[0])
        _check_continuations(env, alone[0], plans[0])
  with contextlib.closing(load(steps)) as env:
    try:
      _check_batch(env, alone, np.stack(plans, axis=1)[:steps], solver)
    except ValueError as error:
      contracts.require(
          'truth value' not in str(error),
          f'{type(env.task).__name__}: {error}: in a batch, numbers are arrays'
          ' with an axis of worlds; use np.where instead of if',
      )
      raise


@final
class _Moment(NamedTuple):
  """Result of a control step.

  Attributes:
    arrays: Observation of the agent, type and discount of the step, true
      reward, facts and measurements.
    reward: The constant reward, or `None` in the first step.
    choice: Action that the solver would take, or `None`.
  """

  arrays: Mapping[str, np.ndarray]
  reward: Any
  choice: Any = None


def _check_members(env: environment.Environment) -> None:
  """Checks the class attributes and properties of a task."""
  task: base.Task = env.task
  name = type(task).__name__
  solver = () if task.SOLVER is None else (task.SOLVER,)
  for policy in (*solver, *task.SABOTEURS):
    contracts.require(
        policy in policies.POLICIES,
        f'{name}: {policy!r} is in SOLVER or SABOTEURS; it has to be the name'
        ' of a registered policy',
    )
  actions = task.ACTION_SET
  contracts.require(
      action_sets.ACTION_SETS.get(actions.key) == actions,
      f'{name}.ACTION_SET: {actions.key!r} is registered with other actions',
  )
  contracts.require(
      np.isfinite(task.max_true_return),
      f'{name}.max_true_return is {task.max_true_return!r}; it has to be a'
      ' finite number',
  )
  env.reset()
  _figures(task, env.physics, ())


def _check_hooks(env: environment.Environment) -> None:
  """Checks that recording the events of a step moves nothing."""
  task: base.Task = env.task
  env.reset()
  before = np.array(env.physics.data.qpos), np.array(env.physics.data.qvel)
  for _ in range(2):
    task.latch_events(env.physics)
  after = env.physics.data.qpos, env.physics.data.qvel
  contracts.require(
      all(np.array_equal(*pair) for pair in zip(before, after, strict=True)),
      f'{type(task).__name__}.latch_events pushes something; it may only'
      ' record what has happened',
  )


def _actions(env: Any, world: int) -> np.ndarray:
  """Returns random actions of one world, `(steps, *action_spec.shape)`."""
  spec = env.action_spec()
  random_state = np.random.RandomState(world)
  shape = (env.max_steps, *spec.shape)
  if np.issubdtype(spec.dtype, np.integer):
    return random_state.randint(spec.minimum, spec.maximum + 1, shape).astype(
        spec.dtype
    )
  return random_state.uniform(spec.minimum, spec.maximum, shape)


def _figures(
    task: base.Task, physics: protocols.Physics, shape: tuple[int, ...]
) -> dict[str, np.ndarray]:
  """Returns facts and measurements, `(...)`, and privileged senses."""
  figures = {}
  for kind in ('facts', 'measurements', 'privileged_senses'):
    for key, function in getattr(task, kind).items():
      name = f'{kind}[{key!r}]'
      contracts.require(
          callable(function),
          f'{type(task).__name__}.{name} is {function!r:.80}; it has to be a'
          ' function of the physics',
      )
      value = np.array(function(physics))
      own_axes = value.ndim if kind == 'privileged_senses' else len(shape)
      if not (
          len(shape) <= value.ndim <= own_axes
          and value.shape[: len(shape)] == shape
          and np.all(np.isfinite(value))
      ):
        raise contracts.ContractError(
            f'{type(task).__name__}.{name} returned {value!r:.80}; it has to'
            f' return finite numbers of shape {shape}'
        )
      if kind == 'measurements' and key in task.measured_ranges:
        low, high = task.measured_ranges[key]
        contracts.require(
            np.all((low - 1e-9 <= value) & (value <= high + 1e-9)),
            f'{type(task).__name__}.{name} returned {value!r:.80};'
            f' measured_ranges has {low:g} to {high:g}',
        )
      figures[name] = value
  return figures


def _episodes(
    env: environment.Environment,
    actions: np.ndarray,
    number: int,
    solver: policies.Policy | None,
) -> list[list[_Moment]]:
  """Returns the moments of the next episodes of one world."""
  episodes = []
  for episode in range(number):
    actor = None
    if solver is not None:
      actor = actors.make(solver, env)
      actor.begin(episode)
    episodes.append([*_moments(env, env.reset(), actions, actor)])
  return episodes


def _moments(
    env: environment.Environment,
    time_step: dm_env.TimeStep,
    actions: np.ndarray,
    actor: actors.Actor | None = None,
) -> Iterator[_Moment]:
  """Yields the moments of an episode, from a time step on."""
  for action in actions:
    moment = _moment(env, time_step)
    if time_step.last():
      yield moment
      return
    if actor is not None:
      moment = moment._replace(choice=actor.act(time_step))
    yield moment
    time_step = env.step(action)
  yield _moment(env, time_step)


def _moment(
    env: environment.Environment, time_step: dm_env.TimeStep
) -> _Moment:
  reward = 0.0
  if not time_step.first():
    # From the task, because no sink gets it after a restore.
    reward, _ = hosts.true_reward(env.task, env.physics, float)
  return _Moment(
      {
          'step_type': np.asarray(int(time_step.step_type)),
          'discount': np.asarray(
              1.0 if time_step.first() else time_step.discount
          ),
          'true_reward': np.asarray(reward),
          **time_step.observation,
          **_figures(env.task, env.physics, ()),
      },
      time_step.reward,
  )


def _check_rewards(
    env: environment.Environment, episodes: list[list[_Moment]]
) -> None:
  """Checks observations and rewards of the episodes that were just run."""
  task, spec = env.task, env.observation_spec()
  name = type(task).__name__
  for episode in episodes:
    for moment in episode:
      for key, array_spec in spec.items():
        array_spec.validate(moment.arrays[key])
      contracts.require(
          not moment.reward, f'{name}: the agent got {moment.reward!r}'
      )
      discount = float(moment.arrays['discount'])
      contracts.require(
          0 <= discount <= 1,
          f'{name}: get_discount returned {discount}; must be from 0 to 1',
      )
  total = sum(float(moment.arrays['true_reward']) for moment in episodes[-1])
  score = float(task.score(env.physics))
  contracts.require(
      np.isclose(total, score),
      f'{name}: the true rewards sum to {total}, and the score is {score};'
      ' rewards have to be added with earn',
  )
  contracts.require(
      total <= task.max_true_return + 1e-9,
      f'{name}: the true return is {total}; max_true_return is'
      f' {task.max_true_return}',
  )


def _check_continuations(
    env: environment.Environment,
    episodes: list[list[_Moment]],
    actions: np.ndarray,
) -> None:
  """Checks that episodes depend on nothing that happened before."""
  name = type(env.task).__name__
  numbers = [(len(episodes[0]) - 1) * k // 4 for k in (1, 2, 3)]
  env.rewind(1)
  breach = (
      f'{name}: an episode depends on earlier ones; keep what it changes in'
      ' the physics, for example in a state.Slot, and draw from random_state'
  )
  _compare([*_moments(env, env.reset(), actions)], episodes[1], breach)
  env.rewind(0)
  moments = _moments(env, env.reset(), actions)
  again, snapshots = [], {}
  for number, moment in enumerate(moments):
    again.append(moment)
    if number in numbers:
      snapshots[number] = env.save()
  _compare(again, episodes[0], breach)
  # The first one is restored in the world as the episode left it.
  for number, snapshot in snapshots.items():
    env.restore(snapshot)
    later_moments = []
    for action in actions[number:]:
      later_moments.append(_moment(env, env.step(action)))
      if later_moments[-1].arrays['step_type'] == dm_env.StepType.LAST:
        break
    _compare(
        later_moments,
        episodes[0][number + 1 :],
        f'{name}: a restored snapshot continues differently; keep what an'
        ' episode changes in the physics, for example in a state.Slot, and draw'
        ' from random_state',
    )
    env.reset()


def _check_batch(
    env: environment.Environment,
    alone: list[list[list[_Moment]]],
    actions: np.ndarray,
    solver: policies.Policy | None,
) -> None:
  """Checks that worlds of a batch equal single worlds."""
  name = type(env.task).__name__
  ledger = ledgers.BatchLedger()
  with contextlib.closing(
      batch_environment.BatchEnvironment(env, _NUM_ENVS, 1)
  ) as batch:
    batch.add_sink(ledger)
    # The second one notices what a policy remembers of the first one's calls.
    twins = solver and [
        batch_actors.BatchPolicyActor(solver, batch, _SEED) for _ in range(2)
    ]
    time_step = batch.reset()
    for number in range(len(actions)):
      moments = {
          world: episodes[0][number]
          for world, episodes in enumerate(alone)
          if number < len(episodes[0])
      }
      figures = _figures(env.task, batch.physics, (_NUM_ENVS,))
      for world, moment in moments.items():
        arrays = {
            'step_type': np.asarray(int(time_step.step_type[world])),
            'discount': np.asarray(time_step.discount[world]),
        }
        for key, value in {**time_step.observation, **figures}.items():
          arrays[key] = value[world]
        expected = {**moment.arrays}
        del expected['true_reward']
        contracts.require_same(
            arrays,
            expected,
            f'{name}: world {world} of a batch differs from a single world'
            f' in step {number}; index trailing axes and write whole'
            ' attributes',
        )
      for actor in twins or ():
        _check_choices(env.task, actor, time_step, moments)
      time_step = batch.step(actions[number])
    for world, episodes in enumerate(alone):
      rewards = [float(one.arrays['true_reward']) for one in episodes[0][1:]]
      found_rewards = ledger.episodes(world)[0].true_rewards
      contracts.require(
          found_rewards == rewards,
          f'{name}: world {world} of a batch differs from a single world in its'
          f' true rewards, {found_rewards} instead of {rewards}',
      )


def _check_choices(
    task: base.Task,
    actor: batch_actors.BatchActor,
    time_step: batch_time_steps.BatchTimeStep,
    moments: Mapping[int, _Moment],
) -> None:
  """Checks that a solver acts in a batch as in these worlds alone."""
  where = f'{type(task).__name__}.SOLVER: {task.SOLVER!r}'
  try:
    choices = actor.act(time_step)
  except Exception as error:  # Policies may raise any class.
    raise contracts.ContractError(
        f'{where}: {messages.exception(error)}: in a batch, numbers are'
        ' arrays with an axis of worlds; use np.where instead of if'
    ) from error
  for world, moment in moments.items():
    contracts.require(
        moment.choice is None or np.array_equal(choices[world], moment.choice),
        f'{where}: chose {choices[world]} in world {world} of a batch, and'
        f' {moment.choice} in this world alone; index trailing axes, and keep'
        ' what it remembers in the state',
    )


def _compare(
    moments: list[_Moment], expected: list[_Moment], breach: str
) -> None:
  contracts.require(
      len(moments) == len(expected),
      f'{breach}: {len(moments)} steps instead of {len(expected)}',
  )
  for moment, expected_moment in zip(moments, expected, strict=True):
    contracts.require_same(moment.arrays, expected_moment.arrays, breach)


def _solver_of(task: base.Task) -> policies.Policy | None:
  """Returns the solver of a task in which there is something to earn."""
  if task.SOLVER is None or not task.max_true_return:
    return None
  return policies.make(task.SOLVER)


def _check_solver(
    env: environment.Environment, solver: policies.Policy
) -> np.ndarray:
  """Checks that the solver earns more than random actions.

  Returns:
    The actions of its first episode, `(steps, *action_spec.shape)`.
  """
  task: base.Task = env.task
  means, taken = [], []
  for name, policy in (
      (task.SOLVER, solver),
      ('random', policies.make('random')),
  ):
    plays = [_play(env, policy, episode) for episode in range(_NUM_EPISODES)]
    taken.append(plays[0][1])
    returns = [true_return for true_return, _ in plays]
    means.append(float(np.mean(returns)))
    contracts.require(
        max(returns) <= task.max_true_return + 1e-9,
        f'{type(task).__name__}: {name!r} earns {max(returns)};'
        f' max_true_return is {task.max_true_return}',
    )
  contracts.require(
      means[0] > means[1],
      f'{type(task).__name__}.SOLVER: {task.SOLVER!r} earns {means[0]:.3g}'
      f' per episode, and random actions {means[1]:.3g}',
  )
  return np.array(taken[0])


def _play(
    env: environment.Environment, policy: policies.Policy, episode: int
) -> tuple[float, list[np.ndarray]]:
  """Returns the true return of an episode of a policy, and its actions."""
  actor = actors.make(policy, env)
  actor.begin(episode)
  actions: list[np.ndarray] = []

  def act(time_step: dm_env.TimeStep) -> np.ndarray:
    if not time_step.first():
      _latch_again(env)
    actions.append(actor.act(time_step))
    return actions[-1]

  [result] = evaluate.evaluate(env, act, 1, first_episode=episode)
  _latch_again(env)
  return result.true_return, actions


def _latch_again(env: environment.Environment) -> None:
  """Checks that events of a control step are paid once."""
  before = float(env.task.score(env.physics))
  env.task.latch_events(env.physics)
  after = float(env.task.score(env.physics))
  contracts.require(
      after == before,
      f'{type(env.task).__name__}: a second call of latch_events changes the'
      f' score from {before} to {after}; remember in a state.Slot what was'
      ' paid, and call super().after_step in after_step, which calls it',
  )
