"""Names of tasks: a domain, and a task in it.

A world registers itself where it is defined. The tasks of a domain of this
package are in the module of that name, which is imported when one of them, or a
list, is asked for. `--import` names modules of other packages.
"""

from collections.abc import Callable, Mapping, Sequence
import functools
import importlib
import inspect
import pkgutil
from typing import Any, Final, TypeVar

from realab_suite import errors
from realab_suite import tasks
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.tasks import base
from realab_suite.tasks import layouts

TaskFactory = Callable[..., base.Task]

_Factory = TypeVar('_Factory', bound=Callable[..., Any])

TRAIN: Final = 'train'
"""Tag of the members of a class of tasks that agents are trained on."""

HELD_OUT: Final = 'held_out'
"""Tag of the members of a class of tasks that agents are judged on."""

MODULES: Final = tuple(m.name for m in pkgutil.iter_modules(tasks.__path__))
"""Names of the modules of this package, among them those of its domains."""

_TASKS: dict[tuple[str, str], tuple[TaskFactory, frozenset[str]]] = {}


def register_task(
    domain_name: str, task_name: str, *tags: str
) -> Callable[[_Factory], _Factory]:
  """Returns a decorator that registers a task under a name.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the variation.
    *tags: Tags of the task; see `suite.get_tasks_by_tag`.

  Raises:
    SpecError: If a name is not a string, or if it is that of another task; see
      `config.registry.is_same`.
  """
  for name in (domain_name, task_name):
    if not isinstance(name, str):
      raise errors.SpecError(
          f'task name {messages.quote(name)}; must be a string'
      )

  def decorate(factory: _Factory) -> _Factory:
    _import(domain_name)
    name = domain_name, task_name
    if name in _TASKS and not registry.is_same(_TASKS[name][0], factory):
      raise errors.SpecError(
          f'task {domain_name}.{task_name} is registered already;'
          f' {registry.HOW_TO_REPLACE}'
      )
    _TASKS[name] = factory, frozenset(tags)
    return factory

  return decorate


def register_variations(
    domain_name: str, variations: Mapping[str, Sequence[str]]
) -> Callable[[_Factory], _Factory]:
  """Returns a decorator that registers a task for each of its variations.

  Args:
    domain_name: Name of the domain.
    variations: Tags of each variation, by its name, which is the name of the
      task and the first argument of the decorated class.

  Raises:
    SpecError: As `register_task`.
  """

  def decorate(factory: _Factory) -> _Factory:
    for name, tags in variations.items():
      variation = functools.partial(factory, name)
      register_task(domain_name, name, *tags)(variation)
    return factory

  return decorate


def register_layouts(
    domain_name: str, variations: Mapping[str, layouts.Layout]
) -> Callable[[_Factory], _Factory]:
  """Returns a decorator that registers a task for each layout of its room.

  Args:
    domain_name: Name of the domain.
    variations: Layout of each variation, by its name, a key of `layouts.TAGS`.
      It is the argument `layout` of the decorated class.

  Raises:
    SpecError: As `register_task`, and if a name is not in `layouts.TAGS`.
  """
  if unknown := [name for name in variations if name not in layouts.TAGS]:
    raise errors.SpecError(
        f'layouts {unknown} of {domain_name}; must be {[*layouts.TAGS]};'
        ' register_variations registers tasks of other names'
    )

  def decorate(factory: _Factory) -> _Factory:
    for name, layout in variations.items():
      variation = functools.partial(factory, layout=layout)
      register_task(domain_name, name, *layouts.TAGS[name])(variation)
    return factory

  return decorate


def find(domain_name: str, task_name: str | None) -> TaskFactory:
  """Returns the function that makes a task.

  Args:
    domain_name: Name of the domain.
    task_name: Name of the task; `None` is unknown, as any other.

  Raises:
    UnknownNameError: If there is no such task.
  """
  if isinstance(domain_name, str) and isinstance(task_name, str):
    _import(domain_name)
    if (domain_name, task_name) in _TASKS:
      return _TASKS[domain_name, task_name][0]
  domains: dict[str, list[str]] = {}
  for domain, task in names():
    domains.setdefault(domain, []).append(task)
  listed = {k: f'{k}.{{{",".join(v)}}}' for k, v in domains.items()}
  full_name = _format(domain_name)
  candidates = [*domains]
  if task_name is not None:
    full_name = f'{full_name}.{_format(task_name)}'
    candidates = [f'{domain}.{task}' for domain, task in names()]
  elif full_name in listed:
    raise errors.UnknownNameError(
        f'task {full_name}: a domain alone; must be one of {listed[full_name]}'
    )
  raise errors.UnknownNameError(
      f'task {full_name} is unknown'
      f'{messages.did_you_mean(full_name, candidates)}; known are'
      f' {", ".join(listed.values())}; a task of your own is known once its'
      ' module is imported (--import of programs)'
  )


def dynamics_version(domain_name: str, task_name: str) -> int:
  """Returns the version of the dynamics of a task.

  It is an attribute of the class; of a function, a task has to be made.

  Raises:
    UnknownNameError: If there is no such task.
  """
  factory = find(domain_name, task_name)
  made = _made(factory)
  task: Any = made if hasattr(made, 'DYNAMICS_VERSION') else factory()
  return int(task.DYNAMICS_VERSION)


def argument_names(factory: Callable[..., Any]) -> list[str] | None:
  """Returns the names of the keyword arguments that a factory declares.

  Args:
    factory: A function, a class that may pass arguments on to its base classes,
      or a partial function of one.

  Returns:
    The names; `None` if it passes arguments on to something else.
  """
  signatures = [inspect.signature(factory)]
  product = _made(factory)
  for base_class in inspect.getmro(product) if inspect.isclass(product) else ():
    if '__init__' in vars(base_class) and _passes_on(signatures[-1]):
      signatures.append(inspect.signature(vars(base_class)['__init__']))
  if _passes_on(signatures[-1]):
    return None
  # Subclasses give those of base classes that have positions.
  kinds = [
      (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY),
      *[(inspect.Parameter.KEYWORD_ONLY,)] * len(signatures),
  ]
  return list(
      dict.fromkeys(
          name
          for signature, allowed in zip(signatures, kinds, strict=False)
          for name, parameter in signature.parameters.items()
          if parameter.kind in allowed
      )
  )


def _made(factory: Callable[..., Any]) -> Callable[..., Any]:
  """Returns the class or function that a partial function calls."""
  return factory.func if isinstance(factory, functools.partial) else factory


def _import(domain_name: str) -> None:
  """Imports the module of a domain of this package, which registers tasks."""
  if domain_name in MODULES:
    importlib.import_module(f'{tasks.__name__}.{domain_name}')


def _passes_on(signature: inspect.Signature) -> bool:
  return any(
      parameter.kind == inspect.Parameter.VAR_KEYWORD
      for parameter in signature.parameters.values()
  )


def names(tag: str | None = None) -> tuple[tuple[str, str], ...]:
  """Returns the `(domain, task)` names of all tasks, or of those with a tag.

  Those of domains of this package come first, by domain.
  """
  for module in MODULES:
    _import(module)
  domains = dict.fromkeys([*MODULES, *(domain for domain, _ in _TASKS)])
  return tuple(
      name
      for domain in domains
      for name, (_, tags) in _TASKS.items()
      if name[0] == domain and (tag is None or tag in tags)
  )


def of_package() -> tuple[tuple[str, str], ...]:
  """Returns the `(domain, task)` names of the tasks of this package."""
  return tuple(
      name
      for name in names()
      if _made(_TASKS[name][0]).__module__.startswith(f'{tasks.__name__}.')
  )


def tags(domain_name: str, task_name: str) -> frozenset[str]:
  """Returns the tags of a task.

  Raises:
    UnknownNameError: If there is no such task.
  """
  find(domain_name, task_name)
  return _TASKS[domain_name, task_name][1]


def _format(name: Any) -> str:
  """Returns a name for messages, quoted unless it is short and one line."""
  is_plain = isinstance(name, str) and name.isprintable() and len(name) <= 80
  return name if is_plain else messages.quote(name)
