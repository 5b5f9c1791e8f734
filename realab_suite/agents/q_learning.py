"""Q-learning (double DQN), with the reading of a register as reward."""

from collections.abc import Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite import errors
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
  gate: gates.Gate | None = None


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
    self._gate, self._trusted = gate, None
    self._gate_state: dict[str, Any] = {}
    self._setting = defences.Setting(
        options, self._encoder, self._controls, self._num_envs
    )
    self.is_off_policy = gate is None
    if gate is not None:
      if self._num_envs < 2:
        raise errors.SpecError(
            'learner.gate: in 1 world; allowed are more, because a trial'
            ' compares two halves of them'
        )
      self._gate_state = gate.initial_state(self._networks, self._num_envs)
      if gate.trusted is not None:
        self._trusted = gate.trusted.make(
            self._controls,
            self._num_envs,
            self._encoder.names,
            'learner.gate',
        )
      if gate.fit_steps <= options.min_replay:
        raise errors.SpecError(
            f'learner.gate.fit_steps: {gate.fit_steps}; allowed are more than'
            f' min_replay, {options.min_replay}, before which nothing is fitted'
        )
      most = (self._num_slots - options.num_returns) * self._num_envs
      if gate.alarms > most:
        raise errors.SpecError(
            f'learner.gate.alarms: {gate.alarms}; allowed are at most {most},'
            ' the transitions of the replay whose returns are known'
        )

  @property
  def _exploration(self) -> np.float32:
    """Probability of a random action."""
    return training.exploration(self._options, self.num_steps)

  def _steered(
      self,
      choice: base.Choice,
      time_step: base.TimeStep,
      observation: features.Packed,
  ) -> base.Choice:
    state, key = self._gate_state, self._act_keys()['query']
    if state.get('is_trying'):
      network, exploration = state['convinced'][0][0], self._exploration
      other = _act(self._encoder, network, observation, exploration, key)
      action = choice['action'].copy()
      action[1::2] = np.asarray(other)[1::2]
      return {**choice, 'action': action}
    if self._trusted is not None and not state['is_open']:
      return self._trusted.steer(choice, time_step, key)
    return choice

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    action = _act(
        self._encoder,
        self._networks[0][0],
        observation,
        np.float32(0.0) if greedy else self._exploration,
        keys['act'],
    )
    return {'action': np.asarray(action)}

  def _probabilities(self, observation: features.Packed) -> Any:
    return _probabilities(
        self._encoder, self._networks[0][0], observation, self._exploration
    )

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    options, gate, state = self._options, self._gate, self._gate_state
    if gate is not None:
      if self._trusted is not None and not state['is_open']:
        transition['is_valid'] &= self._trusted.acts
      transition = gate.sift(transition, self._setting, state)
    self._scale.update(jax.tree.map(lambda x: x[np.newaxis], transition))
    self._store(transition)
    if gate is not None and state['is_open']:
      num_held = len(held(options, self._replay, self._num_stored)[0])
      self._networks = gate.decide(
          self._networks, self._replay, num_held, observation, self._setting,
          state, self._trained,
      )  # fmt: skip
      if state['is_trying']:
        self._metrics |= self._gate_metrics()
        return
    is_enough = self._num_stored * self._num_envs >= options.min_replay
    if (
        not is_enough
        or self._num_stored < options.num_returns + 2
        or self._num_stored % options.steps_per_update
    ):
      return
    self._networks, metrics = self._updated(self._networks, self._update_key())
    self._num_updates += 1
    if gate is not None:
      if not state['is_open']:
        state |= {
            'model': self._trained(state['model'], 1, is_model=True),
            'values': self._networks,
            'scale': self._scale.value,
            'is_open': self.num_steps >= gate.fit_steps,
        }
      metrics |= self._gate_metrics()
    is_valid = transition['is_valid']
    reading = transition['reading'][is_valid]
    self._metrics = {
        **{name: float(value) for name, value in metrics.items()},
        'feedback_scale': self._scale.value,
        'exploration': float(self._exploration),
        'observed_feedback': float(reading.mean()) if len(reading) else 0.0,
    }

  def _gate_metrics(self) -> dict[str, float]:
    state = self._gate_state
    return {
        'changed': float(state['changed']),
        'gate_is_open': float(state['is_open']),
        **{f'gate_{name}': float(n) for name, n in state['counts'].items()},
    }

  def _updated(
      self,
      trained: Any,
      key: np.ndarray,
      injected: float = 0.0,
      is_model: bool = False,
  ) -> tuple[Any, dict[str, Any]]:
    """Returns networks after an update, and its metrics.

    Args:
      trained: Networks, with the states of their optimisers.
      key: Random key, two numbers.
      injected: Share of each minibatch that begins where readings are held
        back, which are believed then.
      is_model: True to predict single readings, and not from readings.
    """
    options = self._options
    if is_model:
      options = options.model_copy(update={'gamma': 0.0})
    generator = np.random.Generator(np.random.Philox(key=key.astype(np.uint64)))
    samples = sample(
        options, self._replay, self._num_stored, generator, injected
    )
    if is_model:
      seen = samples['observation']
      samples['observation'] = defences.blinded(seen, self._setting)
    samples['total'] /= np.float32(self._scale.value)
    return _update(self._options, self._encoder, trained, samples)

  def _trained(
      self,
      trained: Any,
      num_gradients: int,
      injected: float = 0.0,
      is_model: bool = False,
  ) -> Any:
    """Returns networks after about as many gradient steps; see `_updated`."""
    key = base.folded(self._keys['update'], self._num_acts)
    each = self._options.gradients_per_update
    for i in range(-(-num_gradients // each)):
      trained, _ = self._updated(
          trained, base.folded(key, i), injected, is_model
      )
      self._gate_state['counts']['gradients'] += each
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
      gate = {'gate': base.to_plain(self._gate_state), 'trusted': trusted}
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
      self._gate_state = base.from_plain(self._gate_state, memory['gate'])
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
    injected: float = 0.0,
) -> dict[str, Any]:
  """Draws minibatches of n-step returns from the replay.

  Sums of readings end at the end of an episode, or after
  `options.num_returns` steps.

  Args:
    options: Options of the learner.
    replay: Transitions, each array `(slots, worlds, ...)`.
    num_stored: Number of transitions of each world that were ever stored.
    generator: Random generator.
    injected: Share of a minibatch that begins where `is_held`; these readings
      are valid then.

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
  if injected:
    places = held(options, replay, num_stored)
    size = shape[0], max(1, int(injected * shape[1]))
    chosen = generator.integers(len(places[0]), size=size)
    start[:, : size[1]], world[:, : size[1]] = (x[chosen] for x in places)
    replay = {**replay, 'is_valid': replay['is_valid'] | replay['is_held']}
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


def held(
    options: QLearningOptions, replay: Any, num_stored: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns slots and worlds where `is_held`, and the returns are known."""
  slots, worlds = np.nonzero(replay['is_held'])
  ages = (num_stored - 1 - slots) % len(replay['is_held'])
  is_known = ages >= options.num_returns
  return slots[is_known], worlds[is_known]


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
