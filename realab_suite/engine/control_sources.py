"""MJCF sources of the tasks of `dm_control.suite`.

A loaded task has a compiled model only, but registers have to be attached to
its source. The source is found by asking the task's domain for the sources of
all of its tasks.
"""

from collections.abc import Iterator, Mapping
import importlib.util
import inspect
from typing import Any, Self, final
from xml.etree import ElementTree

from dm_control import mjcf
from dm_control import mujoco as dm_mujoco
from dm_control.rl import control
import mujoco

from realab_suite import errors
from realab_suite.config import messages

# Numbers that two models have in common if one is compiled from the source of
# the other. Values may differ: tasks change them, and some are drawn at random.
_SIZES = (
    'nq', 'nv', 'nu', 'na', 'nbody', 'njnt', 'ngeom', 'nsite', 'ncam', 'nlight',
    'ntendon', 'neq', 'nsensordata', 'nmocap', 'names',
)  # fmt: skip


class _Found(Exception):
  """Raised instead of compiling, with the source of a model."""

  def __init__(self, xml: str | bytes, assets: Mapping[str, Any]) -> None:
    super().__init__()
    self.xml = xml
    self.assets = assets


@final
class _Recorder(dm_mujoco.Physics):
  """Physics that raises `_Found` instead of compiling a model."""

  @classmethod
  def from_xml_string(cls, xml_string: Any, assets: Any = None) -> Self:
    raise _Found(xml_string, assets or {})


def load(
    domain_name: str, task_name: str, **kwargs: Any
) -> control.Environment:
  """Loads a task of `dm_control.suite`.

  Args:
    domain_name: Name of the domain, such as `'quadruped'`.
    task_name: Name of the task, such as `'fetch'`.
    **kwargs: Keyword arguments of the task.

  Raises:
    UnknownNameError: If there is no such task.
  """
  # The import takes as long as those of half of this package.
  from dm_control import suite

  if (domain_name, task_name) not in suite.ALL_TASKS:
    known = [f'{domain}.{task}' for domain, task in suite.ALL_TASKS]
    related = [name for name in known if name.startswith(f'{domain_name}.')]
    hint = messages.did_you_mean(f'{domain_name}.{task_name}', known)
    raise errors.UnknownNameError(
        f'task {messages.quote(task_name)} of {messages.quote(domain_name)} is'
        f' unknown in dm_control.suite{hint}; known are {related or known}'
    )
  return suite.load(domain_name, task_name, task_kwargs={'random': 0, **kwargs})


def find(env: control.Environment) -> mjcf.RootElement:
  """Returns a new PyMJCF model that compiles to the model of a task.

  Values of the result may differ, such as the position of a target.

  Args:
    env: Loaded task of a domain like those of `dm_control.suite`.

  Raises:
    SpecError: If its source cannot be found.
  """
  for xml, assets in _candidates(type(env.physics).__module__):
    compiled = mujoco.MjModel.from_xml_string(xml, dict(assets))
    own = env.physics.model.ptr
    if all(getattr(compiled, s) == getattr(own, s) for s in _SIZES):
      return _parsed(xml, assets)
  raise errors.SpecError(
      f'task: {type(env.task).__name__} with'
      f' {type(env.physics).__module__}.{type(env.physics).__name__}, whose'
      ' MJCF source is unknown; allowed are Composer tasks, and tasks in the'
      ' SUITE of a domain like those of dm_control.suite'
  )


def _candidates(
    module_name: str,
) -> Iterator[tuple[str | bytes, Mapping[str, Any]]]:
  """Yields the source and the assets of each task of a domain.

  The domain runs in a copy of its module whose physics class passes on what it
  is given, so that the domain itself stays as it is.

  Args:
    module_name: Name of the module of a domain.
  """
  spec = importlib.util.find_spec(module_name)
  if spec is None or spec.loader is None:
    return
  module: Any = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  if not hasattr(module, 'SUITE') or not hasattr(module, 'Physics'):
    return

  module.Physics = _Recorder
  for make in module.SUITE.values():
    # Some tasks draw parts of their models.
    seeded = 'random' in inspect.signature(make).parameters
    try:
      make(**({'random': 0} if seeded else {}))
    except _Found as source:
      yield source.xml, source.assets


def _parsed(xml: Any, assets: Mapping[str, Any]) -> mjcf.RootElement:
  """Returns a source as a PyMJCF model to which registers can be attached."""
  root = ElementTree.fromstring(xml)
  # PyMJCF writes the root class itself.
  for default in root.findall('default[@class]'):
    del default.attrib['class']
  # It would change the masses of registers.
  for compiler in root.findall('compiler[@settotalmass]'):
    del compiler.attrib['settotalmass']
  # They contain no positions of registers.
  for keyframe in root.findall('keyframe'):
    root.remove(keyframe)
  return mjcf.from_xml_string(ElementTree.tostring(root), assets=dict(assets))
