"""Property tests: a hostile action is refused and leaves no trace."""

import contextlib
from typing import Any, NamedTuple

import hypothesis
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from tests import examples
from tests.engine import helpers

_NUM_ENVS = 3
_DESIGNS = {
    'vectors': ('instantaneous_reward', ()),
    'discrete': ('online_imitation', ()),
    'queries and an index': ('paired_decoupled_approval', ()),
    'queries and a vector': (
        'value_advice',
        (
            'action_set=null',
            'registers.advice.initial=0',
            'providers=[]',
            'learner=null',
        ),
    ),
}


class _World(NamedTuple):
  """An environment, and its twin that receives only the good actions."""

  env: Any
  twin: Any


def _load(name: str, is_batch: bool) -> Any:
  design, overrides = _DESIGNS[name]
  arguments = 'collect_apples', 'standard', {'random': 5}, {'max_steps': 10}
  if is_batch:
    return suite.load_batch(
        *arguments, num_envs=_NUM_ENVS, num_threads=1, design=design,
        overrides=overrides,
    )  # fmt: skip
  return suite.load(*arguments, design=design, overrides=overrides)


@pytest.fixture(
    scope='module',
    params=[(name, i % 2 == 0) for i, name in enumerate(_DESIGNS)],
    ids=lambda param: f'{param[0]}, {"batch" if param[1] else "one world"}',
)
def world(request: pytest.FixtureRequest) -> Any:
  with (
      contextlib.closing(_load(*request.param)) as env,
      contextlib.closing(_load(*request.param)) as twin,
  ):
    env.reset()
    twin.reset()
    yield _World(env, twin)


class _Raises:
  """Raises an error when it is converted to an array."""

  def __array__(self, *unused: Any, **kwargs: Any) -> Any:
    raise MemoryError('two\nlines')

  def __repr__(self) -> str:
    return 'two\nlines'


def _bad_objects(shape: tuple[int, ...]) -> st.SearchStrategy[Any]:
  """Draws objects without numbers, or with those of other types."""
  itself: list[Any] = []
  itself.append(itself)
  dtypes = ('complex', 'bool', 'M8[s]', 'S0', 'U1')
  return st.sampled_from(
      [
          None, 'forward', object(), {'forward': 1.0}, itself, _Raises(),
          [[1.0], [1.0, 2.0]], np.full(shape, 10**400, object),
          np.zeros(shape, [('a', float)]),
          np.ma.masked_array(np.zeros(shape), np.ones(shape, bool)),
          *(np.zeros(shape, dtype) for dtype in dtypes),
      ]
  )  # fmt: skip


@st.composite
def _hostile(draw: Any, env: Any) -> Any:
  """Draws an action that does not satisfy the action spec."""
  spec = env.action_spec()
  leading = (env.num_envs,) if hasattr(env, 'num_envs') else ()
  shape = (*leading, *spec.shape)
  how = draw(st.sampled_from(['object', 'shape', 'number', 'outside']))
  if how == 'object':
    return draw(_bad_objects(shape))
  if how == 'shape':
    other = draw(np_st.array_shapes(min_dims=0, max_dims=3, max_side=7))
    hypothesis.assume(other != shape)
    return np.zeros(other, spec.dtype)
  rng = np.random.default_rng(draw(st.integers(0, 2**32)))
  values = np.array(helpers.draw(spec, leading, rng), float)
  where = draw(st.integers(0, values.size - 1))
  if how == 'number':
    values.reshape(-1)[where] = draw(
        st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e12, 2.0**63])
    )
    return values
  is_high = draw(st.booleans())
  bound = (spec.minimum, spec.maximum)[is_high]
  bound = np.broadcast_to(bound, shape).reshape(-1)[where]
  if spec.dtype.kind == 'i':
    values.reshape(-1)[where] = bound + (1 if is_high else -1)
    return values.astype(np.int64)
  values.reshape(-1)[where] = np.nextafter(
      bound, np.inf if is_high else -np.inf
  )
  return values


@examples.settings(20)
@hypothesis.given(data=st.data())
def test_a_hostile_action_leaves_no_trace(world: _World, data: Any):
  env, twin = world
  action = data.draw(_hostile(env))
  before = env.save().to_bytes()
  with pytest.raises(errors.ActionError) as caught:
    env.step(action)
  assert str(caught.value).isprintable()
  assert 0 < len(str(caught.value)) <= 400
  assert env.save().to_bytes() == before
  leading = (env.num_envs,) if hasattr(env, 'num_envs') else ()
  rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
  good = helpers.draw(env.action_spec(), leading, rng)
  found, expected = env.step(good), twin.step(good)
  np.testing.assert_array_equal(found.step_type, expected.step_type)
  np.testing.assert_array_equal(found.discount, expected.discount)
  for key, value in expected.observation.items():
    assert found.observation[key].tobytes() == value.tobytes(), key
