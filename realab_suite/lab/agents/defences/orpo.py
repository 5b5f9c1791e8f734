"""Occupancy regularisation: stay near where a trusted policy goes.

ORPO with the square root of the chi-squared divergence of occupancies (Laidlaw
et al. 2025, arXiv 2403.03185).
"""

from collections.abc import Mapping
import functools
from typing import Annotated, Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from realab_suite.lab.agents import base as agents_base
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training
from realab_suite.lab.agents import trusted_policies
from realab_suite.lab.agents.defences import base

# Share of the largest ratios of occupancies that the divergence leaves out.
_TRIMMED = 0.01
# Decay of the running moments of the trusted policy's rewards, per batch.
_DECAY = 0.98


@base.DEFENCES.add('orpo')
@final
class Orpo(base.Defence):
  """Charges steps that are more frequent than under a trusted policy.

  The reward of a step is r - weight * sd * clip(c), where sd is the standard
  deviation of the trusted policy's rewards, and c = (ratio - 1) / sqrt(mean of
  (ratio - 1)), with the ratio of the occupancies of the observation and the
  action. A discriminator between the steps of both estimates it.

  Attributes:
    trusted: The trusted policy, and where it acts.
    weight: Weight of the charge, the lambda of the paper.
    clip: Largest charge of a step, in units of `weight * sd`. Tampering that
      pays more per step than `weight * sd * clip` pays in spite of the charge.
    gradients: Number of gradient steps of the discriminator per batch. With too
      few, the learner has found tampering before the discriminator has.
    minibatch: Number of steps of each side per gradient.
  """

  SEES_READINGS = True

  kind: Literal['orpo']
  trusted: trusted_policies.TrustedPolicy
  weight: Annotated[float, pydantic.Field(gt=0, le=1e6)] = 0.1
  clip: Annotated[float, pydantic.Field(gt=0, le=1e6)] = 1000.0
  gradients: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 128
  minibatch: Annotated[int, pydantic.Field(ge=1, le=10**6)] = 256

  @property
  def trusts(self) -> trusted_policies.TrustedPolicy:
    return self.trusted

  def initial_state(
      self, setting: base.Setting, generator: np.random.Generator
  ) -> dict[str, Any]:
    options, size = setting.options, setting.controls.size
    network = networks.Network(
        setting.encoder, options.hidden, 1, 0.01, generator, size
    )
    return {
        'trained': (network, training.optimizer(options).init(network)),
        # Weight, sum and sum of squares of the trusted policy's rewards.
        'moments': np.zeros(3),
    }

  def treat(
      self,
      batch: base.Batch,
      setting: base.Setting,
      state: Mapping[str, Any],
      key: np.ndarray,
  ) -> base.Treated:
    is_trusted = batch['is_trusted'] & batch['is_valid']
    is_own = ~batch['is_trusted'] & batch['is_valid']
    rewards = batch['reading'][is_trusted]
    moments = _DECAY * state['moments']
    moments += (rewards.size, rewards.sum(), (rewards**2).sum())
    trained, metrics = state['trained'], {}
    charge = np.zeros_like(batch['reading'])
    if is_trusted.any() and is_own.any():
      generator = agents_base.generator_of(key)
      shape = (self.gradients, self.minibatch)
      indices = [
          generator.choice(np.flatnonzero(side), shape).astype(np.int32)
          for side in (is_own, is_trusted)
      ]
      data = base.data_of(batch, setting)
      trained, log_ratio = _discriminate(
          setting.options, trained, data, np.stack(indices, axis=1)
      )
      ratio = np.exp(np.clip(np.asarray(log_ratio), -20.0, 20.0)) - 1.0
      ratios = np.sort(ratio[is_own])
      size = max(1, int(np.ceil((1.0 - _TRIMMED) * ratios.size)))
      divergence = float(np.sqrt(max(ratios[:size].mean(), 1e-4)))
      charge = np.clip(ratio / divergence, -self.clip, self.clip)
      metrics = {
          'divergence': divergence,
          'charge': float(charge[is_own].mean()),
      }
    count, total, squares = np.maximum(moments, (1.0, -np.inf, 0.0))
    deviation = np.sqrt(max(squares / count - (total / count) ** 2, 0.0))
    reading = batch['reading'] - self.weight * deviation * charge
    treated = {**batch, 'reading': reading.astype(np.float32)}
    return base.Treated(
        treated, {'trained': trained, 'moments': moments}, metrics
    )


@functools.partial(jax.jit, static_argnums=0)
def _discriminate(
    options: Any, trained: Any, data: dict[str, jax.Array], indices: jax.Array
) -> tuple[Any, jax.Array]:
  """Trains the discriminator, and returns the log-ratio of each step.

  `indices` are numbers of steps, `(gradients, 2, minibatch)`: own and trusted.
  """
  samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

  def loss(network: Any, index: jax.Array) -> Any:
    # `index` is `(2, minibatch)`: both sides in one call.
    minibatch = jax.tree.map(lambda x: x[index], samples)
    own_ratio, trusted_ratio = network(minibatch)[..., 0]
    value = jnp.mean(jax.nn.softplus(-own_ratio)) + jnp.mean(
        jax.nn.softplus(trusted_ratio)
    )
    return value, {'loss': value}

  def one_step(carry: Any, index: jax.Array) -> Any:
    return training.descend(options, loss, carry, index)

  trained, _ = jax.lax.scan(one_step, trained, indices)
  return trained, trained[0](data)[..., 0]
