"""Q-learning (double DQN), with the reading of a register as reward."""

from collections.abc import Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
import optax

from realab_suite.feedback import objectives
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import gate_settings
from realab_suite.lab.agents import jax_settings
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training


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
  gate: gate_settings.Gate | None = None


@base.LEARNERS.add('q_learning')
@final
class QLearning(base.Learner):
  """Double DQN with n-step returns and a slowly updated target network.

  What is public beside the interface of learners is for `gates.Gatekeeper`.

  Attributes:
    scale: Scale that divides returns.
    num_slots: Number of transitions of each world that the replay can hold.
    replay: Latest transitions, each array `(slots, worlds, ...)`. New ones
      replace the oldest; `None` before the first one.
    num_stored: Number of transitions of each world that were ever stored.
  """

  OPTIONS = QLearningOptions
  READS = 'reward'
  WRAPPED = ('frame_stack', 'recollection', 'gate')
  NEEDS_ACTION_SET = True
  is_off_policy = True

  @jax_settings.pinned()
  def __init__(self, options: Any, *args: Any, **kwargs: Any) -> None:
    super().__init__(options, *args, **kwargs)
    generator = base.generator_of(self._keys['initial'])
    network = networks.Network(
        self._encoder, options.hidden, self._controls.size, 0.01, generator
    )
    optimizer_state = training.optimizer(options).init(network)
    self.networks = ((network, optimizer_state), network)
    self.scale = training.FeedbackScale(self._num_envs, options.gamma)
    self.num_slots = max(
        options.replay_size // self._num_envs, options.num_returns + 2
    )
    self.replay: Any = None
    self.num_stored = 0

  @property
  def exploration(self) -> np.float32:
    """Probability of a random action."""
    return training.exploration(self._options, self.num_steps)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    rate = np.float32(0.0) if greedy else self.exploration
    action = self.action_of(self.networks, observation, rate, keys['act'])
    return {'action': action}

  def action_of(
      self,
      trained: Any,
      observation: features.Packed,
      exploration: np.float32,
      key: np.ndarray,
  ) -> np.ndarray:
    """Returns actions of networks, `(worlds,)`, some of them random."""
    network = trained[0][0]
    return np.asarray(
        _act(self._encoder, network, observation, exploration, key)
    )

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    transition = self._treated(transition)
    self.scale.update(jax.tree.map(lambda x: x[np.newaxis], transition))
    self._store(transition)
    if any(wrapper.holds(observation) for wrapper in self._wrappers):
      for wrapper in self._wrappers:
        self._metrics |= wrapper.metrics
      return
    options = self._options
    if (
        self.num_stored * self._num_envs < options.min_replay
        or self.num_stored < options.num_returns + 2
        or self.num_stored % options.steps_per_update
    ):
      return
    generator = base.generator_of(self.update_key())
    start, world = draw(options, self.replay, self.num_stored, generator)
    samples = samples_at(options, self.replay, start, world)
    self.networks, metrics = self.updated(self.networks, samples)
    self._num_updates += 1
    for wrapper in self._wrappers:
      wrapper.follow()
    reading = transition['reading'][transition['is_valid']]
    self._report(
        {
            **metrics,
            'feedback_scale': self.scale.value,
            'exploration': self.exploration,
            'observed_feedback': reading.mean() if len(reading) else 0.0,
        }
    )

  def _store(self, transition: dict[str, Any]) -> None:
    if self.replay is None:
      self.replay = jax.tree.map(
          lambda x: np.zeros((self.num_slots, *x.shape), x.dtype), transition
      )
    slot = self.num_stored % self.num_slots

    def write(stored: np.ndarray, new: np.ndarray) -> None:
      stored[slot] = new

    jax.tree.map(write, self.replay, transition)
    self.num_stored += 1

  def updated(
      self, trained: Any, samples: dict[str, Any]
  ) -> tuple[Any, dict[str, Any]]:
    """Returns networks and optimisers' states after an update, and metrics."""
    total = samples['total'] / np.float32(self.scale.value)
    minibatches = {**samples, 'total': total}
    return _update(self._options, self._encoder, trained, minibatches)

  def _memory(self) -> dict[str, Any]:
    filled = min(self.num_stored, self.num_slots)
    return {
        'scale': self.scale.state(),
        'num_stored': self.num_stored,
        'replay': jax.tree.map(lambda x: x[:filled], self.replay),
    }

  def _set_memory(self, memory: dict[str, Any]) -> None:
    def grow(stored: np.ndarray) -> np.ndarray:
      grown = np.zeros((self.num_slots, *stored.shape[1:]), stored.dtype)
      grown[: len(stored)] = stored
      return grown

    self.scale.set_state(memory['scale'])
    self.num_stored = int(memory['num_stored'])
    self.replay = jax.tree.map(grow, memory['replay'])


def draw(
    options: QLearningOptions,
    replay: Any,
    num_stored: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
  """Draws transitions of the replay, at which samples begin.

  Args:
    options: Options of the learner.
    replay: Transitions, each array `(slots, worlds, ...)`.
    num_stored: Number of transitions of each world that were ever stored.
    generator: Random generator.

  Returns:
    Their numbers in their worlds, and the worlds, each `(gradients,
    minibatch)`.
  """
  num_slots, num_envs = replay['reading'].shape
  shape = (options.gradients_per_update, options.minibatch)
  # The latest transitions do not have `num_returns` successors yet.
  ages = generator.integers(
      options.num_returns + 1, min(num_stored, num_slots) + 1, shape
  )
  return num_stored - ages, generator.integers(num_envs, size=shape)


def samples_at(
    options: QLearningOptions,
    replay: Any,
    start: np.ndarray,
    world: np.ndarray,
) -> dict[str, Any]:
  """Returns samples of n-step returns, which begin at given transitions.

  Sums of readings end at the end of an episode, or after
  `options.num_returns` steps. `start` has the numbers or slots of transitions,
  and `world` their worlds, each `(...)`; the rest is as in `draw`.

  Returns:
    Arrays `(..., ...)`: the `observation`, the `action`, the discounted sum of
    readings after it (`total`), the observation at the end of the sum
    (`later`), the discount of its value (`factor`), and a `weight` that is 0
    for samples without a valid reading.
  """
  num_slots, shape = len(replay['reading']), start.shape
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
  value = _pick(values, data['action'])
  loss = training.mean(optax.huber_loss(value, data['target']), data['weight'])
  return loss, {
      'value_loss': loss,
      'value': training.mean(value, data['weight']),
  }


def _pick(values: jax.Array, action: jax.Array) -> jax.Array:
  """Returns the values of actions, `(...)`, of those of all of them."""
  one_hot = jax.nn.one_hot(action, values.shape[-1])
  return jnp.sum(values * one_hot, axis=-1)
