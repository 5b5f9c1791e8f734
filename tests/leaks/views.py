"""Worlds whose true reward is a secret, and views of them."""

from collections.abc import Callable
from typing import Any

from dm_env import specs
import numpy as np

from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.policies import action_sets
from tests.engine import helpers

# A rare number: any text that contains it reveals the true reward.
CANARY = 173.2317
# A design without meters: nothing in it depends on the true reward.
UNPAID: dict[str, Any] = helpers.one_register(
    'reward', [{'kind': 'constant', 'value': 3.0, 'writes': ['reward']}],
    role='feedback', range=[-2, 12],
)  # fmt: skip


def load(
    world: str = 'collect_apples.standard',
    design: Any = UNPAID,
    num_envs: int = 0,
    max_steps: int = 9,
) -> Any:
  """Returns a world, or a batch of `num_envs` if that is not 0."""
  arguments = world, None, {'random': 5}, {'max_steps': max_steps}
  if not num_envs:
    return suite.load(*arguments, design=design)
  return suite.load_batch(*arguments, num_envs=num_envs, design=design)


def view_of(env: Any, failures: list[Exception] | None = None) -> Any:
  """Returns the agent's view of a world or of a batch."""
  if isinstance(env, environment.Environment):
    return agent_view.AgentView(env, failures)
  return agent_view.BatchAgentView(env, failures)


def specs_of(view: Any) -> list[Any]:
  names = 'action_spec', 'discount_spec', 'observation_spec', 'reward_spec'
  return [getattr(view, name)() for name in names]


def walk(view: Any, number: int, num_envs: int = 0) -> list[np.ndarray]:
  """Returns actions that lead through a room, and so over apples."""
  spec, generator = view.action_spec(), np.random.default_rng(5)
  leading = (number, *[num_envs] * bool(num_envs))
  turns = np.repeat(generator.uniform(-1, 1, leading), 4, axis=0)[:number]
  # Queries are random, if there are any.
  actions = helpers.draw(spec, leading, generator)
  if spec.dtype.kind == 'i':
    ahead, left, right = map(
        action_sets.DMLAB_LIKE.index,
        ('forward', 'forward_turn_left', 'forward_turn_right'),
    )
    moves = np.select([turns > 0.5, turns < -0.5], [left, right], ahead)
    actions[(..., -1) if spec.shape else ...] = moves
    return list(actions)
  names = [name.rpartition('/')[2] for name in spec.name.split('\t')]
  actions[...] = 0.0
  actions[..., names.index('forward')] = 1.0
  actions[..., names.index('turn')] = turns
  return list(actions)


def error_of(call: Callable[..., Any], *arguments: Any) -> Exception | None:
  """Returns what an agent gets from a call instead of a result."""
  try:
    call(*arguments)
  except Exception as error:  # Whatever it is, the agent gets it.
    return error
  return None


def encode(value: Any) -> bytes:
  """Returns a value with its type and its attributes, to the last bit."""
  if isinstance(value, np.ndarray):
    kind = type(value), value.dtype, value.shape, value.strides, value.flags
    return repr(kind).encode() + value.tobytes()
  parts: list[Any] = []
  if isinstance(value, dict):
    parts += value.items()
  elif isinstance(value, list | tuple):
    parts += value
  elif isinstance(value, specs.BoundedArray):
    parts += [value.minimum, value.maximum]
  elif isinstance(value, BaseException):
    parts += [value.__cause__, value.__context__]
  if isinstance(value, tuple | BaseException):
    parts += getattr(value, '__dict__', {}).items()
  return f'{type(value)} {value!r}'.encode() + b','.join(map(encode, parts))
