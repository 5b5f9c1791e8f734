"""Policies of learners as networks of `policies/network_files.py`."""

from typing import Any

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
  policy, setting = learner.networks[0], learner.setting
  if isinstance(policy, policy_gradient.ActorCritic):
    policy = policy.policy
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
  # Files have an input for every integer within bounds, and learners only for
  # those that occur. The others have no effect.
  rows: list[int] = []
  end = 0
  for entry, feature in zip(encoder.entries, header.features, strict=True):
    start, end = end, end + feature.size
    places = np.arange(start, end).reshape(*entry.shape, -1)
    if entry.values:
      places = places[..., np.subtract(entry.values, int(entry.low))]
    rows.extend(places.ravel())
  first = np.zeros((end, weights[0].shape[1]), np.float32)
  first[rows] = weights[0]
  return network_files.Network(header, (first, *weights[1:]), tuple(biases))
