"""Policies of learners as networks of `policies/network_files.py`."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from realab_suite import errors
from realab_suite.lab.agents import base
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import policy_gradient
from realab_suite.policies import network_files


def export(learner: base.Learner, **described: Any) -> network_files.Network:
  """Returns the policy of a learner, without its wrappers.

  Its outputs are the logits of the learner.

  Args:
    learner: The learner.
    **described: `description`, `made` and `reached` of the header.

  Raises:
    SpecError: If its policy is no network from numbers to actions of a set.
  """
  policy, setting = _policy(learner.networks), learner.setting
  actions, encoder = setting.controls.action_set, setting.encoder
  is_policy = isinstance(policy, networks.Policy)
  if not is_policy or actions is None or encoder.image_shapes:
    raise errors.SpecError(
        f'{type(learner).__name__}: only a policy without images, for actions'
        ' of a set, can be exported, of policy_gradient or behavioural_cloning'
    )
  weights, biases = (
      [np.array(getattr(layer, what)) for layer in policy.network.layers]
      for what in ('weight', 'bias')
  )
  keys = network_files.Feature.model_fields
  header = network_files.Header(
      outputs='log_probabilities',
      action_set=actions.name,
      action_set_version=actions.version,
      features=tuple(
          network_files.Feature(**{key: getattr(entry, key) for key in keys})
          for entry in encoder.entries
      ),
      hidden=tuple(bias.size for bias in biases[:-1]),
      **described,
  )
  rows, size = _inputs(learner, header)
  first = np.zeros((size, weights[0].shape[1]), np.float32)
  first[rows] = weights[0]
  return network_files.Network(header, (first, *weights[1:]), tuple(biases))


def restore(learner: base.Learner, network: network_files.Network) -> None:
  """Gives a learner the policy of a network that `export` has returned.

  It then acts as the exported one did, to the bit. It cannot go on learning.

  Args:
    learner: A learner with the same options, for the same observations.
    network: The network.

  Raises:
    SpecError: If the network is not one of such a learner.
  """
  there, here = (
      network.header,
      export(learner, description='', made={}, reached=()).header,
  )
  free = {'description', 'made', 'reached'}
  if there.model_dump(exclude=free) != here.model_dump(exclude=free):
    raise errors.SpecError(
        f'network: has inputs, outputs or layers {there.sizes()}; must have'
        f' those of the learner, {here.sizes()}'
    )
  rows, _ = _inputs(learner, here)
  arrays = [network.weights[0][rows], *network.weights[1:], *network.biases]

  def replaced(nets: Any) -> list[Any]:
    layers = _policy(nets).network.layers
    return [getattr(x, what) for what in ('weight', 'bias') for x in layers]

  learner.networks = eqx.tree_at(
      replaced, learner.networks, [*map(jnp.asarray, arrays)]
  )


def _policy(nets: Any) -> Any:
  """Returns the policy among the networks of a learner."""
  policy = nets[0]
  if isinstance(policy, policy_gradient.ActorCritic):
    return policy.policy
  return policy


def _inputs(
    learner: base.Learner, header: network_files.Header
) -> tuple[list[int], int]:
  """Returns the inputs of a file that a learner has, and their number there.

  Files have an input for every integer within bounds, and learners only for
  those that occur. The others have no effect.
  """
  rows: list[int] = []
  end = 0
  for entry, feature in zip(
      learner.setting.encoder.entries, header.features, strict=True
  ):
    start, end = end, end + feature.size
    places = np.arange(start, end).reshape(*entry.shape, -1)
    if entry.values:
      places = places[..., np.subtract(entry.values, int(entry.low))]
    rows.extend(places.ravel())
  return rows, end
