"""Behavioural cloning of the action index in a register.

If the learner acts, it does so with its own policy, so demonstrations cover the
states that it visits itself, as in DAgger. If it watches, they cover the states
that another has visited.
"""

from collections.abc import Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np

from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training


@final
class BehaviouralCloningOptions(training.OnPolicyOptions):
  """Options of `behavioural_cloning`.

  Attributes:
    demonstration: Name of the register whose reading is the index of the
      demonstrated action.
  """

  kind: Literal['behavioural_cloning']
  demonstration: str


@base.LEARNERS.add('behavioural_cloning')
@final
class BehaviouralCloning(training.OnPolicyLearner):
  """Imitates the demonstrated action for each observation."""

  OPTIONS = BehaviouralCloningOptions
  READS = 'demonstration'
  NEEDS_ACTION_SET = True
  is_off_policy = True

  def _initial_networks(self, generator: np.random.Generator) -> Any:
    hidden, size = self._options.hidden, self._controls.size
    policy = networks.Policy(self._encoder, hidden, size, True, generator)
    return policy, training.optimizer(self._options).init(policy)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    action, _ = networks.act(
        self._encoder, self.networks[0], observation, keys['act'], greedy
    )
    return {'action': np.asarray(action)}

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    del observation  # There is no demonstration for it yet.
    self.networks, metrics = _update(
        self._options,
        self._encoder,
        self.networks,
        batch,
        self._draw_minibatches(),
    )
    return metrics


@functools.partial(jax.jit, static_argnums=(0, 1))
def _update(
    options: BehaviouralCloningOptions,
    encoder: features.Encoder,
    trained: Any,
    batch: dict[str, Any],
    indices: jax.Array,
) -> tuple[Any, dict[str, jax.Array]]:
  """Updates the policy towards the demonstrations of a batch.

  A provider sees the observation on which the agent chose its action, so the
  reading of the step after it is the demonstration for that observation.
  """
  num_actions = trained[0].network.layers[-1].bias.size
  demonstrated = jnp.clip(jnp.rint(batch['reading']), 0, num_actions - 1)
  data = {
      'encoded': encoder.encode(batch['observation']),
      'demonstration': demonstrated.astype(jnp.int32),
      'action': batch['choice']['action'],
      'weight': batch['is_valid'].astype(jnp.float32),
  }
  return training.run_epochs(options, _loss, trained, data, indices)


def _loss(
    policy: networks.Policy, data: dict[str, Any]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  weight, demonstrated = data['weight'], data['demonstration']
  distribution = policy(data['encoded'])
  loss = -training.mean(distribution.log_prob(demonstrated), weight)
  return loss, {
      'imitation_loss': loss,
      'entropy': training.mean(distribution.entropy(), weight),
      'agreement': training.mean(data['action'] == demonstrated, weight),
  }
