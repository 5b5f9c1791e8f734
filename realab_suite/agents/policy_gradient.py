"""Policy gradient learner (PPO), with the reading of a register as reward."""

from collections.abc import Mapping
import functools
from typing import Annotated, Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pydantic

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
    memory: Number of units of a recurrent memory before the networks, or 0.
    time_limit: What follows an episode that the time limit ends: `continues` if
      it is worth what the last observation is, as in an episode without end, or
      `ends` if it is worth nothing, as the evaluation counts it. In a run with
      sleep, episodes end at checkpoints as by a time limit.
    defence: What the learner does about corrupted rewards; `None` for nothing.
  """

  kind: Literal['policy_gradient']
  reward: str
  gamma: base.Fraction = objectives.DEFAULT_DISCOUNT
  gae_lambda: base.Fraction = 0.95
  entropy: base.Weight = 0.01
  clip: base.Fraction = 0.2
  memory: Annotated[int, pydantic.Field(ge=0, le=4096)] = 0
  time_limit: Literal['continues', 'ends'] = 'continues'
  defence: (
      Annotated[defences.Defence, option_types.ModelIn(defences.DEFENCES)]
      | None
  ) = None


@final
class ActorCritic(eqx.Module):
  """A policy and its value function, with a memory in common or without."""

  policy: networks.Policy
  value: networks.Network
  memory: networks.Memory | None = None

  def __call__(
      self, encoded: dict[str, jax.Array]
  ) -> networks.Categorical | networks.Gaussian:
    if self.memory is not None:
      encoded = self.memory(encoded)
    return self.policy(encoded)


@base.LEARNERS.add('policy_gradient')
@final
class PolicyGradient(on_policy.OnPolicyLearner):
  """Proximal policy optimisation, for discrete and for vector actions."""

  OPTIONS = PolicyGradientOptions
  READS = 'reward'

  @jax_settings.pinned()
  def __init__(
      self,
      options: Any,
      reading: str,
      encoder: features.Encoder,
      *args: Any,
      **kwargs: Any,
  ) -> None:
    # Compiled functions depend on the other options alone.
    plain = options.model_copy(update={'defence': None})
    self._seen = encoder
    if options.memory:
      encoder = encoder.with_memory(options.memory)
    super().__init__(plain, reading, encoder, *args, **kwargs)
    self._guard: guards.Guard | None = None
    if options.defence is not None:
      setting = defences.Setting(
          plain, self._seen, self._controls, self._num_envs
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
        networks.Memory(self._seen, self._options.memory, generator)
        if self._options.memory
        else None,
    )
    return agent, training.optimizer(self._options).init(agent)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    agent = self._networks[0]
    action, log_prob = networks.act(
        self._encoder, agent, observation, keys['act'], greedy
    )
    return {'action': np.asarray(action), 'log_prob': np.asarray(log_prob)}

  @jax_settings.pinned()
  def stack(
      self,
      time_step: base.TimeStep,
      earlier: Mapping[str, np.ndarray] | None,
  ) -> Mapping[str, np.ndarray]:
    stacked = super().stack(time_step, earlier)
    if not self._options.memory:
      return stacked
    # The state before this observation, 0 where an episode begins.
    is_first = np.asarray(time_step.step_type) == base.FIRST
    state = np.zeros((len(is_first), self._options.memory), np.float32)
    if earlier is not None:
      packed = self._encoder.pack(earlier, len(is_first))
      memory = self._networks[0].memory
      known = np.asarray(_remember(self._encoder, memory, packed))
      state = np.where(is_first[:, np.newaxis], state, known)
    return {**stacked, features.MEMORY: state}

  def _discount(self, time_step: base.TimeStep) -> np.ndarray:
    discount = super()._discount(time_step)
    if self._options.time_limit == 'continues':
      return discount
    return np.where(np.asarray(time_step.step_type) == base.LAST, 0, discount)

  @property
  def largest_credit(self) -> float | None:
    return None if self._guard is None else self._guard.largest_credit

  def _steered(
      self,
      choice: base.Choice,
      time_step: base.TimeStep,
      observation: features.Packed,
  ) -> base.Choice:
    if self._guard is None:
      return choice
    return self._guard.steer(choice, time_step, self._act_keys()['query'])

  def _also_read(self, time_step: base.TimeStep) -> dict[str, Any]:
    return {} if self._guard is None else self._guard.read(time_step)

  def _queries(self, choice: base.Choice) -> dict[str, np.ndarray]:
    return {} if self._guard is None else self._guard.queries(choice)

  def _probabilities(self, observation: features.Packed) -> Any:
    return networks.probabilities(self._encoder, self._networks[0], observation)

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    metrics, continues = {}, batch['is_valid']
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
        {**batch, 'reading': reading, 'continues': continues},
        observation,
        self._draw_minibatches(by_world=self._options.memory > 0),
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


@functools.partial(jax.jit, static_argnums=0)
def _remember(
    encoder: features.Encoder,
    memory: networks.Memory,
    observation: features.Packed,
) -> jax.Array:
  """Returns the state of a memory after an observation, `(worlds, units)`."""
  return memory.state(memory(encoder.encode(observation)))


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
  seen = encoded = encoder.encode(batch['observation'])
  last = encoder.encode(observation)
  if agent.memory is not None:
    seen = agent.memory.through(encoded, batch['continues'])
    last = agent.memory(last)
  values = agent.value(seen)[..., 0]
  last_value = agent.value(last)[..., 0]
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
      'continues': batch['continues'],
  }
  if 'is_cloned' in batch:
    data['cloned'] = batch['is_cloned'].astype(jnp.float32)
  return training.run_epochs(
      options,
      functools.partial(_loss, options),
      trained,
      data,
      indices,
      by_world=agent.memory is not None,
  )


def _loss(
    options: PolicyGradientOptions, agent: ActorCritic, data: dict[str, Any]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  weight, encoded = data['weight'], data['encoded']
  if agent.memory is not None:
    encoded = agent.memory.through(encoded, data['continues'])
  distribution = agent.policy(encoded)
  log_prob = distribution.log_prob(data['action'])
  objective = training.clipped_objective(
      log_prob - data['log_prob'],
      training.standardize(data['advantage'], weight),
      options.clip,
  )
  error = agent.value(encoded)[..., 0] - data['target']
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
