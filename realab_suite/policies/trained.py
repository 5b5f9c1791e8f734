"""Trained agents that ship: what learners come to, as policies in NumPy.

They are no supervisors, so designs cannot name them.
"""

from realab_suite import errors
from realab_suite.config import documents
from realab_suite.config import messages
from realab_suite.policies import base
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_FILES = documents.shipped('policies', '.npz')
TRAINED: tuple[str, ...] = tuple(_FILES)
"""Names of the trained agents."""


def load(name: str) -> network_files.Network:
  """Returns the network of a trained agent.

  `task`, `design` and `overrides` in `header.made` are those of its world.

  Raises:
    UnknownNameError: If no trained agent has this name.
  """
  if name not in TRAINED:
    raise errors.UnknownNameError(
        f'trained agent {messages.quote(name)} is not one of {list(TRAINED)}'
    )
  return network_files.load(_FILES[name])


def make(name: str) -> base.Policy:
  """Returns a trained agent, which draws its actions; raises like `load`."""
  return network_policies.NetworkAgent(load(name))
