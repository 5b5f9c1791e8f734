"""Approval learners, which learn myopically from feedback on queried actions.

Coupled (`value_advice`): the learner queries the action that it takes. The
effect of the action on the register becomes feedback on that action, so
tampering can pay.

Decoupled (`decoupled_approval`; Uesato et al. 2020, arXiv 2011.08827): the
learner draws the queried action independently of the action taken. It draws
from the same policy, or uniformly if it learns the values of all actions. The
effect of an action on the register then changes the feedback on all actions
equally.
"""

import abc
from collections.abc import Mapping
import functools
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import training


class ApprovalOptions(training.OnPolicyOptions):
  """Options of both approval learners.

  Attributes:
    query: Name of the query register.
    form: `policy_gradient` learns a policy from approval; `q` learns the
      approval of each action, and takes the best action most of the time.
    entropy: Weight of the policy's entropy in the loss (`policy_gradient`).
    clip: Largest change of a probability ratio in one update
      (`policy_gradient`).
    follows_reading: True to predict the feedback from the last reading as well.
      A base block that was moved changes all later readings, and no later
      action should be credited with that.
    scale: Standard deviation that divides the feedback: that of the `reading`,
      or that of its `change` in a step. The first grows with the displacement
      of a block until networks no longer resolve the feedback itself.
    exploration: Final probability of a random action (`q`).
    exploration_steps: Number of control steps of all worlds after which the
      probability of a random action has fallen from 1 to `exploration` (`q`).
    floor: Smallest probability of each action and query (`policy_gradient`). An
      action that the policy has given up is still taken, and can be learned
      again.
    query_delay: 0 if a reading is the feedback on the query of its own step; 1
      if it is the feedback on the query and the observation of the step before,
      as in the paper's example. It has to be that of the provider.
  """

  query: str
  form: Literal['policy_gradient', 'q'] = 'policy_gradient'
  entropy: base.Weight = 0.01
  clip: base.Fraction = 0.2
  follows_reading: bool = False
  scale: Literal['reading', 'change'] = 'reading'
  exploration: base.Fraction = 0.05
  exploration_steps: base.Positive = 200_000
  floor: base.Fraction = 0.0
  query_delay: validation.ZeroOrOne = 0

  @pydantic.model_validator(mode='after')
  def _without_floor(self) -> 'ApprovalOptions':
    if self.floor and self.form == 'q':
      raise ValueError(
          f'floor: {self.floor}; must be 0 with the form q, which has'
          ' exploration'
      )
    return self

  @property
  def queries(self) -> tuple[str, ...]:
    """Names of the query registers."""
    return (self.query,)


@final
class ValueAdviceOptions(ApprovalOptions):
  """Options of `value_advice`.

  Attributes:
    advice: Name of the register that holds the value of the queried action.
    query_policy: Only `taken_action`: `query` holds the action taken.
  """

  kind: Literal['value_advice']
  advice: str
  query_policy: Literal['taken_action'] = 'taken_action'


@final
class DecoupledApprovalOptions(ApprovalOptions):
  """Options of `decoupled_approval`.

  Attributes:
    approval: Name of the register that holds the approval of the queried
      action.
    query_policy: Only `independent_action`: the action in `query` is drawn
      independently of the action taken.
    other_query: Name of a second query register for paired queries, or `None`.
      With paired queries, `approval` holds the approval of the action in
      `query` minus that of the action in `other_query`.
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


class _ApprovalLearner(training.OnPolicyLearner, abc.ABC):
  """Base class of both approval learners, which differ in their options."""

  NEEDS_ACTION_SET = True

  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    for query in self._options.queries:
      self._controls.check_query('learner', query)
    num_actions = self._controls.size
    if self._options.floor * num_actions >= 1.0:
      raise errors.SpecError(
          f'learner.floor: {self._options.floor}; must be below'
          f' 1/{num_actions}, because there are {num_actions} actions'
      )
    # The last transition, whose feedback comes with the next one.
    self._before: dict[str, Any] | None = None

  def _initial_networks(self, generator: np.random.Generator) -> Any:
    num_actions = self._controls.size
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
        self.networks[0],
        observation,
        self._exploration,
        keys['act'],
        self._query_keys(keys),
        greedy,
    )
    return jax.tree.map(np.asarray, choice)

  @property
  def _exploration(self) -> np.float32 | None:
    """Probability of a uniformly drawn action; `None` if there are none."""
    options = self._options
    if options.form == 'q':
      return training.exploration(options, self.num_steps)
    if not options.floor:
      return None
    return np.float32(options.floor * self._controls.size)

  def _query_keys(self, keys: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Returns the random key of each query; none if it is the action taken."""
    if self._options.query_policy == 'taken_action':
      return []
    words = np.random.SeedSequence(keys['query'].tolist())
    children = words.spawn(len(self._options.queries))
    return [child.generate_state(2) for child in children]

  def _queries(self, choice: base.Choice) -> dict[str, np.ndarray]:
    asked = choice['asked']
    return {name: asked[:, i] for i, name in enumerate(self._options.queries)}

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    if self._options.query_delay:
      before, self._before = self._before, transition
      if before is None:
        return
      # The feedback on the last query of an episode never comes: the step after
      # it begins the next one.
      transition = {
          **transition,
          'observation': before['observation'],
          'choice': before['choice'],
          'is_valid': before['is_valid'] & transition['is_valid'],
      }
    super()._observe(transition, observation)

  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    del observation  # There is no feedback on it yet.
    last = batch['observation'][self._reading].reshape(batch['reading'].shape)
    origin = last if self._options.scale == 'change' else 0.0
    self._scale.update({**batch, 'reading': batch['reading'] - origin})
    scale = np.float32(self._scale.value)
    self.networks, metrics = _update(
        self._options,
        self._encoder,
        self.networks,
        {**batch, 'reading': batch['reading'] / scale, 'last': last / scale},
        self._draw_minibatches(),
    )
    return {**metrics, 'feedback_scale': self._scale.value}

  def _memory(self) -> dict[str, Any]:
    before = {'before': self._before} if self._options.query_delay else {}
    return {**super()._memory(), **before}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    super()._set_memory(memory)
    self._before = memory.get('before')


@base.LEARNERS.add('value_advice')
@final
class ValueAdvice(_ApprovalLearner):
  """Coupled approval: queries the action that it takes."""

  OPTIONS = ValueAdviceOptions
  READS = 'advice'


@base.LEARNERS.add('decoupled_approval')
@final
class DecoupledApproval(_ApprovalLearner):
  """Decoupled approval: queries actions drawn independently of its own."""

  OPTIONS = DecoupledApprovalOptions
  READS = 'approval'


def _log_probs(
    agent: dict[str, Any], encoded: Any, exploration: Any
) -> jax.Array:
  """Returns the logarithm of each action's probability, `(..., actions)`."""
  if 'policy' in agent:
    log_probs = jax.nn.log_softmax(agent['policy'](encoded))
    if exploration is None:
      return log_probs
    uniform = jnp.log(exploration / log_probs.shape[-1])
    return jnp.logaddexp(log_probs + jnp.log1p(-exploration), uniform)
  values = agent['values'](encoded)
  num_actions = values.shape[-1]
  best = jax.nn.one_hot(jnp.argmax(values, axis=-1), num_actions)
  return jnp.log((1.0 - exploration) * best + exploration / num_actions)


@functools.partial(jax.jit, static_argnums=(0, 6))
def _choose(
    encoder: features.Encoder,
    agent: dict[str, Any],
    observation: features.Packed,
    exploration: jax.Array | None,
    act_key: jax.Array,
    query_keys: list[jax.Array],
    greedy: bool,
) -> dict[str, jax.Array]:
  encoded = encoder.encode(observation)
  log_probs = _log_probs(agent, encoded, exploration)
  action = networks.draw(act_key, log_probs)
  if greedy:
    action = jnp.argmax(log_probs, axis=-1)
  # A policy learns from its own actions, values from uniformly drawn ones.
  logits = log_probs if 'policy' in agent else jnp.zeros_like(log_probs)
  drawn = [networks.draw(key, logits) for key in query_keys]
  asked = jnp.stack(drawn or [action], axis=-1)
  if 'policy' in agent:
    # Learn as if the policy had drawn the action. The gradient for an action
    # that only the floor has drawn would vanish otherwise.
    log_probs = _log_probs(agent, encoded, None)
  log_prob = jnp.take_along_axis(log_probs, asked, axis=-1)
  return {'action': action, 'asked': asked, 'log_prob': log_prob}


@functools.partial(jax.jit, static_argnums=(0, 1))
def _update(
    options: ApprovalOptions,
    encoder: features.Encoder,
    trained: Any,
    batch: dict[str, Any],
    indices: jax.Array,
) -> tuple[Any, dict[str, jax.Array]]:
  """Updates the networks with the feedback on the queries of a batch."""
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
    # For paired queries the expected difference is 0, except for an offset.
    if len(options.queries) == 1 or options.follows_reading:
      data['advantage'] -= _expected(trained[0], data)
  return training.run_epochs(options, loss, trained, data, indices)


def _expected(agent: dict[str, Any], data: dict[str, Any]) -> jax.Array:
  """Returns the feedback expected for any action or query, `(...)`."""
  return agent['baseline'](data['encoded'])[..., 0] + _offset(agent, data)


def _offset(agent: dict[str, Any], data: dict[str, Any]) -> Any:
  """Returns the part of the last reading that is expected to persist."""
  return agent['following'] * data['last'] if 'following' in agent else 0.0


def _signs(asked: jax.Array) -> jax.Array:
  """Returns the sign of the feedback on each query, `(1,)` or `(2,)`."""
  return jnp.array([1.0, -1.0])[: asked.shape[-1]]


def policy_objective(
    log_probs: jax.Array,
    asked: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    clip: float,
    floor: float = 0.0,
) -> jax.Array:
  """Returns the objective of each sample, `(...)`.

  At the old policy, its gradient is that of log pi(asked) times the advantage.
  For a pair, it is that of (log pi(asked) - log pi(other)) / 2 times the
  difference.

  Args:
    log_probs: Logarithm of each action's probability, `(..., actions)`.
    asked: Queried actions, `(..., 1)`, or pairs of them, `(..., 2)`.
    old_log_prob: Logarithm of the probability of each queried action when it
      was drawn, with the shape of `asked`.
    advantage: Feedback minus the expected feedback, standardised, `(...)`.
    clip: Largest change of a probability ratio in one update.
    floor: Probability below which an action is not made less likely.
  """
  one_hot = jax.nn.one_hot(asked, log_probs.shape[-1])
  log_prob = jnp.sum(one_hot * log_probs[..., jnp.newaxis, :], axis=-1)
  signed = advantage[..., jnp.newaxis] * _signs(asked)
  if floor:
    is_rare = old_log_prob < jnp.log(floor)
    signed = jnp.where(is_rare, jnp.maximum(signed, 0.0), signed)
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
      options.floor,
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
  """Returns the squared error of the predicted feedback, and metrics."""
  values = agent['values'](data['encoded'])
  one_hot = jax.nn.one_hot(data['asked'], values.shape[-1])
  predicted = jnp.sum(one_hot * values[..., jnp.newaxis, :], axis=-1)
  predicted = jnp.sum(predicted * _signs(data['asked']), axis=-1)
  predicted += _offset(agent, data)
  error = predicted - data['feedback']
  loss = 0.5 * training.mean(error**2, data['weight'])
  return loss, {
      'value_loss': loss,
      'value': training.mean(jnp.max(values, axis=-1), data['weight']),
  }
