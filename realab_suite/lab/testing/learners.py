"""Contract of learners: deterministic, resumable, and blind to the truth."""

from collections.abc import Callable, Sequence
import contextlib
import copy
from typing import Any

import numpy as np

from realab_suite import archive
from realab_suite import errors
from realab_suite import suite
from realab_suite import trees
from realab_suite.engine import batch_environment
from realab_suite.feedback import specs
from realab_suite.testing import contracts

_NUM_ENVS = 4
# Episodes end within a check.
_MAX_STEPS = 15


def check_learner(
    make: Callable[..., Any],
    design: specs.Design = 'instantaneous_reward',
    *,
    overrides: Sequence[str] = (),
    num_steps: int = 60,
    domain_name: str = 'unlock_door',
    task_name: str = 'near',
) -> None:
  """Checks that a learner keeps the contract of learners.

  - Its actions match the action spec, and it leaves time steps as they are.
  - Equal seeds give equal actions. A learner that continues from a state gives
    the same actions as the one that the state is of. States are plain data, and
    later steps do not change them.
  - `act` depends on the networks, the observation and the key alone, for any
    number of worlds, and changes nothing.
  - Metrics are finite numbers. The state of a learner of another kind is
    refused, and nothing changes.

  Args:
    make: Returns a new learner from the observation spec and the action spec of
      one world, the number of worlds, and a seed, such as
      `functools.partial(agents.make, {'kind': 'mine', 'reward': 'reward'})`.
    design: Design with the registers that the learner needs; same as in
      `suite.load`.
    overrides: Same as in `suite.load`.
    num_steps: Number of control steps before and after the state is saved; at
      least one update should be among them.
    domain_name: Domain of the world.
    task_name: Task of the world.

  Raises:
    ContractError: If it does not, with the first part that it breaks.
    SpecError: If the learner refuses the specs.
  """
  with contextlib.closing(
      suite.load_batch(
          domain_name,
          task_name,
          {'random': 1},
          {'max_steps': _MAX_STEPS},
          num_envs=_NUM_ENVS,
          num_threads=1,
          design=design,
          overrides=overrides,
      )
  ) as env:

    def learner(seed: int) -> Any:
      return make(env.observation_spec(), env.action_spec(), _NUM_ENVS, seed)

    first, twin = learner(1), learner(1)
    time_step = env.reset()
    for _ in range(num_steps):
      time_step = env.step(_actions(env, first, twin, time_step, 'its twin'))
    _check_metrics(first)
    saved = first.state()
    try:
      archive.Archive({'what': 'state'}, saved)
    except errors.StateLayoutError as error:
      raise contracts.ContractError(str(error)) from error
    _check_act(env, first, time_step)
    kept = copy.deepcopy(saved)
    successor = learner(2)
    successor.set_state(saved)
    for _ in range(num_steps):
      time_step = env.step(
          _actions(env, first, successor, time_step, 'one with its state')
      )
    contracts.require(
        trees.are_equal(saved, kept), 'state: later steps change it; copy it'
    )
    _check_refusal(first)


def _actions(
    env: batch_environment.BatchEnvironment,
    learner: Any,
    other_learner: Any,
    time_step: Any,
    who: str,
) -> np.ndarray:
  """Returns the actions of a learner, and checks them.

  Args:
    env: Environment of the time step.
    learner: The learner.
    other_learner: Learner that has to act in the same way.
    time_step: Time step of the environment.
    who: Description of the other learner, for messages.
  """
  before = {name: np.copy(v) for name, v in time_step.observation.items()}
  actions = learner.step(time_step)
  _check_actions(env, actions, _NUM_ENVS, 'step')
  contracts.require_same(
      time_step.observation, before, 'step: the time step was changed'
  )
  contracts.require_same(
      {'actions': other_learner.step(time_step)},
      {'actions': actions},
      f'step: {who} acts otherwise; draw from the seed, and keep everything'
      ' in the state',
  )
  return actions


def _check_actions(
    env: batch_environment.BatchEnvironment,
    actions: Any,
    num_envs: int,
    method: str,
) -> None:
  """Checks actions against the action spec."""
  spec = env.action_spec()
  shape = (num_envs, *spec.shape)
  contracts.require(
      isinstance(actions, np.ndarray)
      and (actions.shape, actions.dtype) == (shape, spec.dtype),
      f'{method}: returned {type(actions).__name__} of the shape'
      f' {np.shape(actions)}; must be an array {spec.dtype} of the shape'
      f' {shape}',
  )
  for action in actions:
    try:
      spec.validate(action)
    except ValueError as error:
      raise contracts.ContractError(f'{method}: {error}') from error


def _check_act(
    env: batch_environment.BatchEnvironment, learner: Any, time_step: Any
) -> None:
  """Checks that `act` is a function of its arguments and the networks."""
  before = learner.state()
  key = np.array([3, 4], np.uint32)
  stack = learner.stack(time_step, None)
  for num_envs in (_NUM_ENVS, 1):
    observation = {name: value[:num_envs] for name, value in stack.items()}
    for greedy in (False, True):
      actions = learner.act(observation, key, greedy)
      _check_actions(env, actions, num_envs, 'act')
      contracts.require_same(
          {'actions': learner.act(observation, key, greedy)},
          {'actions': actions},
          'act: the same key gives other actions',
      )
  contracts.require(
      trees.are_equal(learner.state(), before), 'act: changes the state'
  )


def _check_metrics(learner: Any) -> None:
  """Checks that metrics are finite numbers by name."""
  metrics = learner.metrics()
  contracts.require(
      isinstance(metrics, dict)
      and all(
          isinstance(name, str)
          and isinstance(value, int | float)
          and np.isfinite(value)
          for name, value in metrics.items()
      ),
      f'metrics: {metrics!r:.200}; must be finite numbers by name',
  )


def _check_refusal(learner: Any) -> None:
  """Checks that the state of another kind of learner is refused."""
  before = learner.state()
  try:
    learner.set_state({**before, 'kind': 'another_kind'})
  except errors.StateLayoutError:
    pass
  else:
    raise contracts.ContractError(
        "set_state: the state of the kind 'another_kind' is not refused"
    )
  contracts.require(
      trees.are_equal(learner.state(), before),
      'set_state: a refused state changes the learner',
  )
