"""The contract of an agent's view, for every world behind it: campaign C01.

Every function returns complaints, none if all is well, so that each can be
shown to find what was planted.
"""

from collections.abc import Iterator
import itertools
from typing import Any

from absl.testing import absltest
from dm_control import composer
import dm_env
from dm_env import test_utils
import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.leaks import pairs

# What the worlds of this package let an agent sense, by name.
SENSES = {
    'senses/ray_distances': ((32,), np.float32),
    'senses/ray_classes': ((32,), np.int32),
    'senses/velocity': ((3,), np.float32),
    'senses/position': ((2,), np.float32),
    'senses/heading': ((2,), np.float32),
    'senses/pitch': ((1,), np.float32),
    'senses/holding': ((1,), np.float32),
    'senses/time_left': ((), np.float32),
}
METHODS = [
    'action_spec',
    'close',
    'discount_spec',
    'observation_spec',
    'reset',
    'reward_spec',
    'step',
]
_MAX_STEPS = 9


def all_cases(num_envs: int = 0) -> list[pairs.Case]:
  """Returns every task with every design that ships."""
  return [
      pairs.Case(*task, design, 5, num_envs, 2 * _MAX_STEPS + 3, _MAX_STEPS)
      for task, design in itertools.product(suite.ALL_TASKS, suite.DESIGNS)
  ]


def allowed(case: pairs.Case, env: Any) -> dict[str, Any]:
  """Returns shape and type of what an agent may observe, by key."""
  del case
  registers = env.mechanism.design.registers
  return {
      **SENSES,
      **{
          f'registers/{name}': ((), np.float64)
          for name, register in registers.items()
          if register.role in specs.READ_BY_AGENTS
      },
  }


class _Mixin(test_utils.EnvironmentTestMixin, absltest.TestCase):
  """`dm_env`'s own tests; they are called one by one, on one environment."""

  def __init__(self, view: Any, actions: list[Any]) -> None:
    super().__init__()
    self.object_under_test = view
    self._actions = actions

  def runTest(self) -> None:
    """Is what an instance is made for."""

  def make_object_under_test(self) -> Any:
    return self.object_under_test

  def make_action_sequence(self) -> Any:
    yield from self._actions


def complaints(case: pairs.Case) -> list[str]:
  """Returns the faults of the view of a case."""
  env = case.load()
  view = pairs.view_of(env)
  found = [
      *_complaints_about_names(view),
      *_complaints_about_specs(view, allowed(case, env)),
      *_complaints_about_steps(view, env, case),
  ]
  if not case.num_envs:
    found += _complaints_of_dm_env(view, env, case)
  env.close()
  return found


def _complaints_about_names(view: Any) -> Iterator[str]:
  names = [name for name in dir(view) if not name.startswith('_')]
  if names != METHODS:
    yield f'public names: {names}'
  if attributes := getattr(view, '__dict__', {}):
    yield f'attributes: {attributes}'
  if hasattr(view, 'no_such_name'):
    yield 'any name is an attribute'


def _complaints_about_specs(
    view: Any, expected: dict[str, Any]
) -> Iterator[str]:
  spec = view.observation_spec()
  if {k: (s.shape, s.dtype) for k, s in spec.items()} != expected:
    yield f'observation spec: {sorted(spec)}'
  if any(part.name != key for key, part in spec.items()):
    yield 'a spec has another name than its key'
  reward, discount = view.reward_spec(), view.discount_spec()
  if (reward.minimum, reward.maximum, reward.dtype) != (0, 0, np.float64):
    yield f'reward spec: {reward}'
  if (discount.minimum, discount.maximum) != (0, 1):
    yield f'discount spec: {discount}'
  if view.action_spec() is view.action_spec():
    yield 'a spec is shared'


def _complaints_about_steps(
    view: Any, env: Any, case: pairs.Case
) -> Iterator[str]:
  """Plays two episodes."""
  expected = allowed(case, env)
  leading = (case.num_envs,) if case.num_envs else ()
  before: list[np.ndarray] = []
  num_last = 0
  for action in pairs.walk(view.action_spec(), case):
    time_step = view.step(action)
    if case.num_envs:
      yield from _complaints_about_many(time_step, case.num_envs)
      num_last += int((time_step.step_type == 2).all())
    else:
      yield from _complaints_about_one(time_step)
      num_last += int(time_step.last())
    observation = time_step.observation
    if type(observation) is not dict or list(observation) != list(
        view.observation_spec()
    ):
      yield f'keys: {sorted(observation)}'
      continue
    arrays = list(observation.values())
    for key, value in observation.items():
      shape, dtype = expected.get(key, (None, None))
      if type(value) is not np.ndarray or value.dtype != dtype:
        yield f'{key}: {type(value).__name__} {value.dtype}'
      elif value.shape != (*leading, *shape):
        yield f'{key}: shape {value.shape}'
      elif not np.isfinite(value).all():
        yield f'{key}: not finite'
      yield from _complaints_about_memory(key, value)
      behind = helpers.last_observation(env).get(key)
      if any(
          np.shares_memory(value, other)
          for other in (*before, behind)
          if other is not None
      ):
        yield f'{key}: somebody else holds this array'
    before = arrays
  if num_last != 2:
    yield f'{num_last} episodes ended, and not 2'


def _complaints_about_memory(key: str, value: np.ndarray) -> Iterator[str]:
  if value.base is not None or not value.flags.owndata:
    yield f'{key}: a view of something'
  if not (value.flags.c_contiguous and value.flags.writeable):
    yield f'{key}: not contiguous, or not writeable'


def _complaints_about_one(time_step: Any) -> Iterator[str]:
  """About the time step of one world."""
  if type(time_step) is not dm_env.TimeStep or hasattr(time_step, '__dict__'):
    yield f'{type(time_step).__name__} with attributes'
  reward, discount = time_step.reward, time_step.discount
  if time_step.first():
    if reward is not None or discount is not None:
      yield f'FIRST with {reward} and {discount}'
    return
  if type(reward) is not float or pairs.encode(reward) != pairs.encode(0.0):
    yield f'reward: {reward!r}'
  ends = (1.0,) if time_step.mid() else (0.0, 1.0)
  if type(discount) is not float or discount not in ends:
    yield f'discount: {discount!r}'


def _complaints_about_many(time_step: Any, num_envs: int) -> Iterator[str]:
  nothing = np.zeros(num_envs)
  if pairs.encode(time_step.reward) != pairs.encode(nothing):
    yield f'reward: {time_step.reward!r}'
  is_mid = time_step.step_type != 2
  if not np.isin(time_step.discount, (0.0, 1.0)).all():
    yield f'discount: {time_step.discount!r}'
  if (time_step.discount[is_mid] != 1.0).any():
    yield f'discount before the end: {time_step.discount!r}'


def _complaints_of_dm_env(
    view: Any, env: Any, case: pairs.Case
) -> Iterator[str]:
  """Yields the failures of `dm_env`'s own tests."""
  mixin = _Mixin(view, pairs.walk(view.action_spec(), case))
  for name in dir(mixin):
    if name.startswith('test_'):
      env.rewind()  # Some want one that nothing has happened in.
      try:
        getattr(mixin, name)()
      except (AssertionError, ValueError) as error:
        yield f'{name}: {error}'


def enabling_everything(case: pairs.Case) -> list[str]:
  """Campaign C11: every observable of everything is enabled.

  Before there is a view, after, and after an episode has begun.
  """
  found = []
  for when in ('before the view', 'after it', 'in an episode'):
    env = case.load()
    expected = sorted(allowed(case, env))
    if when == 'before the view':
      enable_all(env)
    view = pairs.view_of(env)
    if when == 'in an episode':
      view.reset()
    if when != 'before the view':
      enable_all(env)
    actions = pairs.walk(view.action_spec(), case)
    for action in actions[:4]:
      observation = view.step(action).observation
      found += [f'{when}: {key}' for key in observation if key not in expected]
    keys = sorted(view.observation_spec())
    if keys != expected:
      found.append(f'{when}: the spec has {keys}')
    env.close()
  return found


def enable_all(env: Any) -> int:
  """Enables all observables of all entities except cameras: no GL here."""
  count = 0
  for entity in env.task.root_entity.iter_entities():
    for name, observable in entity.observables.as_dict().items():
      if not name.endswith('camera'):
        observable.enabled = True
        count += 1
  for observable in env.task.task_observables.values():
    observable.enabled = True
  return count


def divergence(case: pairs.Case) -> list[str]:
  """Channel L43: the end of an episode whose physics failed."""
  env = case.load()
  view = pairs.view_of(env)
  view.reset()
  found = []
  actions = pairs.walk(view.action_spec(), case)
  before = view.step(actions[0])
  env.physics.data.qpos[:] = np.nan
  last = view.step(actions[1])
  if not last.last():
    found.append('the episode goes on')
  if last.discount != 1.0:
    found.append(f'discount {last.discount}')
  for key, value in last.observation.items():
    if pairs.encode(value) != pairs.encode(before.observation[key]):
      found.append(f'{key} is of a state that MuJoCo has reset')
  if not view.step(actions[2]).first():
    found.append('no new episode')
  env.close()
  return found


def body_trees(case: pairs.Case) -> list[str]:
  """Channel L25: blocks of meters hang from nothing that moves."""
  env = case.load()
  model = env.physics.model
  found = []
  for name, register in env.mechanism.registers.items():
    for block in register.blocks:
      body = model.geom_bodyid[env.physics.bind(block.geom).element_id]
      body = model.body_parentid[body]
      while body:
        if model.body_jntnum[body] or model.body_mocapid[body] >= 0:
          found.append(f'{name} hangs from {model.id2name(body, "body")}')
        body = model.body_parentid[body]
  env.close()
  return found


def headroom(case: pairs.Case) -> list[str]:
  """Channel L23: room for contacts is not what ends an episode.

  Returns:
    A complaint where a meter, wherever in its range it is, brings MuJoCo's
    memory to more than half of what it has.
  """
  env = case.load()
  env.reset()
  data = env.physics.data
  found = []
  registers = env.mechanism.registers
  action = pairs.walk(env.action_spec(), case)[0]
  for share in (0.0, 0.5, 1.0):
    for register in registers.values():
      spec = register.value_spec
      value = spec.minimum + share * (spec.maximum - spec.minimum)
      register.write(env.physics, np.full(spec.shape, value))
    env.step(action)
    if 2 * data.maxuse_arena > data.narena:
      found.append(f'{data.maxuse_arena} of {data.narena} bytes are used')
  env.close()
  return found


def composer_like(env: environment.Environment) -> dict[str, np.ndarray]:
  """Returns the observables that are enabled, as Composer would."""
  observations = {}
  for entity in env.task.root_entity.iter_entities():
    for name, observable in entity.observables.as_dict().items():
      if observable.enabled and not isinstance(observable, composer.Entity):
        value = observable.observation_callable(env.physics)()
        key = f'senses/{entity.mjcf_model.model}/{name}'
        observations[key] = np.asarray(value, float)
  return observations
