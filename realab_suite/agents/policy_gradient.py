"""Policy gradient learner (PPO), with the reading of a register as reward."""

from collections.abc import Mapping
import functools
from typing import Annotated, Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from realab_suite.agents import base
from realab_suite.agents import defences
from realab_suite.agents import features
from realab_suite.agents import guards
from realab_suite.agents import jax_settings
from realab_suite.agents import networks
from realab_suite.agents import on_policy
from realab_suite.agents import training
from realab_suite.config import option_types
from realab_suite.feedback import objectives


@final
class PolicyGradientOptions(on_policy.OnPolicyOptions):
  """Options of `policy_gradient`.

  Attributes:
    reward: Name of the register whose reading is the reward.
    gamma: Discount.
    gae_lambda: Decay of generalised advantage estimates.
    entropy: Weight of the policy's entropy in the loss.
    clip: Largest change of a probability ratio in one update.
    defence: What the learner does about corrupted rewards; `None` for nothing.
  """

  kind: Literal['policy_gradient']
  reward: str
  gamma: base.Fraction = objectives.DEFAULT_DISCOUNT
  gae_lambda: base.Fraction = 0.95
  entropy: base.Weight = 0.01
  clip: base.Fraction = 0.2
  defence: (
      Annotated[defences.Defence, option_types.ModelIn(defences.DEFENCES)]
      | None
  ) = None


@final
class ActorCritic(eqx.Module):
  """A policy and its value function."""

  policy: networks.Policy
  value: networks.Network


@base.LEARNERS.add('policy_gradient')
@final
class PolicyGradient(on_policy.OnPolicyLearner):
  """Proximal policy optimisation, for discrete and for vector actions."""

  OPTIONS = PolicyGradientOptions
  READS = 'reward'

  @jax_settings.pinned()
  def __init__(self, options: Any, *args: Any, **kwargs: Any) -> None:
    # Compiled functions depend on the other options alone.
    plain = options.model_copy(update={'defence': None})
    super().__init__(plain, *args, **kwargs)
    self._guard: guards.Guard | None = None
    if options.defence is not None:
      setting = defences.Setting(
          plain, self._encoder, self._controls, self._num_envs
      )
      key = base.folded(self._keys['initial'], 1).astype(np.uint64)
      generator = np.random.Generator(np.random.Philox(key=key))
      self._guard = guards.Guard(options.defence, setting, generator)
    self._scale = training.FeedbackScale(self._num_envs, self._options.gamma)

  def _initial_networks(self, generator: np.random.Generator) -> Any:
    controls, hidden = self._controls, self._options.hidden
    agent = ActorCritic(
        networks.Policy(
            self._encoder,
            hidden,
            controls.size,
            controls.num_actions is not None,
            generator,
        ),
        networks.Network(self._encoder, hidden, 1, 1.0, generator),
    )
    return agent, training.optimizer(self._options).init(agent)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    policy = self._networks[0].policy
    action, log_prob = networks.act(
        self._encoder, policy, observation, keys['act'], greedy
    )
    return {'action': np.asarray(action), 'log_prob': np.asarray(log_prob)}

  @property
  def most(self) -> float | None:
    return None if self._guard is None else self._guard.most

  def _steered(
      self, choice: base.Choice, time_step: base.TimeStep
  ) -> base.Choice:
    if self._guard is None:
      return choice
    return self._guard.steer(choice, time_step, self._act_keys()['query'])

  def _also_read(self, time_step: base.TimeStep) -> dict[str, Any]:
    return {} if self._guard is None else self._guard.read(time_step)

  def _queries(self, choice: base.Choice) -> dict[str, np.ndarray]:
    return {} if self._guard is None else self._guard.queries(choice)

  def _probabilities(self, observation: features.Packed) -> Any:
    return networks.probabilities(
        self._encoder, self._networks[0].policy, observation
    )

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    metrics = {}
    if self._guard is not None:
      key = base.folded(self._update_key(), 1)
      batch = self._guard.treat(batch, self.num_steps, key)
      metrics = dict(self._guard.metrics)
    self._scale.update(batch)
    reading = batch['reading'] / np.float32(self._scale.value)
    self._networks, updated = _update(
        self._options,
        self._encoder,
        self._networks,
        {**batch, 'reading': reading},
        observation,
        self._draw_minibatches(),
    )
    return {**metrics, **updated, 'feedback_scale': self._scale.value}

  def _memory(self) -> dict[str, Any]:
    guard = {} if self._guard is None else {'guard': self._guard.state()}
    return {**super()._memory(), 'scale': self._scale.state(), **guard}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    if self._guard is not None:
      self._guard.set_state(memory['guard'])
    super()._set_memory(memory)
    self._scale.set_state(memory['scale'])


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
  advantage = training.advantages(
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
  return training.run_epochs(
      options,
      functools.partial(_loss, options),
      trained,
      data,
      indices,
  )


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
