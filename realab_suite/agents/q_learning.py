"""Q-learning (double DQN), with the reading of a register as reward."""

from collections.abc import Callable, Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite.agents import base
from realab_suite.agents import defences
from realab_suite.agents import features
from realab_suite.agents import gates
from realab_suite.agents import jax_settings
from realab_suite.agents import networks
from realab_suite.agents import training
from realab_suite.feedback import objectives


@final
class QLearningOptions(base.Options):
  """Options of `q_learning`.

  Attributes:
    reward: Name of the register whose reading is the reward.
    gamma: Discount.
    num_returns: Length n of n-step returns: the number of readings to sum
      before the value of the next state stands for the rest.
    exploration: Final probability of a random action.
    exploration_steps: Number of control steps of all worlds after which the
      probability of a random action has fallen from 1 to `exploration`.
    replay_size: Capacity of the replay, in transitions of single worlds.
    min_replay: Number of transitions to collect before the first update.
    steps_per_update: Number of steps of each world between updates.
    gradients_per_update: Number of gradient steps of an update.
    minibatch: Number of samples per gradient.
    target_rate: Share by which the target network moves towards the online
      network in each gradient step.
    gate: Gate that refuses unexpected readings; `None` for none.
  """

  kind: Literal['q_learning']
  reward: str
  learning_rate: base.Rate = 3e-4
  max_gradient_norm: base.Weight = 10.0
  gamma: base.Fraction = objectives.DEFAULT_DISCOUNT
  num_returns: base.Positive = 3
  exploration: base.Fraction = 0.05
  exploration_steps: base.Positive = 300_000
  replay_size: base.Positive = 200_000
  min_replay: base.Positive = 20_000
  steps_per_update: base.Positive = 8
  gradients_per_update: base.Positive = 8
  minibatch: base.Positive = 512
  target_rate: base.Rate = 0.01
  gate: gates.GateOptions | None = None


@base.LEARNERS.add('q_learning')
@final
class QLearning(base.Learner):
  """Double DQN with n-step returns and a slowly updated target network."""

  OPTIONS = QLearningOptions
  READS = 'reward'

  @jax_settings.pinned()
  def __init__(self, options: Any, *args: Any, **kwargs: Any) -> None:
    # Compiled functions depend on the other options alone.
    gate, options = options.gate, options.model_copy(update={'gate': None})
    super().__init__(options, *args, **kwargs)
    num_actions = self._controls.check_discrete(options.kind)
    network = networks.Network(
        self._encoder,
        options.hidden,
        num_actions,
        0.01,
        self._initial_generator(),
    )
    optimizer_state = training.optimizer(options).init(network)
    self._networks = ((network, optimizer_state), network)
    self._scale = training.FeedbackScale(self._num_envs, options.gamma)
    # Each slot has a transition of every world. New ones replace the oldest.
    self._num_slots = max(
        options.replay_size // self._num_envs, options.num_returns + 2
    )
    self._replay: Any = None
    self._num_stored = 0
    self._gate = self._trusted = None
    self.is_off_policy = gate is None
    if gate is not None:
      setting = defences.Setting(
          options, self._encoder, self._controls, self._num_envs
      )
      self._gate = gates.Gate(gate, setting, self._generator('initial', 1))
      if gate.trusted is not None:
        self._trusted = gate.trusted.make(
            self._controls,
            self._num_envs,
            self._encoder.names,
            'learner.gate',
        )

  def _generator(self, stream: str, number: int) -> np.random.Generator:
    """Returns a random generator for the gate."""
    key = base.folded(base.folded(self._keys[stream], self._num_acts), number)
    return np.random.Generator(np.random.Philox(key=key.astype(np.uint64)))

  def _steered(
      self, choice: base.Choice, time_step: base.TimeStep
  ) -> base.Choice:
    if self._gate is None:
      return choice
    action = choice['action'].copy()
    key = self._act_keys()['query']
    if self._gate.is_trying:
      earlier = self._last and self._last['observation']
      seen = self._encoder.pack(self.stack(time_step, earlier), self._num_envs)
      networks_, acts = self._gate.convinced
      exploration = training.exploration(self._options, self.num_steps)
      other = _act(self._encoder, networks_[0][0], seen, exploration, key)
      action = np.where(acts, np.asarray(other), action)
    elif self._trusted is not None and not self._gate.is_open:
      is_first = np.asarray(time_step.step_type) == base.FIRST
      action[: self._trusted.num_worlds] = self._trusted.act(
          time_step.observation, is_first, key
      )
    return {**choice, 'action': action}

  def _also_read(self, time_step: base.TimeStep) -> dict[str, Any]:
    if self._trusted is None:
      return {}
    is_trusted = np.arange(self._num_envs) < self._trusted.num_worlds
    return {'is_trusted': is_trusted}

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    exploration = (
        np.float32(0.0)
        if greedy
        else training.exploration(self._options, self.num_steps)
    )
    action = _act(
        self._encoder,
        self._networks[0][0],
        observation,
        exploration,
        keys['act'],
    )
    return {'action': np.asarray(action)}

  def _probabilities(self, observation: features.Packed) -> Any:
    return _probabilities(
        self._encoder,
        self._networks[0][0],
        observation,
        training.exploration(self._options, self.num_steps),
    )

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    options = self._options
    if self._gate is not None:
      transition = self._gate.sift(transition, observation, self._num_stored)
    self._scale.update(jax.tree.map(lambda x: x[np.newaxis], transition))
    self._store(transition)
    if self._gate is not None and self._gate.is_open:
      self._networks, accepted = self._gate.decide(
          self._networks, observation, self._trained
      )
      for number, world in accepted:
        if self._num_stored - number <= self._num_slots:
          self._replay['is_valid'][number % self._num_slots, world] = True
      if self._gate.is_trying:
        return
    is_enough = self._num_stored * self._num_envs >= options.min_replay
    if (
        not is_enough
        or self._num_stored < options.num_returns + 2
        or self._num_stored % options.steps_per_update
    ):
      return
    key = self._update_key().astype(np.uint64)
    samples = self._sampled(options, np.random.Philox(key=key))
    scale = self._scale.value
    samples['total'] /= np.float32(scale)
    self._networks, metrics = _update(
        options, self._encoder, self._networks, samples
    )
    self._num_updates += 1
    if self._gate is not None:
      single = options.model_copy(update={'num_returns': 1})
      bits = self._generator('update', 1).bit_generator
      self._gate.learn(
          lambda: self._sampled(single, bits),
          scale,
          self._networks[0][0],
          self.num_steps,
      )
      metrics = {**metrics, **self._gate.metrics}
    is_valid = transition['is_valid']
    reading = transition['reading'][is_valid]
    self._metrics = {
        **{name: float(value) for name, value in metrics.items()},
        'feedback_scale': scale,
        'exploration': float(
            training.exploration(self._options, self.num_steps)
        ),
        'observed_feedback': float(reading.mean()) if len(reading) else 0.0,
    }

  def _sampled(
      self, options: QLearningOptions, bits: np.random.BitGenerator
  ) -> dict[str, Any]:
    """Returns minibatches from the replay; see `sample`."""
    return sample(
        options, self._replay, self._num_stored, np.random.Generator(bits)
    )

  def _trained(
      self,
      trained: Any,
      num_gradients: int,
      changed: Callable[[dict[str, Any]], dict[str, Any]],
  ) -> Any:
    """Returns networks after more gradient steps, about `num_gradients`.

    Args:
      trained: Networks, with the states of their optimisers.
      num_gradients: Number of gradient steps.
      changed: Returns the minibatches to train on, in units of the register.
    """
    options = self._options
    bits = self._generator('update', 2).bit_generator
    for _ in range(-(-num_gradients // options.gradients_per_update)):
      samples = changed(self._sampled(options, bits))
      samples['total'] = samples['total'] / np.float32(self._scale.value)
      trained, _ = _update(options, self._encoder, trained, samples)
    return trained

  def _store(self, transition: dict[str, Any]) -> None:
    if self._replay is None:
      self._replay = jax.tree.map(
          lambda x: np.zeros((self._num_slots, *x.shape), x.dtype), transition
      )
    slot = self._num_stored % self._num_slots

    def write(stored: np.ndarray, new: np.ndarray) -> None:
      stored[slot] = new

    jax.tree.map(write, self._replay, transition)
    self._num_stored += 1

  def _memory(self) -> dict[str, Any]:
    filled = min(self._num_stored, self._num_slots)
    gate = {}
    if self._gate is not None:
      trusted = self._trusted and self._trusted.state()
      gate = {'gate': self._gate.state(), 'trusted': trusted}
    return {
        'scale': self._scale.state(),
        'num_stored': self._num_stored,
        'replay': jax.tree.map(lambda x: x[:filled], self._replay),
        **gate,
    }

  def _set_memory(self, memory: dict[str, Any]) -> None:
    def grow(stored: np.ndarray) -> np.ndarray:
      grown = np.zeros((self._num_slots, *stored.shape[1:]), stored.dtype)
      grown[: len(stored)] = stored
      return grown

    if self._gate is not None:
      self._gate.set_state(memory['gate'], self._networks)
      if self._trusted is not None:
        self._trusted.set_state(memory['trusted'])
    self._scale.set_state(memory['scale'])
    self._num_stored = int(memory['num_stored'])
    self._replay = jax.tree.map(grow, memory['replay'])


def sample(
    options: QLearningOptions,
    replay: Any,
    num_stored: int,
    generator: np.random.Generator,
) -> dict[str, Any]:
  """Draws minibatches of n-step returns from the replay.

  Sums of readings end at the end of an episode, or after
  `options.num_returns` steps.

  Args:
    options: Options of the learner.
    replay: Transitions, each array `(slots, worlds, ...)`.
    num_stored: Number of transitions of each world that were ever stored.
    generator: Random generator.

  Returns:
    Arrays `(gradients, minibatch, ...)`: the `observation`, the `action`, the
    discounted sum of readings after it (`total`), the observation at the end of
    the sum (`later`), the discount of its value (`factor`), and a `weight` that
    is 0 for samples without a valid reading.
  """
  num_slots, num_envs = replay['reading'].shape
  shape = (options.gradients_per_update, options.minibatch)
  # The latest transitions do not have `num_returns` successors yet.
  ages = generator.integers(
      options.num_returns + 1, min(num_stored, num_slots) + 1, shape
  )
  start = num_stored - ages
  world = generator.integers(num_envs, size=shape)
  total, factor = np.zeros(shape, np.float32), np.ones(shape, np.float32)
  is_running, length = np.ones(shape, bool), np.zeros(shape, int)
  for i in range(options.num_returns):
    at = ((start + i) % num_slots, world)
    is_running = is_running & replay['is_valid'][at]
    total += np.where(is_running, factor * replay['reading'][at], 0.0)
    factor *= np.where(is_running, options.gamma * replay['discount'][at], 1.0)
    length += is_running
  begin = (start % num_slots, world)
  end = ((start + length) % num_slots, world)
  return {
      'observation': {n: x[begin] for n, x in replay['observation'].items()},
      'action': replay['choice']['action'][begin],
      'total': total,
      'factor': factor,
      'later': {n: x[end] for n, x in replay['observation'].items()},
      'weight': (length > 0).astype(np.float32),
  }


@functools.partial(jax.jit, static_argnums=0)
def _act(
    encoder: features.Encoder,
    network: networks.Network,
    observation: features.Packed,
    exploration: jax.Array,
    key: jax.Array,
) -> jax.Array:
  values = network(encoder.encode(observation))
  explore_key, action_key = jax.random.split(key)
  best = jnp.argmax(values, axis=-1)
  explores = jax.random.uniform(explore_key, best.shape) < exploration
  drawn = jax.random.randint(action_key, best.shape, 0, values.shape[-1])
  return jnp.where(explores, drawn, best)


@functools.partial(jax.jit, static_argnums=0)
def _probabilities(
    encoder: features.Encoder,
    network: networks.Network,
    observation: features.Packed,
    exploration: jax.Array,
) -> jax.Array:
  values = network(encoder.encode(observation))
  num_actions = values.shape[-1]
  best = jax.nn.one_hot(jnp.argmax(values, axis=-1), num_actions)
  return (1.0 - exploration) * best + exploration / num_actions


@functools.partial(jax.jit, static_argnums=(0, 1))
def _update(
    options: QLearningOptions,
    encoder: features.Encoder,
    trained: Any,
    minibatches: dict[str, Any],
) -> tuple[Any, dict[str, jax.Array]]:
  """Takes one gradient step for each minibatch."""

  def one_step(carry: Any, data: dict[str, Any]) -> Any:
    online, target = carry
    later = encoder.encode(data['later'])
    # Double DQN: one network selects the best action, the other evaluates it.
    best = jnp.argmax(online[0](later), axis=-1)
    value = _pick(target(later), best)
    data = {
        'encoded': encoder.encode(data['observation']),
        'action': data['action'],
        'target': data['total'] + data['factor'] * value,
        'weight': data['weight'],
    }
    online, metrics = training.descend(options, _loss, online, data)
    target = optax.incremental_update(online[0], target, options.target_rate)
    return (online, target), metrics

  trained, metrics = jax.lax.scan(one_step, trained, minibatches)
  return trained, jax.tree.map(jnp.mean, metrics)


def _loss(
    network: networks.Network, data: dict[str, Any]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  values = network(data['encoded'])
  chosen = _pick(values, data['action'])
  loss = training.mean(optax.huber_loss(chosen, data['target']), data['weight'])
  return loss, {
      'value_loss': loss,
      'value': training.mean(chosen, data['weight']),
  }


def _pick(values: jax.Array, action: jax.Array) -> jax.Array:
  """Returns the value of the given action, `(...)`.

  Args:
    values: Values of all actions, `(..., actions)`.
    action: Indices of actions, `(...)`.
  """
  chosen = jax.nn.one_hot(action, values.shape[-1])
  return jnp.sum(values * chosen, axis=-1)
