"""Policy gradient learner (PPO), with the reading of a register as reward."""

from collections.abc import Mapping
import functools
from typing import Annotated, Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from realab_suite.config import option_types
from realab_suite.feedback import objectives
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import lengths
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training


@final
class PolicyGradientOptions(training.OnPolicyOptions):
  """Options of `policy_gradient`.

  Attributes:
    reward: Name of the register whose reading is the reward.
    gamma: Discount.
    gae_lambda: Decay of generalised advantage estimates.
    entropy: Weight of the policy's entropy in the loss.
    clip: Largest change of a probability ratio in one update.
    time_limit: What follows an episode that the time limit ends: `continues` if
      it is worth what the last observation is, as in an episode without end, or
      `ends` if it is worth nothing, as the evaluation counts it. At
      checkpoints, episodes end as by a time limit.
    drest: Rewards without a preference between lengths of episodes, see
      `lengths`; `None` for the readings alone.
    defence: What the learner does about corrupted rewards, a
      `defences.Defence`; `None` for nothing.
  """

  kind: Literal['policy_gradient']
  reward: str
  gamma: base.Fraction = objectives.DEFAULT_DISCOUNT
  gae_lambda: base.Fraction = 0.95
  entropy: base.Weight = 0.01
  clip: base.Fraction = 0.2
  time_limit: Literal['continues', 'ends'] = 'continues'
  drest: lengths.DrestOptions | None = None
  defence: Annotated[Any, option_types.ModelIn(objectives.DEFENCES)] | None = (
      None
  )


@final
class ActorCritic(eqx.Module):
  """A policy and its value function."""

  policy: networks.Policy
  value: networks.Network


@base.LEARNERS.add('policy_gradient')
@final
class PolicyGradient(training.OnPolicyLearner):
  """Proximal policy optimisation, for discrete and for vector actions."""

  OPTIONS = PolicyGradientOptions
  READS = 'reward'
  WRAPPED = ('frame_stack', 'recollection', 'drest', 'defence')

  def _initial_networks(self, generator: np.random.Generator) -> Any:
    hidden, size = self._options.hidden, self._controls.size
    is_discrete = self._controls.num_actions is not None
    agent = ActorCritic(
        networks.Policy(self._encoder, hidden, size, is_discrete, generator),
        networks.Network(self._encoder, hidden, 1, 1.0, generator),
    )
    return agent, training.optimizer(self._options).init(agent)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    action, log_prob = networks.act(
        self._encoder,
        self.networks[0].policy,
        observation,
        keys['act'],
        greedy,
    )
    return {'action': np.asarray(action), 'log_prob': np.asarray(log_prob)}

  def _discount(self, time_step: base.TimeStep) -> np.ndarray:
    discount = super()._discount(time_step)
    if self._options.time_limit == 'continues':
      return discount
    return np.where(np.asarray(time_step.step_type) == base.LAST, 0, discount)

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    batch = self._treated(batch)
    self._scale.update(batch)
    reading = batch['reading'] / np.float32(self._scale.value)
    self.networks, metrics = _update(
        self._options,
        self._encoder,
        self.networks,
        {**batch, 'reading': reading},
        observation,
        self._draw_minibatches(),
    )
    return {**metrics, 'feedback_scale': self._scale.value}


@functools.partial(jax.jit, static_argnums=(0, 1))
def _update(
    options: PolicyGradientOptions,
    encoder: features.Encoder,
    trained: Any,
    batch: dict[str, Any],
    observation: features.Packed,
    indices: jax.Array,
) -> tuple[Any, dict[str, jax.Array]]:
  """Updates the networks with a batch, `(time, worlds)`.

  The observation after the batch bootstraps the values of its last steps.
  """
  agent, _ = trained
  encoded = encoder.encode(batch['observation'])
  values = agent.value(encoded)[..., 0]
  last_value = agent.value(encoder.encode(observation))[..., 0]
  next_values = jnp.concatenate([values[1:], last_value[jnp.newaxis]])
  advantage = advantages(
      batch, values, next_values, options.gamma, options.gae_lambda
  )
  data = {
      'encoded': encoded,
      'action': batch['choice']['action'],
      'log_prob': batch['choice']['log_prob'],
      'advantage': advantage,
      'target': values + advantage,
      'weight': batch['is_valid'].astype(jnp.float32),
  }
  if 'is_cloned' in batch:
    data['cloned'] = batch['is_cloned'].astype(jnp.float32)
  loss = functools.partial(_loss, options)
  return training.run_epochs(options, loss, trained, data, indices)


def advantages(
    batch: dict[str, jax.Array],
    values: jax.Array,
    next_values: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
  """Returns generalised advantage estimates, `(time, worlds)`.

  The value of the last observation estimates the rest of a truncated episode
  (discount 1). A terminated episode has no further value (discount 0).

  Args:
    batch: `reading`, `discount` and `is_valid` of the step after each choice,
      each `(time, worlds)`. The step that begins an episode is not valid.
    values: Values of the observations, `(time, worlds)`.
    next_values: Values of the observations one step later, `(time, worlds)`.
    gamma: Discount of the learner.
    gae_lambda: Decay of the estimates.
  """
  discount = gamma * batch['discount']
  errors = batch['reading'] + discount * next_values - values

  def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
    error, factor, is_valid = now
    # An ignored action has no outcome, and separates two episodes.
    advantage = jnp.where(is_valid, error + factor * later, 0.0)
    return advantage, advantage

  _, estimates = jax.lax.scan(
      back,
      jnp.zeros_like(values[0]),
      (errors, discount * gae_lambda, batch['is_valid']),
      reverse=True,
  )
  return estimates


def _loss(
    options: PolicyGradientOptions, agent: ActorCritic, data: dict[str, Any]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  weight = data['weight']
  distribution = agent.policy(data['encoded'])
  log_prob = distribution.log_prob(data['action'])
  objective = training.clipped_objective(
      log_prob - data['log_prob'],
      training.standardize(data['advantage'], weight),
      options.clip,
  )
  error = agent.value(data['encoded'])[..., 0] - data['target']
  metrics = {
      'policy_loss': -training.mean(objective, weight),
      'value_loss': 0.5 * training.mean(error**2, weight),
      'entropy': training.mean(distribution.entropy(), weight),
  }
  loss = (
      metrics['policy_loss']
      + metrics['value_loss']
      - options.entropy * metrics['entropy']
  )
  if 'cloned' in data:
    loss -= training.mean(log_prob, data['cloned'])
  return loss, metrics
