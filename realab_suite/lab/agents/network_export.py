"""Policies of learners as networks of `policies/network_files.py`."""

import math
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
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
  policy = learner.networks[0]
  if isinstance(policy, policy_gradient.ActorCritic):
    policy = policy.policy
  encoder = learner.setting.encoder
  actions = learner.setting.controls.action_set
  if (
      not isinstance(policy, networks.Policy)
      or actions is None
      or encoder.image_shapes
  ):
    raise errors.SpecError(
        f'{type(learner).__name__}: only a policy without images, for actions'
        ' of a set, can be exported, of policy_gradient or behavioural_cloning'
    )
  layers = policy.network.layers
  first, *others = (np.array(layer.weight) for layer in layers)
  keys = network_files.Feature.model_fields
  header = network_files.Header(
      outputs='log_probabilities',
      action_set=actions.name,
      action_set_version=actions.version,
      features=tuple(
          network_files.Feature(**{key: getattr(entry, key) for key in keys})
          for entry in encoder.entries
      ),
      hidden=tuple(layer.bias.size for layer in layers[:-1]),
      **described,
  )
  return network_files.Network(
      header,
      (_with_all_values(encoder, first), *others),
      tuple(np.array(layer.bias) for layer in layers),
  )


def _with_all_values(
    encoder: features.Encoder, weight: np.ndarray
) -> np.ndarray:
  """Returns weights of the first layer for the features of files.

  In files every integer within the bounds has a feature; here only those that
  the spec lists. The others have no effect, so their weights are 0.
  """
  sizes = [
      math.prod(entry.shape) * (len(entry.values) or 1)
      for entry in encoder.entries
  ]
  parts = np.split(weight, np.cumsum(sizes)[:-1])
  for i, entry in enumerate(encoder.entries):
    if entry.values:
      listed = parts[i].reshape(-1, len(entry.values), weight.shape[1])
      num_values = int(entry.high - entry.low) + 1
      spread = np.zeros((len(listed), num_values, weight.shape[1]), np.float32)
      spread[:, np.subtract(entry.values, int(entry.low))] = listed
      parts[i] = spread.reshape(-1, weight.shape[1])
  return np.concatenate(parts)
