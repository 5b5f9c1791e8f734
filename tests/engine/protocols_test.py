"""Every physics keeps the contract of `entities.protocols`."""

from dm_control import mjcf
import numpy as np
import pytest

from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics

_WRITTEN = ('qpos', 'qvel', 'ctrl', 'mocap_pos', 'mocap_quat', 'active')
_NUM_ENVS = 3


def _model() -> mjcf.RootElement:
  """Returns three sliders with motors, two mocap bodies and a weld."""
  root = mjcf.RootElement(model='world')
  root.size.nuserdata = 4
  for i in range(3):
    body = root.worldbody.add('body', name=f'slider_{i}', pos=[i, 0, 1])
    body.add('geom', name=f'box_{i}', type='box', size=[0.1, 0.1, 0.1])
    joint = body.add('joint', name=f'slide_{i}', type='slide', axis=[1, 0, 0])
    root.actuator.add('motor', name=f'motor_{i}', joint=joint)
  for i in range(2):
    body = root.worldbody.add(
        'body', name=f'mocap_{i}', mocap=True, pos=[0, i, 3]
    )
    body.add('geom', name=f'ball_{i}', size=[0.1], contype=0, conaffinity=0)
  root.equality.add('weld', name='weld', body1='slider_0', body2='mocap_0')
  return root


def _batch(root: mjcf.RootElement) -> batch_physics.BatchPhysics:
  template = single_physics.ThinPhysics.from_mjcf_model(root)
  template.legacy_step = False
  return batch_physics.BatchPhysics(template, _NUM_ENVS, num_threads=1)


_KINDS = {
    'mjcf.Physics': mjcf.Physics.from_mjcf_model,
    'ThinPhysics': single_physics.ThinPhysics.from_mjcf_model,
    'batch': _batch,
    'world of a batch': lambda root: _batch(root).world(1),
}
_READ_ONLY = ('ThinPhysics', 'batch', 'world of a batch')


@pytest.fixture(name='root', scope='module')
def fixture_root():
  return _model()


@pytest.fixture(name='kind', params=list(_KINDS), scope='module')
def fixture_kind(request):
  return request.param


@pytest.fixture(name='physics', scope='module')
def fixture_physics(kind, root):
  return _KINDS[kind](root)


def _elements(root, name):
  kinds = {'ctrl': 'actuator', 'active': 'equality', 'mocap_pos': 'body',
           'mocap_quat': 'body', 'xpos': 'geom', 'xmat': 'geom'}  # fmt: skip
  found = root.find_all(kinds.get(name, 'joint'))
  return [e for e in found if not name.startswith('mocap') or e.mocap]


def _value(name, shape):
  if name == 'active':
    return np.zeros(shape)
  values = np.random.default_rng(1).uniform(-1.0, 1.0, shape)
  return values / np.linalg.norm(values, axis=-1, keepdims=True)


@pytest.mark.parametrize('name', _WRITTEN)
@pytest.mark.parametrize('which', ['one', 'apart', 'reversed'])
def test_a_whole_write_is_what_is_read(kind, physics, root, name, which):
  elements = _elements(root, name)
  chosen = {'one': elements[0], 'apart': elements[::2],
            'reversed': elements[::-1]}[which]  # fmt: skip
  shape = np.shape(getattr(physics.bind(chosen), name))
  lead = (_NUM_ENVS,) if kind == 'batch' else ()
  assert shape[: len(lead)] == lead
  value = _value(name, shape or (1,)).reshape(shape)
  setattr(physics.bind(chosen), name, value)
  np.testing.assert_allclose(getattr(physics.bind(chosen), name), value)
  # The same elements one by one.
  if which != 'one':
    for i, element in enumerate(chosen):
      part = value[(slice(None),) * len(lead) + (i,)]
      found = getattr(physics.bind(element), name)
      np.testing.assert_allclose(np.reshape(found, part.shape), part)


@pytest.mark.parametrize('kind_of_element', ['body', 'geom'])
def test_derived_quantities_follow_a_write(physics, root, kind_of_element):
  slide = root.find('joint', 'slide_1')
  name = 'slider_1' if kind_of_element == 'body' else 'box_1'
  element = root.find(kind_of_element, name)
  physics.bind(slide).qpos = 0.0
  before = np.array(physics.bind(element).xpos)
  physics.bind(slide).qpos = 0.25
  after = np.array(physics.bind(element).xpos)
  np.testing.assert_allclose((after - before)[..., 0], 0.25)
  assert np.shape(physics.bind(element).xmat)[-1] == 9


@pytest.mark.parametrize('kind', _READ_ONLY, indirect=True, scope='module')
@pytest.mark.parametrize('name', [*_WRITTEN, 'xpos', 'xmat'])
def test_what_is_read_is_read_only(physics, root, name):
  for step in (1, 2, -1):
    elements = _elements(root, name)[::step]
    found = getattr(physics.bind(elements), name)
    with pytest.raises(ValueError, match='read-only'):
      found[...] = 0.0
