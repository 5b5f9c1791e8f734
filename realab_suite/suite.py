"""Loads worlds with feedback: where the work of both roles comes together."""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import functools
from importlib import resources
from typing import Any

from dm_control import composer
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.engine import arguments
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import forking
from realab_suite.engine import placement
from realab_suite.engine import seeding
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.tasks import base
from realab_suite.tasks import collect_apples
from realab_suite.tasks import unlock_door

MAX_STEPS = 250
"""After how many control steps an episode of a task of this suite ends."""

DESIGNS = specs.DESIGNS
"""Names of the designs that ship with the package."""

fork = forking.fork
"""Makes a batch whose worlds all go on from where one world is."""

TaskFactory = Callable[..., base.Task]

_TASKS: dict[tuple[str, str], tuple[TaskFactory, frozenset[str]]] = {}


def register_task(
    domain_name: str, task_name: str, *tags: str
) -> Callable[[TaskFactory], TaskFactory]:
  """Returns a decorator that makes a world loadable by name.

  Args:
    domain_name: The name of the world.
    task_name: The name of the variation.
    *tags: What `get_tasks_by_tag` finds it by.

  Raises:
    SpecError: If a name is no text, or if there is such a task already.
  """
  for name in (domain_name, task_name):
    if not isinstance(name, str):
      raise errors.SpecError(
          f'task name {messages.quote(name)}; allowed are texts'
      )

  def decorate(factory: TaskFactory) -> TaskFactory:
    if (domain_name, task_name) in _TASKS:
      raise errors.SpecError(
          f'task {domain_name}.{task_name} is registered already'
      )
    _TASKS[domain_name, task_name] = factory, frozenset(tags)
    return factory

  return decorate


def _register_ours() -> None:
  tags = {
      'standard': ('benchmarking', 'tampering'),
      'near': ('benchmarking', 'tampering'),
      'far': ('benchmarking', 'tampering'),
      'boxed': ('no_tampering_control',),
  }
  worlds: dict[str, TaskFactory] = {
      'collect_apples': collect_apples.CollectApples,
      'unlock_door': unlock_door.UnlockDoor,
  }
  for domain_name, world in worlds.items():
    for variation in base.VARIATIONS:
      register_task(domain_name, variation, *tags[variation])(
          functools.partial(world, variation)
      )


_register_ours()


def _find(
    domain_name: str, task_name: str
) -> tuple[TaskFactory, frozenset[str]]:
  are_texts = isinstance(domain_name, str) and isinstance(task_name, str)
  if not are_texts or (domain_name, task_name) not in _TASKS:
    known = [f'{domain}.{task}' for domain, task in _TASKS]
    raise errors.UnknownNameError(
        f'task {_shown(domain_name)}.{_shown(task_name)} is unknown; known are'
        f' {known}'
    )
  return _TASKS[domain_name, task_name]


def _shown(name: Any) -> str:
  """Returns a name as it is where that is short and one line."""
  is_plain = isinstance(name, str) and name.isprintable() and len(name) <= 80
  return name if is_plain else messages.quote(name)


def get_tasks_by_tag(tag: str) -> tuple[tuple[str, str], ...]:
  """Returns the `(domain, task)` names of the tasks with a tag."""
  return tuple(name for name, (_, tags) in _TASKS.items() if tag in tags)


ALL_TASKS: tuple[tuple[str, str], ...] = tuple(_TASKS)
"""The `(domain, task)` names of the tasks that ship with the package."""

BENCHMARKING = get_tasks_by_tag('benchmarking')
"""The tasks to report results on."""

TASKS_BY_DOMAIN: Mapping[str, tuple[str, ...]] = {
    domain: tuple(task for d, task in ALL_TASKS if d == domain)
    for domain in dict.fromkeys(domain for domain, _ in ALL_TASKS)
}


def dynamics(domain_name: str, task_name: str) -> tuple[int, str | None]:
  """Returns which dynamics a task has, for the record of a result.

  Returns:
    The version of the task's dynamics, which never change under a version, and
    the digest of a golden trajectory of it; `None` where none is recorded for
    the installed version of MuJoCo.

  Raises:
    UnknownNameError: If there is no such task.
  """
  factory, _ = _find(domain_name, task_name)
  golden = resources.files('realab_suite.configs') / 'golden.yaml'
  recorded = loading.parse_yaml(golden.read_bytes(), 'golden.yaml')
  digests = recorded.get(mujoco.__version__, {})
  return factory().DYNAMICS_VERSION, digests.get(f'{domain_name}.{task_name}')


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
    *,
    design: specs.Design | None = None,
    overrides: Sequence[str] = (),
) -> environment.Environment:
  """Loads a task with the feedback of an agent design.

  Args:
    domain_name: The world, as in `'unlock_door'`.
    task_name: The variation of it, as in `'standard'`.
    task_kwargs: `random`, a seed, and whatever the world takes, as in
      `camera_size`.
    environment_kwargs: `max_steps`, the length of an episode, and `world`, the
      number of a world of a batch, to have that one alone.
    visualize_reward: Has to be `False`: it would paint the true reward into the
      agent's view.
    design: The name of a design that ships with the package, a path, a mapping
      or a spec; `None` for a world without feedback.
    overrides: Dotted overrides of the design, as in `'channel=secure'`.

  Raises:
    SpecError: If a name, an argument or the design is wrong.
  """
  if visualize_reward is not False:
    raise errors.SpecError(
        f'visualize_reward={messages.quote(visualize_reward)} would show the'
        ' true reward to the agent; allowed is False'
    )
  factory, _ = _find(domain_name, task_name)
  options: dict[str, Any] = {'max_steps': MAX_STEPS}
  options |= _keywords('environment_kwargs', environment_kwargs)
  if unknown := [key for key in options if key not in ('max_steps', 'world')]:
    raise errors.SpecError(
        f'environment_kwargs: unknown {messages.quote(unknown)}; allowed are'
        ' max_steps and world'
    )
  kwargs = _keywords('task_kwargs', task_kwargs)
  random = kwargs.pop('random', None)
  try:
    task = factory(**kwargs)
  except errors.RealabError:
    raise
  except Exception as error:  # It may be of any class.
    place = messages.Location(f'task_kwargs of {domain_name}.{task_name}')
    raise place.error(f'{type(error).__name__}: {error}') from error
  return embed(
      task,
      'none' if design is None else design,
      random=random,
      overrides=overrides,
      **options,
  )


def load_batch(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    *,
    num_envs: int,
    num_threads: int = 0,
    sleep: bool = False,
    design: specs.Design | None = None,
    overrides: Sequence[str] = (),
) -> batch_environment.BatchEnvironment:
  """Loads many worlds of a task, which are stepped together.

  World i is, bit for bit, what `load` gives with `environment_kwargs` of
  `{'world': i}`, unless blocks fall asleep.

  Args:
    domain_name: As in `load`.
    task_name: As in `load`.
    task_kwargs: As in `load`.
    environment_kwargs: As in `load`.
    num_envs: Number of worlds, at most 65,536.
    num_threads: Number of threads that step them, at most 1,024; 0 for all
      processors.
    sleep: Whether blocks at rest fall asleep until something touches or writes
      them. That is faster, and other trajectories than `load` gives; such
      worlds cannot be saved, restored or forked.
    design: As in `load`.
    overrides: As in `load`.

  Raises:
    SpecError: If a name, an argument or the design is wrong.
  """
  if 'world' in _keywords('environment_kwargs', environment_kwargs):
    raise errors.SpecError(
        'environment_kwargs: a batch has all worlds from 0 on; allowed is'
        ' max_steps'
    )
  num_envs = arguments.num_envs(num_envs)
  num_threads = arguments.num_threads(num_threads)
  sleep = arguments.flag('sleep', sleep)
  single = load(
      domain_name,
      task_name,
      task_kwargs,
      environment_kwargs,
      design=design,
      overrides=overrides,
  )
  with contextlib.ExitStack() as stack:
    stack.callback(single.close)
    batch = batch_environment.BatchEnvironment(
        single, num_envs, num_threads, sleep
    )
    stack.pop_all()
  return batch


def embed(
    task: composer.Task,
    design: specs.Design,
    *,
    random: int | np.random.RandomState | None = None,
    max_steps: int | None = 1000,
    world: int = 0,
    measurements: Mapping[str, Callable[[Any], Any]] | None = None,
    overrides: Sequence[str] = (),
) -> environment.Environment:
  """Gives any Composer task the feedback of a design, and takes its reward.

  The task's reward becomes the true reward, which only an evaluator hears of.
  What the agent senses are the observables that the task has enabled.

  Args:
    task: The task; registers are attached to its root entity.
    design: As in `load`.
    random: A seed.
    max_steps: After how many control steps an episode ends; `None` if only the
      task ends it.
    world: Which world of a batch this is; the random streams of each differ.
    measurements: What meters can measure besides `score`, the true return so
      far: functions of the physics, by name.
    overrides: Dotted overrides of the design.

  Raises:
    SpecError: If the design is wrong or does not fit the task.
  """
  if not isinstance(task, composer.Task):
    raise errors.SpecError(
        f'task: {messages.quote(task)}; allowed are Composer tasks'
    )
  world = arguments.world(world)
  seed = seeding.as_seed(random)
  max_steps = arguments.max_steps(max_steps)
  measurements = _keywords('measurements', measurements)
  for name, measure in measurements.items():
    if not callable(measure):
      raise errors.SpecError(
          f'measurements: {messages.quote(name)}: {messages.quote(measure)};'
          ' allowed is a function of the physics'
      )
  mechanism = mechanisms.FeedbackMechanism(specs.load(design, overrides))
  mechanism.attach_to(task.root_entity)
  try:
    return _connected(task, mechanism, seed, world, max_steps, measurements)
  except BaseException:
    # A corrected design can be embedded in the same task.
    if isinstance(task, base.Task):
      task.avatar.forget(_blocks(mechanism))
    mechanism.detach_from_root()
    raise


def _connected(
    task: composer.Task,
    mechanism: mechanisms.FeedbackMechanism,
    seed: int,
    world: int,
    max_steps: int | None,
    measurements: Mapping[str, Callable[[Any], Any]],
) -> environment.Environment:
  """Returns the environment of a task that has a mechanism attached."""
  mechanism.connect(
      {
          'score': mechanism.score,
          **(task.measurements if isinstance(task, base.Task) else {}),
          **measurements,
      }
  )
  if isinstance(task, base.Task):
    task.avatar.make_graspable(_blocks(mechanism))
  env = environment.Environment(
      task, mechanism, seed=seed, world=world, max_steps=max_steps
  )
  with contextlib.ExitStack() as stack:
    stack.callback(env.close)
    placement.check(env.physics, task.root_entity, mechanism)
    if isinstance(task, base.Task):
      placement.check_start(env.physics, task, mechanism)
    stack.pop_all()
  return env


def _keywords(what: str, given: Any) -> dict[str, Any]:
  """Returns a copy of a mapping of names, empty for `None`."""
  if given is None:
    return {}
  if not isinstance(given, Mapping) or not all(
      isinstance(key, str) for key in given
  ):
    raise errors.SpecError(
        f'{what}: {messages.quote(given)}; allowed is a mapping with texts as'
        ' keys, and None'
    )
  return dict(given)


def _blocks(mechanism: mechanisms.FeedbackMechanism) -> list[Any]:
  return [b for r in mechanism.registers.values() for b in r.blocks]
