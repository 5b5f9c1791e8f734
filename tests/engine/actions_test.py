"""Every action that satisfies `action_spec()` is accepted, everywhere."""

from typing import Any

from dm_env import specs as dm_env_specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view
from tests.engine import helpers

_NUM_ACTIONS = 100
# Every so many of them are taken as steps.
_STRIDE = 5
# By name: a design, its overrides, and the type and the shape of actions.
# Besides the designs that ship: queries beside continuous controls, and a query
# that cannot be an index.
_CASES: dict[str, tuple[str, tuple[str, ...], Any, tuple[int, ...]]] = {
    'controls': ('instantaneous_reward', (), np.float64, (6,)),
    'an index': ('online_imitation', (), np.int32, ()),
    'two queries': ('paired_decoupled_approval', (), np.int32, (3,)),
    'continuous, with queries': (
        'value_advice',
        ('registers.advice.initial=0', 'providers=[]', 'learner=null',
         'action_set=null'),
        np.float64, (7,),
    ),
    'real and integer queries': (
        'value_advice',
        ('registers.other={kind: two_block, role: query, place: station_3,'
         ' range: [-1.5, 2.5]}',),
        np.float64, (3,),
    ),
}  # fmt: skip


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
    ('design', 'overrides', 'dtype', 'shape'),
    _CASES.values(),
    ids=list(_CASES),
)
def test_every_action_in_the_spec_is_accepted(
    design: str, overrides: Any, dtype: Any, shape: tuple[int, ...]
):
  arguments = 'collect_apples', 'standard', {'random': 1}, {'max_steps': 10_000}
  env = suite.load(*arguments, design=design, overrides=overrides)
  spec = env.action_spec()
  # Integers where all elements are indices.
  assert (spec.dtype, spec.shape) == (dtype, shape)
  assert spec.name.count('\t') == max(np.prod(shape), 1) - 1
  view = agent_view.AgentView(env)
  env.reset()
  actions = _actions(spec)
  for action in actions:
    queries, controls = env.codec.decode(action)
    assert queries.dtype == controls.dtype == np.float64
  for action in actions[-1::-_STRIDE]:
    assert env.step(action).mid()
    assert view.step(action).mid()
  batch = suite.load_batch(
      *arguments, num_envs=4, design=design, overrides=overrides
  )
  batch.reset()
  for first in range(0, len(actions) - 3, 4 * _STRIDE):
    time_step = batch.step(np.stack(actions[first : first + 4]))
    assert (time_step.step_type == 1).all()


def test_an_index_in_a_vector_of_real_numbers_is_rounded():
  design, overrides, *_ = _CASES['real and integer queries']
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
    found = helpers.to_bytes(env.step([9.3, 0.5, real]))
    assert found == helpers.to_bytes(twin.step([9.3, 0.5, whole]))


@pytest.mark.parametrize(
    'spec',
    [
        dm_env_specs.Array((3,), np.float64),
        dm_env_specs.BoundedArray((2, 2), np.float64, -1, 1),
        [dm_env_specs.BoundedArray((2,), np.float64, -1, 1)] * 2,
    ],
    ids=['unbounded', 'two axes', 'several agents'],
)
def test_an_action_spec_that_is_no_bounded_vector_is_refused(spec: Any):
  task = helpers.PointTask()
  task.action_spec = lambda physics: spec  # type: ignore[method-assign]
  with pytest.raises(errors.SpecError, match='action_spec of the task'):
    suite.embed(task, 'none')
