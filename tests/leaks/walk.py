"""Finds the objects that an agent can reach from its view: campaign C12."""

from collections.abc import Iterator
import functools
import itertools
import types
from typing import Any, NamedTuple

import numpy as np

from realab_suite.engine import agent_view
from realab_suite.engine import batch_time_steps
from realab_suite.entities import appearance
from tests.leaks import pairs
from tests.leaks import secrets

DEPTH = 8
_MOST = 20_000
_FEW = 3
# By what names wrappers lead to what they wrap.
_PROBED = (
    'base_env',
    'env',
    'environment',
    'gym_env',
    'mechanism',
    'physics',
    'random_state',
    'raw_env',
    'task',
    'unwrapped',
    'wrapped_env',
)
_OURS = ('realab_suite', 'dm_control', 'mujoco')
# What is given to agents; the walk goes on through it.
_GIVEN = (
    agent_view.AgentView,
    agent_view.BatchAgentView,
    appearance.ClassArray,
    batch_time_steps.BatchTimeStep,
)
_LEAVES = (str, bytes, int, float, complex, type(None), type, types.ModuleType)


class Found(NamedTuple):
  """An object, and the way to it."""

  path: str
  value: Any


def reach(roots: dict[str, Any], depth: int = DEPTH) -> Iterator[Found]:
  """Yields the objects that can be reached, nearest first.

  Ways are public names, elements of containers, what methods are bound to,
  closures, and what exceptions hold on to; never modules and classes.

  Args:
    roots: The objects at which the walk begins, by name.
    depth: Number of steps.
  """
  todo = [Found(name, value) for name, value in roots.items()]
  seen: dict[int, Any] = {}  # What has been seen has to stay alive.
  for _ in range(depth + 1):
    further = []
    for found in todo:
      if id(found.value) in seen or isinstance(found.value, _LEAVES):
        continue
      if len(seen) >= _MOST:
        return
      seen[id(found.value)] = found.value
      yield found
      further += [
          Found(found.path + step, value) for step, value in _steps(found.value)
      ]
    todo = further


def _steps(value: Any) -> Iterator[tuple[str, Any]]:
  if isinstance(value, np.ndarray):
    yield '.base', value.base
    return
  if isinstance(value, dict):
    for key, part in value.items():
      yield f'[{key!r:.40}]', part
  elif isinstance(value, list | tuple | set | frozenset):
    for i, part in enumerate(value):
      yield f'[{i}]', part
  if isinstance(value, functools.partial):
    yield '.args', (value.func, value.args, value.keywords)
  if isinstance(value, BaseException):
    yield from _steps_of_exception(value)
  for name in ('__self__', '__wrapped__', '__closure__', '__func__'):
    part = _get(value, name)
    if name == '__closure__' and isinstance(part, tuple):
      part = [_get(cell, 'cell_contents') for cell in part]
    yield f'.{name}', part
  names = [n for n in dir(value) if not n.startswith('_')]
  for name in (*names, *_PROBED):
    if not name.startswith('__'):
      yield f'.{name}', _get(value, name)


def _steps_of_exception(error: BaseException) -> Iterator[tuple[str, Any]]:
  yield '.__cause__', error.__cause__
  yield '.__context__', error.__context__
  trace = error.__traceback__
  while trace:
    for name, value in trace.tb_frame.f_locals.items():
      if not name.startswith('_'):
        yield f'.{trace.tb_frame.f_code.co_name}():{name}', value
    trace = trace.tb_next


def _get(value: Any, name: str) -> Any:
  try:
    return getattr(value, name)
  except Exception:  # A property may raise what it likes.
    return None


def given(view: Any, case: pairs.Case) -> dict[str, Any]:
  """Returns all that an agent gets hold of."""
  actions = pairs.walk(view.action_spec(), case)
  roots = {
      'view': view,
      'time_steps': [view.reset(), view.step(actions[0])],
      'specs': [
          view.action_spec(),
          view.observation_spec(),
          view.reward_spec(),
          view.discount_spec(),
      ],
  }
  for name, action in (('action', None), ('object', _Array())):
    try:
      view.step(action)
    except Exception as error:  # Whatever it is, the agent gets it.
      # Its own frame is no news to the agent.
      roots[name] = error.with_traceback(
          error.__traceback__ and error.__traceback__.tb_next
      )
  return roots


class _Array:
  """Something that is no array, and says so."""

  def __array__(self, *args: Any, **kwargs: Any) -> Any:
    raise ZeroDivisionError('no array')


def find(case: pairs.Case) -> list[str]:
  """Returns the nearest few ways to secret objects by public names."""
  env = case.load()
  secrets.SECRETS['reward: the canary'].change(env)
  roots = given(pairs.view_of(env), case)
  paths = (found.path for found in reach(roots) if _is_secret(found.value, env))
  nearest = list(itertools.islice(paths, _FEW))
  env.close()
  return nearest


def _is_secret(value: Any, env: Any) -> bool:
  if isinstance(value, np.ndarray):
    data = getattr(getattr(env, 'physics', None), 'data', None)
    return any(
        np.shares_memory(value, np.asarray(getattr(data, name)))
        for name in ('qpos', 'qvel', 'userdata')
        if hasattr(data, name)
    )
  module = type(value).__module__
  if isinstance(value, np.random.RandomState | np.random.Generator):
    return True
  is_ours = module.split('.')[0] in _OURS
  if isinstance(value, Exception):
    return False
  return is_ours and not isinstance(value, _GIVEN)
