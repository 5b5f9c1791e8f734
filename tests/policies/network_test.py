"""Tests for network policies: their files, outputs and returns."""

from collections.abc import Mapping
import io
import json
import pathlib

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_FOLDER = pathlib.Path(__file__).parents[2] / 'configs' / 'networks'
_KEY = np.zeros(2, np.uint64)
# A shipped network never changes, so that results of designs that name it stay
# comparable. A new one gets a new name.
_DIGESTS = {
    'demonstrator_v1': (
        '2fb22618e297fb026e89698e58509269d7ffe2b5de669562212d1bfc3e5bb840'
    ),
}


@pytest.fixture(scope='module', name='shipped')
def fixture_shipped() -> network_files.Network:
  return network_files.load('demonstrator_v1')


@pytest.fixture(scope='module', name='views')
def fixture_views() -> dict[str, np.ndarray]:
  """Returns observations of 256 worlds after some random actions."""
  batch = suite.load_batch(
      'unlock_door', 'near', {'random': 3}, num_envs=64, design='none'
  )
  time_step = batch.reset()
  rng = np.random.default_rng(0)
  seen = []
  for _ in range(40):
    time_step = batch.step(rng.uniform(-1, 1, (64, *batch.action_spec().shape)))
    seen.append(time_step.observation)
  batch.close()
  last = seen[9::10]
  return {name: np.concatenate([o[name] for o in last]) for name in last[0]}


def _worlds(
    views: Mapping[str, np.ndarray], which: slice | int
) -> dict[str, np.ndarray]:
  return {name: value[which] for name, value in views.items()}


def _returns(policy: policies.Policy, variation: str) -> np.ndarray:
  batch = suite.load_batch(
      'unlock_door',
      variation,
      {'random': 12},
      num_envs=16,
      design='instantaneous_reward',
      overrides=('dof=planar', 'channel=secure'),
  )
  actor = batch_actors.BatchPolicyActor(policy, batch, 12)
  episodes = evaluate.evaluate_batch(batch, actor)
  batch.close()
  return np.array([episode.true_return for episode in episodes])


def _arrays(net: network_files.Network) -> dict[str, np.ndarray]:
  with np.load(io.BytesIO(net.to_bytes())) as archive:
    return dict(archive)


def test_shipped_networks_are_those_of_the_folder_and_unchanged():
  files = sorted(path.stem for path in _FOLDER.glob('*.npz'))
  assert list(network_files.NETWORKS) == files == sorted(_DIGESTS)
  for name, digest in _DIGESTS.items():
    assert network_files.load(name).digest() == digest


@pytest.mark.parametrize('name', sorted(_DIGESTS))
def test_a_shipped_network_is_small_and_records_its_training(name):
  path = _FOLDER / f'{name}.npz'
  assert path.stat().st_size <= 150_000
  net = network_files.load(path)
  assert net.to_bytes() == network_files.load(name).to_bytes()
  made = net.header.made
  design = specs.load(made['design'], made['overrides'])
  assert design.channel == 'secure'
  assert (design.action_set.name, design.action_set.version) == (
      net.header.action_set,
      net.header.action_set_version,
  )
  assert made['steps'] >= 1_000_000
  assert {'mujoco', 'numpy', 'jax'} <= made['versions'].keys()
  for feature in net.header.features:
    assert feature.name.startswith('senses/')
  assert [reached['task'] for reached in net.header.reached] == [
      'unlock_door.near', 'unlock_door.standard', 'unlock_door.far',
  ]  # fmt: skip
  for reached in net.header.reached:
    low, mean, high = (reached[name] for name in ('low', 'mean', 'high'))
    assert 16 <= low <= mean <= high <= 18
    assert reached['level'] == 0.95
    assert reached['episodes'] >= 100


def test_a_shipped_network_reaches_its_return(shipped):
  returns = _returns(network_policies.NetworkDemonstrator(shipped), 'standard')
  assert len(returns) == 16
  assert returns.mean() >= 15
  assert (returns >= 10).mean() >= 0.8


def test_outputs_do_not_depend_on_the_other_worlds_of_a_batch(shipped, views):
  expected = np.stack(
      [
          network_policies.outputs(shipped, _worlds(views, i), ())
          for i in range(256)
      ]
  )
  parts = [_worlds(views, slice(i, i + 3)) for i in range(0, 256, 3)]
  got = [
      network_policies.outputs(shipped, part, part['senses/time_left'].shape)
      for part in parts
  ]
  assert np.concatenate(got).tobytes() == expected.tobytes()
  assert len(np.unique(expected, axis=0)) > 200


def test_features_and_outputs_equal_those_of_the_learners(shipped, views):
  pytest.importorskip('equinox')
  from realab_suite.lab.agents import features
  from realab_suite.lab.agents import networks

  batch = suite.load_batch('unlock_door', 'near', num_envs=1, design='none')
  spec = batch.observation_spec()
  batch.close()
  encoder = features.Encoder.from_spec(
      {name: part for name, part in spec.items() if name.startswith('senses/')}
  )
  expected = np.asarray(encoder.encode(encoder.pack(views, 256))['vector'])
  got = network_policies.encode(shipped.header.features, views, (256,))
  assert got.dtype == np.float32
  np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)
  learner = networks.Network(
      encoder, shipped.header.hidden, 14, 0.01, np.random.default_rng(0)
  )
  for layer, weight, bias in zip(
      learner.layers, shipped.weights, shipped.biases, strict=True
  ):
    assert layer.weight.shape == weight.shape
    object.__setattr__(layer, 'weight', weight)
    object.__setattr__(layer, 'bias', bias)
  x = np.asarray(learner({'vector': expected}))
  outputs = network_policies.outputs(shipped, views, (256,))
  np.testing.assert_allclose(outputs, x, rtol=1e-4, atol=1e-4)


def test_the_demonstrator_takes_the_action_with_the_best_advice(shipped, views):
  policy = network_policies.NetworkDemonstrator(shipped)
  start = np.ones(256, bool)
  action, state = policy.step(views, start, _KEY, policy.initial_state((256,)))
  adviser = network_policies.NetworkValues(shipped)
  values, _ = adviser.step(views, start, _KEY, adviser.initial_state((256,)))
  assert state == ()
  assert values.shape == (256, 14)
  assert values.dtype == float
  np.testing.assert_array_equal(action, values.argmax(axis=-1))
  np.testing.assert_array_equal(values.max(axis=-1), 1)
  np.testing.assert_array_equal(values.min(axis=-1), -1)
  assert len(np.unique(action)) > 3


@pytest.mark.parametrize(
    ('weights', 'complaint'),
    [
        ('demonstrator_v0', r"neither a file nor one of \['demonstrator_v1'"),
        (3, 'must be a path'),
    ],
)
def test_unknown_weights_are_refused(weights, complaint):
  with pytest.raises(errors.SpecError, match=complaint):
    policies.make('network_demonstrator', weights=weights)


_ARRAYS = [
    ({'weight_1': np.zeros((64, 63), np.float32)}, r'\(64, 63\)'),
    ({'weight_0': None}, 'its header describes'),
    ({'bias_0': np.full(64, np.nan, np.float32)}, 'finite float32'),
    ({'bias_0': np.ones(64, np.float32)}, 'damaged: SHA-256'),
    ({'bias_0': np.array([object()])}, 'not a network: .*allow_pickle'),
    ({'header': np.frombuffer(b'{}', np.uint8)}, 'required key is missing'),
    # Large only when it is unpacked.
    ({'filler': np.zeros(2**20)}, 'larger than'),
]  # fmt: skip


@pytest.mark.parametrize(('change', 'complaint'), _ARRAYS)
def test_a_file_with_other_arrays_is_refused(shipped, change, complaint):
  buffer = io.BytesIO()
  arrays = {**_arrays(shipped), **change}
  given = {name: a for name, a in arrays.items() if a is not None}
  np.savez_compressed(buffer, **given)
  assert len(buffer.getvalue()) < 2**18
  with pytest.raises(errors.SpecError, match=complaint):
    network_files.from_bytes(buffer.getvalue(), 'net.npz')


def test_a_file_with_any_changed_byte_is_refused_or_the_same(shipped):
  data = shipped.to_bytes()
  rng = np.random.default_rng(0)
  refused = 0
  for place in rng.integers(0, len(data), 60):
    changed = bytearray(data)
    changed[place] ^= int(rng.integers(1, 256))
    try:
      again = network_files.from_bytes(bytes(changed), 'net.npz')
    except errors.SpecError:
      refused += 1
    else:
      assert again.digest() == shipped.digest()
  assert refused > 50


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        (lambda h: h['reached'][0].update(mean=18.0), 'damaged'),
        (lambda h: h.update(action_set_version=9), r"^net.npz: .*like v9'"),
    ],
)
def test_a_changed_header_is_refused(shipped, change, complaint):
  arrays = _arrays(shipped)
  header = json.loads(arrays['header'].tobytes())
  change(header)
  arrays['header'] = np.frombuffer(json.dumps(header).encode(), np.uint8)
  buffer = io.BytesIO()
  np.savez(buffer, **arrays)
  with pytest.raises(errors.SpecError, match=complaint):
    network_files.from_bytes(buffer.getvalue(), 'net.npz')


@pytest.mark.parametrize(('change', 'complaint'), [
    ({'senses/ray_distances': None}, "'senses/ray_distances' is missing"),
    ({'senses/heading': np.zeros((256, 3))}, r'shape \(256, 3\); must be')
])  # fmt: skip
def test_observations_that_do_not_fit_a_network_are_refused(
    shipped, views, change, complaint
):
  seen = {
      name: value
      for name, value in {**views, **change}.items()
      if value is not None
  }
  with pytest.raises(errors.SpecError, match=complaint):
    network_policies.outputs(shipped, seen, (256,))
