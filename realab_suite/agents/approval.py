"""Approval: myopic learning from what is said of an action that is asked about.

Coupled (`value_advice`): the action taken is asked about. What it does to the
register comes back as feedback on it, so tampering can pay.

Decoupled (`decoupled_approval`; Uesato et al. 2020, arXiv 2011.08827): what is
asked about is drawn independently of what is done: from the same policy, or
uniformly where the values of all actions are to be learned. What an action does
to the register falls on all actions alike.
"""

import abc
from collections.abc import Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np

from realab_suite import errors
from realab_suite.agents import base
from realab_suite.agents import features
from realab_suite.agents import networks
from realab_suite.agents import on_policy
from realab_suite.agents import training


class ApprovalOptions(on_policy.OnPolicyOptions):
  """What both learners have to be told.

  Attributes:
    query: The register in which an action is asked about.
    form: `policy_gradient` learns a policy from approval; `q` learns the
      approval of each action, and mostly takes the best.
    entropy: How much the entropy of the policy counts (`policy_gradient`).
    clip: How far a policy goes in one update (`policy_gradient`).
    follows_reading: Whether what is to be expected follows the last reading: a
      base block that was moved adds to all readings to come, and no action to
      come deserves that.
    exploration: How often an action is drawn at random in the end (`q`).
    exploration_steps: Until when it is done more often, in control steps of all
      worlds together (`q`).
  """

  query: str
  form: Literal['policy_gradient', 'q'] = 'policy_gradient'
  entropy: base.Weight = 0.01
  clip: base.Fraction = 0.2
  follows_reading: bool = False
  exploration: base.Fraction = 0.05
  exploration_steps: base.Positive = 200_000

  @property
  def queries(self) -> tuple[str, ...]:
    """The registers in which actions are asked about."""
    return (self.query,)


@final
class ValueAdviceOptions(ApprovalOptions):
  """Options of `value_advice`.

  Attributes:
    advice: The register that holds the value of the action asked about.
    query_policy: What is asked about.
  """

  kind: Literal['value_advice']
  advice: str
  query_policy: Literal['taken_action'] = 'taken_action'


@final
class DecoupledApprovalOptions(ApprovalOptions):
  """Options of `decoupled_approval`.

  Attributes:
    approval: The register that holds the approval of the action asked about.
    query_policy: What is asked about.
    other_query: A second query register for paired queries: then `approval`
      holds how much better the action in `query` is than that in `other_query`.
  """

  kind: Literal['decoupled_approval']
  approval: str
  query_policy: Literal['independent_action'] = 'independent_action'
  other_query: str | None = None

  @property
  def queries(self) -> tuple[str, ...]:
    if self.other_query is None:
      return (self.query,)
    return (self.query, self.other_query)


class _ApprovalLearner(on_policy.OnPolicyLearner):
  """What coupled and decoupled approval have in common: all but the query."""

  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    self._controls.check_discrete(self._options.kind)
    for query in self._options.queries:
      self._controls.check_query('learner', query)
    # Myopic: no discounted sum of feedback, but the feedback itself.
    self._scale = training.FeedbackScale(self._num_envs, 0.0)

  def _initial_networks(self, generator: np.random.Generator) -> Any:
    num_actions = self._controls.check_discrete(self._options.kind)
    make = functools.partial(
        networks.Network, self._encoder, self._options.hidden
    )
    agent: dict[str, Any]
    if self._options.form == 'q':
      agent = {'values': make(num_actions, 0.01, generator)}
    else:
      agent = {
          'policy': make(num_actions, 0.01, generator),
          'baseline': make(1, 1.0, generator),
      }
    if self._options.follows_reading:
      agent['following'] = jnp.ones(())
    return agent, training.optimizer(self._options).init(agent)

  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> base.Choice:
    choice = _choose(
        self._encoder,
        self._networks[0],
        observation,
        training.exploration(self._options, self.num_steps),
        keys['act'],
        self._query_keys(keys),
        greedy,
    )
    return jax.tree.map(np.asarray, choice)

  @abc.abstractmethod
  def _query_keys(self, keys: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns what each query is drawn with, `(queries, 2)`; none: the action.

    Raises:
      SpecError: If it is what something else is drawn with.
    """

  def _asked(self, choice: base.Choice) -> dict[str, np.ndarray]:
    asked = choice['asked']
    return {name: asked[:, i] for i, name in enumerate(self._options.queries)}

  def _probabilities(self, observation: features.Packed) -> Any:
    return _probabilities(
        self._encoder,
        self._networks[0],
        observation,
        training.exploration(self._options, self.num_steps),
    )

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    del observation  # Nothing has been said of it yet.
    self._scale.update(batch)
    scale = np.float32(self._scale.value)
    last = batch['observation'][self._reading].reshape(batch['reading'].shape)
    self._networks, metrics = _update(
        self._options,
        self._encoder,
        self._networks,
        {**batch, 'reading': batch['reading'] / scale, 'last': last / scale},
        self._draw_minibatches(),
    )
    return {**metrics, 'feedback_scale': self._scale.value}

  def _memory(self) -> dict[str, Any]:
    return {**super()._memory(), 'scale': self._scale.state()}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    super()._set_memory(memory)
    self._scale.set_state(memory['scale'])


@base.LEARNERS.add('value_advice')
@final
class ValueAdvice(_ApprovalLearner):
  """Coupled: asks about the action that it takes."""

  OPTIONS = ValueAdviceOptions
  READS = 'advice'

  def _query_keys(self, keys: Mapping[str, np.ndarray]) -> np.ndarray:
    del keys
    return np.zeros((0, 2), np.uint32)


@base.LEARNERS.add('decoupled_approval')
@final
class DecoupledApproval(_ApprovalLearner):
  """Decoupled: asks about actions drawn independently of the one it takes."""

  OPTIONS = DecoupledApprovalOptions
  READS = 'approval'

  def _query_keys(self, keys: Mapping[str, np.ndarray]) -> np.ndarray:
    num_queries = len(self._options.queries)
    children = np.random.SeedSequence(keys['query'].tolist()).spawn(num_queries)
    query_keys = np.stack([child.generate_state(2) for child in children])
    refuse_shared_randomness(keys['act'], query_keys)
    return query_keys


def refuse_shared_randomness(
    act_key: np.ndarray, query_keys: np.ndarray
) -> None:
  """Refuses keys of which two would draw the same action.

  Raises:
    SpecError: If they are not all different.
  """
  drawn_with = [tuple(act_key.tolist()), *map(tuple, query_keys.tolist())]
  if len(set(drawn_with)) < len(drawn_with):
    raise errors.SpecError(
        'learner decoupled_approval: two of the action taken and the actions'
        f' asked about share the random key of {drawn_with}; allowed are keys'
        ' that all differ'
    )


def _log_probs(
    agent: dict[str, Any], encoded: Any, exploration: Any
) -> jax.Array:
  """The logarithm of each action's probability, `(..., actions)`."""
  if 'policy' in agent:
    return jax.nn.log_softmax(agent['policy'](encoded))
  values = agent['values'](encoded)
  num_actions = values.shape[-1]
  best = jax.nn.one_hot(jnp.argmax(values, axis=-1), num_actions)
  return jnp.log((1.0 - exploration) * best + exploration / num_actions)


@functools.partial(jax.jit, static_argnums=(0, 6))
def _choose(
    encoder: features.Encoder,
    agent: dict[str, Any],
    observation: features.Packed,
    exploration: jax.Array,
    act_key: jax.Array,
    query_keys: jax.Array,
    greedy: bool,
) -> dict[str, jax.Array]:
  log_probs = _log_probs(agent, encoder.encode(observation), exploration)
  action = networks.draw(act_key, log_probs)
  if greedy:
    action = jnp.argmax(log_probs, axis=-1)
  # Only a policy is learned from actions of its own.
  asks = log_probs if 'policy' in agent else jnp.zeros_like(log_probs)
  drawn = [networks.draw(key, asks) for key in query_keys]
  asked = jnp.stack(drawn or [action], axis=-1)
  log_prob = jnp.take_along_axis(log_probs, asked, axis=-1)
  return {'action': action, 'asked': asked, 'log_prob': log_prob}


@functools.partial(jax.jit, static_argnums=0)
def _probabilities(
    encoder: features.Encoder,
    agent: dict[str, Any],
    observation: features.Packed,
    exploration: jax.Array,
) -> jax.Array:
  return jnp.exp(_log_probs(agent, encoder.encode(observation), exploration))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _update(
    options: ApprovalOptions,
    encoder: features.Encoder,
    trained: Any,
    batch: dict[str, Any],
    indices: jax.Array,
) -> tuple[Any, dict[str, jax.Array]]:
  """Learns from what was said of the actions asked about in a batch."""
  data = {
      'encoded': encoder.encode(batch['observation']),
      'asked': batch['choice']['asked'],
      'log_prob': batch['choice']['log_prob'],
      'feedback': batch['reading'],
      'last': batch['last'],
      'weight': batch['is_valid'].astype(jnp.float32),
  }
  loss: training.Loss = functools.partial(_policy_loss, options)
  if options.form == 'q':
    loss = _value_loss
  else:
    data['advantage'] = data['feedback']
    # The difference of two alike is nothing to be expected, but for an offset.
    if len(options.queries) == 1 or options.follows_reading:
      data['advantage'] -= _expected(trained[0], data)
  return training.run_epochs(options, loss, trained, data, indices)


def _expected(agent: dict[str, Any], data: dict[str, Any]) -> jax.Array:
  """What would be said here anyway, `(...)`; no action or query is in it."""
  return agent['baseline'](data['encoded'])[..., 0] + _offset(agent, data)


def _offset(agent: dict[str, Any], data: dict[str, Any]) -> Any:
  """What of the last reading is expected to be in the next one, too."""
  return agent['following'] * data['last'] if 'following' in agent else 0.0


def signs(asked: jax.Array) -> jax.Array:
  """What the feedback says of each action asked about: for it, or against."""
  return jnp.array([1.0, -1.0])[: asked.shape[-1]]


def policy_objective(
    log_probs: jax.Array,
    asked: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    clip: float,
) -> jax.Array:
  """The objective of each sample, `(...)`.

  At the old policy its gradient is that of log pi(asked) times the advantage;
  for a pair, half of (log pi(asked) - log pi(other)) times the difference.

  Args:
    log_probs: Of all actions, `(..., actions)`.
    asked: The actions asked about, `(..., 1)`; a pair, `(..., 2)`.
    old_log_prob: Of the actions asked about when they were drawn.
    advantage: What was said of it, `(...)`.
    clip: How far a policy goes in one update.
  """
  chosen = jax.nn.one_hot(asked, log_probs.shape[-1])
  log_prob = jnp.sum(chosen * log_probs[..., jnp.newaxis, :], axis=-1)
  signed = advantage[..., jnp.newaxis] * signs(asked)
  objective = training.clipped_objective(log_prob - old_log_prob, signed, clip)
  return jnp.mean(objective, axis=-1)


def _policy_loss(
    options: ApprovalOptions,
    agent: dict[str, Any],
    data: dict[str, Any],
) -> tuple[jax.Array, dict[str, jax.Array]]:
  weight = data['weight']
  log_probs = jax.nn.log_softmax(agent['policy'](data['encoded']))
  objective = policy_objective(
      log_probs,
      data['asked'],
      data['log_prob'],
      training.standardize(data['advantage'], weight),
      options.clip,
  )
  error = _expected(agent, data) - data['feedback']
  entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)
  metrics = {
      'policy_loss': -training.mean(objective, weight),
      'baseline_loss': 0.5 * training.mean(error**2, weight),
      'entropy': training.mean(entropy, weight),
  }
  loss = (
      metrics['policy_loss']
      + metrics['baseline_loss']
      - options.entropy * metrics['entropy']
  )
  return loss, metrics


def _value_loss(
    agent: dict[str, Any], data: dict[str, Any]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Regression of what was said of the action, or of the pair."""
  values = agent['values'](data['encoded'])
  chosen = jax.nn.one_hot(data['asked'], values.shape[-1])
  predicted = jnp.sum(chosen * values[..., jnp.newaxis, :], axis=-1)
  predicted = jnp.sum(predicted * signs(data['asked']), axis=-1)
  predicted += _offset(agent, data)
  error = predicted - data['feedback']
  loss = 0.5 * training.mean(error**2, data['weight'])
  return loss, {
      'value_loss': loss,
      'value': training.mean(jnp.max(values, axis=-1), data['weight']),
  }
