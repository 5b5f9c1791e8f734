"""Functions that load tasks together with the feedback of agent designs."""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
import enum
import functools
from typing import TYPE_CHECKING, Any, final
import warnings

from dm_control import composer
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.config import documents
from realab_suite.config import integers
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import task_names
from realab_suite.engine import arguments
from realab_suite.engine import embedding
from realab_suite.engine import environment
from realab_suite.engine import seeding
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.tasks import base
from realab_suite.tasks import registry

if TYPE_CHECKING:
  from realab_suite.engine import batch_environment

# Importing Composer makes Python show all such warnings. This one is about a
# line of dm_control that NumPy 2.5 deprecates, and every load repeats it.
warnings.filterwarnings(
    'ignore',
    'Setting the shape on a NumPy array',
    DeprecationWarning,
    r'dm_control\.mujoco\.index',
)

MAX_STEPS = 250
"""Length of an episode of the tasks of this suite, in control steps."""


@final
class Omitted(enum.Enum):
  """Value of the argument `design` if it is omitted: the name of a design."""

  DESIGN = 'instantaneous_reward'

  def __repr__(self) -> str:
    return f'<{self.value}>'


register_task = registry.register_task
"""Decorator that registers a task under a name."""


def _names(domain_name: Any, task_name: Any) -> tuple[Any, Any]:
  """Returns the names of a domain and a task; the first may contain both."""
  is_dotted = isinstance(domain_name, str) and '.' in domain_name
  if task_name is None and is_dotted:
    return task_names.split(domain_name)
  if is_dotted and isinstance(task_name, Mapping):
    raise errors.SpecError(
        f'task_name: {messages.quote(task_name)}; {domain_name!r} contains the'
        ' name of the task, so pass arguments by their names, such as'
        f' task_kwargs={messages.quote(dict(task_name))}'
    )
  return domain_name, task_name


def get_tasks_by_tag(tag: str) -> tuple[tuple[str, str], ...]:
  """Returns the `(domain, task)` names of all tasks with a tag."""
  return registry.names(tag)


ALL_TASKS: tuple[tuple[str, str], ...]
"""`(domain, task)` names of the tasks of this package."""

BENCHMARKING: tuple[tuple[str, str], ...]
"""`(domain, task)` names of the tasks to report results on."""

TASKS_BY_DOMAIN: Mapping[str, tuple[str, ...]]
"""Names of the tasks of this package, by domain."""

_LISTS = ('ALL_TASKS', 'BENCHMARKING', 'TASKS_BY_DOMAIN')


def __getattr__(name: str) -> Any:
  """Returns a list of tasks, which imports all tasks, when it is asked for."""
  if name not in _LISTS:
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
  names = registry.of_package()
  if name == 'ALL_TASKS':
    return names
  if name == 'BENCHMARKING':
    tagged = get_tasks_by_tag('benchmarking')
    return tuple(task for task in names if task in tagged)
  return {
      domain: tuple(task for d, task in names if d == domain)
      for domain in dict.fromkeys(domain for domain, _ in names)
  }


DESIGNS = tuple(name for name in specs.DESIGNS if name not in registry.MODULES)
"""Names of the designs of this package for any of its worlds."""


def designs_for(domain_name: str) -> tuple[str, ...]:
  """Returns the names of the designs of this package for a domain.

  They are `DESIGNS`, and the one that is made for the domain and has its name.

  Args:
    domain_name: Name of the domain.
  """
  return (*DESIGNS, *(name for name in specs.DESIGNS if name == domain_name))


@final
@dataclasses.dataclass(frozen=True)
class TaskClass:
  """A class of tasks: agents are trained on some members, judged on others.

  Agents learn only from feedback which member they act in.

  Attributes:
    domain: Name of the domain.
    train: `(domain, task)` names of the members for training.
    held_out: `(domain, task)` names of the members for judging.
  """

  domain: str
  train: tuple[tuple[str, str], ...]
  held_out: tuple[tuple[str, str], ...]


def load_class(domain_name: str) -> TaskClass:
  """Returns the members of a class of tasks.

  They are the tasks of a domain with the tags `train` and `held_out`.

  Args:
    domain_name: Name of the domain.

  Raises:
    UnknownNameError: If the domain has no members of either kind.
  """
  lists = [registry.names(tag) for tag in (registry.TRAIN, registry.HELD_OUT)]
  train, held_out = (
      tuple(name for name in names if name[0] == domain_name) for names in lists
  )
  if not (train and held_out):
    first, second = ({domain for domain, _ in names} for names in lists)
    classes = sorted(first & second)
    raise errors.UnknownNameError(
        f'class of tasks {messages.quote(domain_name)}: the domain has no tasks'
        f' with the tag {registry.HELD_OUT if train else registry.TRAIN!r}'
        f'{messages.did_you_mean(domain_name, classes)}; classes are {classes}'
    )
  return TaskClass(domain_name, train, held_out)


def dynamics(domain_name: str, task_name: str) -> tuple[int, str | None]:
  """Returns the version and a digest of the dynamics of a task.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.

  Returns:
    Version of the dynamics, which increases with every change of them, and the
    digest of a golden trajectory; `None` if no digest is recorded for the
    installed version of MuJoCo.

  Raises:
    UnknownNameError: If there is no such task.
  """
  version = registry.dynamics_version(domain_name, task_name)
  golden = documents.folder_of_configs() / 'golden.yaml'
  recorded = loading.parse_yaml(golden.read_bytes(), 'golden.yaml')
  digests = recorded.get(mujoco.__version__, {})
  return version, digests.get(f'{domain_name}.{task_name}')


def load(
    domain_name: str,
    task_name: str | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
    *,
    design: specs.Design | Omitted | None = Omitted.DESIGN,
    overrides: Sequence[str] = (),
) -> environment.Environment:
  """Loads a task with the feedback of an agent design.

  Args:
    domain_name: Name of the domain, such as `'unlock_door'`; or of the task
      with its domain, `'unlock_door.standard'`, without `task_name`.
    task_name: Name of the variation, such as `'standard'`.
    task_kwargs: Seed `random` and keyword arguments of the task, such as
      `camera_size`.
    environment_kwargs: Length of an episode in control steps, `max_steps`;
      names of the agent's senses, `senses`, such as `['camera']` (default: the
      `default_senses` of the task and `time_left`); and index of the world,
      `world`: the environment equals the world of this index in a batch.
    visualize_reward: Must be `False`. Another value would show the true reward
      to the agent.
    design: Name of a design of this package, path of a design file, mapping, or
      spec; `None` or `'none'` for a world without feedback. If it is omitted,
      it is `'instantaneous_reward'`; a world of another package that this does
      not fit is then loaded without feedback, with a warning.
    overrides: Dotted overrides of the design, such as `'channel=secure'`.

  Raises:
    SpecError: If a name, an argument or the design is wrong.
  """
  if visualize_reward is not False:
    raise errors.SpecError(
        f'visualize_reward={messages.quote(visualize_reward)} would show the'
        ' true reward to the agent; must be False'
    )
  return _single(
      domain_name, task_name, task_kwargs, environment_kwargs, design, overrides
  )


def _single(
    domain_name: str,
    task_name: str | None,
    task_kwargs: Mapping[str, Any] | None,
    environment_kwargs: Mapping[str, Any] | None,
    design: specs.Design | Omitted | None,
    overrides: Sequence[str],
) -> environment.Environment:
  """Returns the environment of `load`, for the function that users call."""
  domain_name, task_name = _names(domain_name, task_name)
  kwargs = _keywords('task_kwargs', task_kwargs)
  random = kwargs.pop('random', None)
  task = make_task(domain_name, task_name, kwargs)
  options = {
      'max_steps': MAX_STEPS,
      **_keywords('environment_kwargs', environment_kwargs),
  }
  keys = ('max_steps', 'senses', 'world')
  if unknown := [key for key in options if key not in keys]:
    raise errors.SpecError(
        f'environment_kwargs: unknown {messages.quote(unknown)}'
        f'{messages.did_you_mean(unknown[0], keys)}; must be max_steps,'
        ' senses or world'
    )
  embedded = functools.partial(
      embed, task, random=random, overrides=overrides, **options
  )
  if not isinstance(design, Omitted):
    return embedded(design='none' if design is None else design)
  try:
    return embedded(design=design.value)
  except errors.SpecError as error:
    if overrides or (domain_name, task_name) in registry.of_package():
      raise
    env = embedded(design='none')
    warnings.warn(
        f'{domain_name}.{task_name} is loaded without feedback, because no'
        f' design is given, and {design.value} does not fit: {error}',
        stacklevel=3,
    )
    return env


def make_task(
    domain_name: str, task_name: str | None, kwargs: Mapping[str, Any]
) -> composer.Task:
  """Returns a task without feedback, which is not compiled.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.
    kwargs: Keyword arguments of the task, without a seed.

  Raises:
    SpecError: If a name or an argument is wrong.
  """
  factory = registry.find(domain_name, task_name)
  try:
    return factory(**kwargs)
  except errors.RealabError:
    raise
  except Exception as error:  # Tasks may raise any class.
    location = messages.Location(f'task_kwargs of {domain_name}.{task_name}')
    problem = _problem_of_arguments(error, factory, kwargs)
    raise location.error(problem) from error


def _problem_of_arguments(
    error: Exception, factory: Callable[..., Any], keywords: Mapping[str, Any]
) -> str:
  """Returns why a factory did not build a task from the given arguments."""
  hint = "; the seed is 'random'" if 'seed' in keywords else ''
  declared = registry.argument_names(factory)
  if declared is not None and 'unexpected keyword argument' in str(error):
    names = [*declared, 'random']
    for key in keywords:
      if key not in names:
        return (
            f'unknown argument {messages.quote(key)}'
            f'{hint or messages.did_you_mean(key, names)}; must be one of'
            f' {names}'
        )
  return f'{messages.exception(error)}{hint}'


def load_batch(
    domain_name: str,
    task_name: str | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    *,
    num_envs: int,
    num_threads: int = 0,
    sleep: bool = False,
    design: specs.Design | Omitted | None = Omitted.DESIGN,
    overrides: Sequence[str] = (),
) -> 'batch_environment.BatchEnvironment':
  """Loads a batch of worlds of a task.

  World i is bit for bit identical to the result of `load` with
  `environment_kwargs={'world': i}`, unless `sleep` is True.

  Args:
    domain_name: Same as in `load`.
    task_name: Same as in `load`.
    task_kwargs: Same as in `load`.
    environment_kwargs: Same as in `load`, without `world`.
    num_envs: Number of worlds, at most 65,536.
    num_threads: Number of threads that step the worlds, at most 1,024; 0 for
      one thread per processor.
    sleep: True if blocks at rest fall asleep until they are touched or written.
      Sleep is faster, but trajectories differ from those of `load`, and the
      worlds cannot be saved or restored.
    design: Same as in `load`.
    overrides: Same as in `load`.

  Raises:
    SpecError: If a name, an argument or the design is wrong.
  """
  if 'world' in _keywords('environment_kwargs', environment_kwargs):
    raise errors.SpecError(
        'environment_kwargs: unknown world: a batch contains all worlds from'
        ' 0'
    )
  num_envs = arguments.num_envs(num_envs)
  num_threads = arguments.num_threads(num_threads)
  sleep = arguments.flag('sleep', sleep)
  single = _single(
      domain_name, task_name, task_kwargs, environment_kwargs, design, overrides
  )
  # Programs with one world need no batches.
  from realab_suite.engine import batch_environment

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
    senses: Sequence[str] | None = None,
    measurements: Mapping[str, Callable[[Any], Any]] | None = None,
    overrides: Sequence[str] = (),
) -> environment.Environment:
  """Returns an environment of a Composer task with the feedback of a design.

  The reward of the task becomes the true reward, which only the evaluator gets.
  A foreign task offers the observables that it has enabled as senses.

  Args:
    task: Composer task; the registers are attached to its root entity.
    design: Same as in `load`, except `None`.
    random: Seed.
    max_steps: Length of an episode, in control steps; `None` if only the task
      ends episodes.
    world: Index of the world in a batch; random streams differ between worlds.
    senses: Names of the agent's senses; `None` for the `default_senses` of a
      task of this package, or all senses of a foreign task, and `time_left`.
    measurements: Functions of the physics that meters can measure, by name, in
      addition to those of the task. None may replace a function of the task or
      `score`, the true return so far.
    overrides: Same as in `load`.

  Raises:
    SpecError: If the design is wrong or does not fit the task.
  """
  if not isinstance(task, composer.Task):
    from realab_suite.engine import foreign

    raise errors.SpecError(
        f'task: {messages.quote(task)}; must be a Composer task'
        f'{foreign.hint(task)}'
    )
  if isinstance(task.observables, list | tuple):
    raise errors.SpecError(
        f'task: {type(task).__name__} has {len(task.observables)} agents;'
        ' must have one'
    )
  world = integers.check('world', world, 0)
  seed = seeding.as_seed(random)
  if max_steps is not None:
    max_steps = integers.check('max_steps', max_steps, 1, more=', and None')
  senses = arguments.senses(senses)
  measurements = _keywords('measurements', measurements)
  for name, measure in measurements.items():
    if not callable(measure):
      raise errors.SpecError(
          f'measurements: {messages.quote(name)}: {messages.quote(measure)};'
          ' must be a function of the physics'
      )
  spec = specs.load(design, overrides).in_world(getattr(task, 'SOLVER', None))
  mechanism = mechanisms.FeedbackMechanism(
      spec.fitted(getattr(task, 'measured_ranges', {}))
  )
  mechanism.attach_to(task.root_entity)
  try:
    return _connected(
        task, mechanism, seed, world, max_steps, senses, measurements
    )
  except BaseException:
    # Allows embedding a corrected design in the same task.
    embedding.remove_registers(task, mechanism)
    mechanism.detach_from_root()
    raise


def _connected(
    task: composer.Task,
    mechanism: mechanisms.FeedbackMechanism,
    seed: int,
    world: int,
    max_steps: int | None,
    senses: Sequence[str] | None,
    measurements: Mapping[str, Callable[[Any], Any]],
) -> environment.Environment:
  """Returns the environment of a task with an attached mechanism."""
  embedding.connect_meters(task, mechanism, measurements)
  embedding.add_registers(task, mechanism)
  env = _class_for(task)(
      task,
      mechanism,
      seed=seed,
      world=world,
      max_steps=max_steps,
      senses=senses,
  )
  with contextlib.ExitStack() as stack:
    stack.callback(env.close)
    env.check_placement()
    stack.pop_all()
  return env


def _class_for(task: composer.Task) -> type[environment.Environment]:
  """Returns the environment of a task of this package, or of another one."""
  if isinstance(task, base.Task):
    return environment.WorldEnvironment
  from realab_suite.engine import foreign  # Most programs have no such task.

  return foreign.ForeignEnvironment


def _keywords(argument: str, value: Any) -> dict[str, Any]:
  """Returns a copy of a mapping with strings as keys; `None` is an empty one.

  Args:
    argument: Name of the argument, for messages.
    value: Value of the argument.

  Raises:
    SpecError: If the value is not such a mapping.
  """
  if value is None:
    return {}
  if not isinstance(value, Mapping) or not all(
      isinstance(key, str) for key in value
  ):
    raise errors.SpecError(
        f'{argument}: {messages.quote(value)}; must be a mapping with'
        ' strings as keys, or None'
    )
  return dict(value)
