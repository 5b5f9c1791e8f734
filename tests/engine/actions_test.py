"""Every action that satisfies `action_spec()` is accepted, everywhere."""

import copy
import pickle
from typing import Any

from dm_env import specs as dm_env_specs
from dm_env_rpc.v1 import dm_env_rpc_pb2
from dm_env_rpc.v1 import tensor_utils
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import action_codec
from realab_suite.engine import agent_view
from realab_suite.interop.rpc import agent_port
from realab_suite.policies import action_sets
from tests.engine import helpers

_NUM_ACTIONS = 200
# Every so many of them are taken as steps.
_STRIDE = 5
# Besides the designs that ship: a query that cannot be an index, and
# queries beside the elements of continuous control.
_REAL = {
    'real query': ('providers=[]', 'learner=null'),
    'continuous, with queries': (
        'providers=[]', 'learner=null', 'action_set=null',
    ),
    'real and integer queries': (
        'registers.other={kind: two_block, role: query, place: station_3,'
        ' range: [-1.5, 2.5]}',
    ),
}  # fmt: skip
_CASES = {
    **{design: (design, ()) for design in suite.DESIGNS},
    **{name: ('value_advice', overrides) for name, overrides in _REAL.items()},
}


def _extremes(spec: Any) -> list[np.ndarray]:
  """The corners of a spec, and numbers that are next to nothing."""
  low, high = (
      np.broadcast_to(bound, spec.shape).astype(spec.dtype)
      for bound in (spec.minimum, spec.maximum)
  )
  middle = np.clip(np.zeros(spec.shape, spec.dtype), low, high)
  return [np.array(low), np.array(high), middle]


def _actions(spec: Any) -> list[np.ndarray]:
  generator = np.random.default_rng(0)
  drawn = list(helpers.draw(spec, (_NUM_ACTIONS,), generator))
  found = [*drawn, *_extremes(spec)]
  for action in found:
    spec.validate(action)
  return found


@pytest.mark.parametrize(
    ('design', 'overrides'), _CASES.values(), ids=list(_CASES)
)
def test_every_action_in_the_spec_is_accepted(design: str, overrides: Any):
  env = suite.load(
      'collect_apples', 'standard', {'random': 1}, {'max_steps': 10_000},
      design=design, overrides=overrides,
  )  # fmt: skip
  view = agent_view.AgentView(env)
  port = agent_port.AgentPort(agent_view.AgentView(env), env.abandon)
  env.reset()
  actions = _actions(env.action_spec())
  for action in actions:
    queries, controls = env.codec.decode(action)
    assert queries.dtype == controls.dtype == np.float64
  for action in actions[-1::-_STRIDE]:
    assert env.step(action).mid()
    assert view.step(action).mid()
  request = dm_env_rpc_pb2.EnvironmentRequest()
  request.join_world.world_name = agent_port.WORLD
  port.answer(request.SerializeToString())
  for i, action in enumerate(actions[-2::-_STRIDE]):
    request = dm_env_rpc_pb2.EnvironmentRequest()
    request.step.actions[1].CopyFrom(tensor_utils.pack_tensor(action))
    answer = dm_env_rpc_pb2.EnvironmentResponse.FromString(
        port.answer(request.SerializeToString())
    )
    assert not answer.HasField('error'), (i, answer.error.message)


@pytest.mark.parametrize(
    ('design', 'overrides'), _CASES.values(), ids=list(_CASES)
)
def test_every_action_in_the_spec_is_accepted_in_a_batch(
    design: str, overrides: Any
):
  batch = suite.load_batch(
      'collect_apples', 'standard', {'random': 1}, {'max_steps': 10_000},
      num_envs=4, design=design, overrides=overrides,
  )  # fmt: skip
  batch.reset()
  found = _actions(batch.action_spec())[-3::-_STRIDE]
  assert len(found) >= 4
  for first in range(0, len(found) - 3, 4):
    time_step = batch.step(np.stack(found[first : first + 4]))
    assert (time_step.step_type == 1).all()


@pytest.mark.parametrize(
    ('name', 'dtype', 'shape'),
    [
        ('none', np.float64, (6,)),
        ('instantaneous_reward', np.float64, (6,)),
        ('online_imitation', np.int32, ()),
        ('value_advice', np.int32, (2,)),
        ('paired_decoupled_approval', np.int32, (3,)),
        ('real query', np.float64, (2,)),
        ('real and integer queries', np.float64, (3,)),
        ('continuous, with queries', np.float64, (7,)),
    ],
)
def test_a_spec_has_integers_where_all_elements_are_indices(
    name: str, dtype: Any, shape: tuple[int, ...]
):
  design, overrides = _CASES[name]
  env = suite.load(
      'collect_apples', 'standard', design=design, overrides=overrides
  )
  spec = env.action_spec()
  assert (spec.dtype, spec.shape) == (dtype, shape)
  assert spec.name.count('\t') == max(np.prod(shape), 1) - 1


def test_an_index_in_a_vector_of_real_numbers_is_rounded():
  design, overrides = _CASES['real query']
  env, twin = (
      suite.load(
          'collect_apples', 'standard', {'random': 1}, design=design,
          overrides=overrides,
      )
      for _ in range(2)
  )  # fmt: skip
  env.reset()
  twin.reset()
  for real, whole in ((9.3, 9), (0.49, 0), (12.51, 13), (0.5, 0), (1.5, 2)):
    found = helpers.to_bytes(env.step([9.3, real]))
    assert found == helpers.to_bytes(twin.step([9.3, whole]))


# What tasks may say of their actions.


def _codec(spec: Any, action_set: Any = None) -> action_codec.ActionCodec:
  return action_codec.ActionCodec(spec, [], action_set)


@pytest.mark.parametrize('name', [None, '', 'only one', 'a\tb\tc\td'])
def test_elements_without_names_are_numbered(name: Any):
  spec = dm_env_specs.BoundedArray((3,), np.float64, -1, 1, name=name)
  codec = _codec(spec)
  with pytest.raises(
      errors.ActionError, match=r'action\[2\] \(element_2\) = 5.0 outside'
  ):
    codec.decode([0.0, 0.0, 5.0])
  with pytest.raises(errors.SpecError, match=r"has \['element_0',"):
    _codec(spec, action_sets.DMLAB_LIKE)


def test_infinity_is_not_a_number_within_no_bounds():
  spec = dm_env_specs.BoundedArray((2,), np.float64, -np.inf, np.inf)
  codec = _codec(spec)
  codec.decode([1e300, -1e300])
  for wrong in (np.inf, -np.inf, np.nan):
    with pytest.raises(errors.ActionError, match=r'action\[1\]'):
      codec.decode([0.0, wrong])


@pytest.mark.parametrize(
    'spec',
    [
        dm_env_specs.Array((3,), np.float64),
        dm_env_specs.BoundedArray((), np.float64, -1, 1),
        dm_env_specs.BoundedArray((2, 2), np.float64, -1, 1),
        [dm_env_specs.BoundedArray((2,), np.float64, -1, 1)] * 2,
        None,
    ],
    ids=['unbounded', 'no axis', 'two axes', 'several agents', 'nothing'],
)
def test_an_action_spec_that_is_no_bounded_vector_is_refused(spec: Any):
  task = helpers.PointTask()
  task.action_spec = lambda physics: spec  # type: ignore[method-assign]
  with pytest.raises(errors.SpecError, match='action_spec of the task'):
    suite.embed(task, 'none')


# What is no array of numbers.


@pytest.mark.parametrize('is_batch', [False, True])
def test_a_masked_array_is_refused(is_batch: bool):
  load: Any = suite.load
  kwargs: dict[str, Any] = {}
  view: Any = agent_view.AgentView
  if is_batch:
    load, kwargs = suite.load_batch, {'num_envs': 2}
    view = agent_view.BatchAgentView
  env = load('collect_apples', 'standard', **kwargs)
  leading = (2,) if is_batch else ()
  env.reset()
  for mask in (True, False):
    action = np.ma.masked_array(np.zeros((*leading, 6)), mask=mask)
    for step in (env.step, view(env).step):
      with pytest.raises(errors.ActionError, match='masked'):
        step(action)


@pytest.mark.parametrize(
    'steal',
    [
        copy.copy,
        copy.deepcopy,
        pickle.dumps,
        lambda view: view.__reduce__(),
        lambda view: view.__reduce_ex__(4),
        lambda view: view.__getstate__(),
    ],
    ids=['copy', 'deepcopy', 'pickle', 'reduce', 'reduce_ex', 'getstate'],
)
@pytest.mark.parametrize('is_batch', [False, True])
def test_a_view_cannot_be_copied(steal: Any, is_batch: bool):
  if is_batch:
    env: Any = suite.load_batch('collect_apples', 'near', num_envs=2)
    view: Any = agent_view.BatchAgentView(env)
  else:
    env = suite.load('collect_apples', 'near')
    view = agent_view.AgentView(env)
  with pytest.raises(TypeError, match='cannot be pickled or copied'):
    steal(view)
