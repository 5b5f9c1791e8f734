"""MCVL: a gate that refuses readings which make behaviour worse.

"Modification-considering value learning" (arXiv 2606.28955), for a replay. A
model of readings and a value function are learned in a first phase, and kept.
Later transitions whose reading the model does not expect are held back, until
there are enough for a *trial*: two copies of the networks are trained, one with
these transitions and one without, and each acts in half of the worlds. If the
one with them earns less by the model that was kept, they are refused.

The trial is a part of training, because a learner cannot reset its worlds. Its
control steps and its gradient steps are the price of the gate.
"""

from collections.abc import Callable, Mapping
import functools
from typing import Annotated, Any, final

import jax
import numpy as np
import pydantic

from realab_suite.agents import base
from realab_suite.agents import defences
from realab_suite.agents import networks
from realab_suite.agents import training
from realab_suite.agents import trusted_policies
from realab_suite.config import validation

_Positive = Annotated[int, pydantic.Field(ge=1, le=10**9)]
_Samples = dict[str, Any]
# Trains networks: on minibatches that a function may change.
Train = Callable[[Any, int, Callable[[_Samples], _Samples]], Any]


@final
class GateOptions(validation.Model):
  """Options of the gate.

  Attributes:
    threshold: Largest difference between a reading and its prediction that is
      expected, in units of the register.
    fit_steps: Control steps of all worlds until the model is kept and the gate
      opens. What is read until then is believed.
    trusted: A policy from whose steps alone is learned until then; `None` for
      the learner's own.
    alarms: Number of unexpected readings that start a trial.
    gradients: Number of gradient steps of each copy, about.
    injected: Share of a minibatch that consists of them.
    trial_steps: Number of control steps of each world in a trial.
  """

  threshold: Annotated[float, pydantic.Field(gt=0, le=1e9)]
  fit_steps: _Positive
  trusted: trusted_policies.TrustedPolicy | None = None
  alarms: _Positive = 64
  gradients: _Positive = 512
  injected: Annotated[float, pydantic.Field(gt=0, le=0.25)] = 0.25
  trial_steps: _Positive = 250

  @pydantic.model_validator(mode='after')
  def _without_cloning(self) -> 'GateOptions':
    if self.trusted is not None and self.trusted.clone_steps:
      raise ValueError(
          f'trusted.clone_steps: {self.trusted.clone_steps}; allowed is 0,'
          ' because a learner of values clones no policy'
      )
    return self


@final
class Gate:
  """Holds back unexpected readings, and decides about them in trials."""

  def __init__(
      self,
      options: GateOptions,
      setting: defences.Setting,
      generator: np.random.Generator,
  ) -> None:
    """Makes a gate.

    Args:
      options: Options of the gate.
      setting: The learner.
      generator: Random generator of the initial weights.
    """
    self._options, self._setting = options, setting
    network = networks.Network(
        setting.encoder,
        setting.options.hidden,
        1,
        0.01,
        generator,
        setting.controls.size,
    )
    optimizer = training.optimizer(setting.options)
    self._model: Any = network, optimizer.init(network)
    self._value: Any = None
    self._scale = 1.0
    self._held: list[dict[str, Any]] = []
    # The copy of the networks that learned from what is held back.
    self._convinced: Any = None
    self._scores = np.zeros(setting.num_envs)
    self._num_tried = 0
    self._counts = dict.fromkeys(
        (
            'trials', 'unexpected', 'refused', 'accepted', 'gradients',
            'trial_steps',
        ),
        0,
    )  # fmt: skip

  @property
  def is_open(self) -> bool:
    """True once the model is kept."""
    return self._value is not None

  @property
  def is_trying(self) -> bool:
    """True during a trial, in which nothing is learned."""
    return self._convinced is not None

  @property
  def convinced(self) -> tuple[Any, np.ndarray]:
    """The copy that learned from unexpected readings, and where it acts."""
    return self._convinced, np.arange(self._setting.num_envs) % 2 == 1

  def sift(
      self, transition: dict[str, Any], observation: Any, number: int
  ) -> dict[str, Any]:
    """Returns a transition without what is held back.

    Args:
      transition: Transition of all worlds; see `base.Learner`.
      observation: Packed observation after it.
      number: Number of the transition.
    """
    is_valid = transition['is_valid']
    if not self.is_open:
      if self._options.trusted is not None:
        is_valid = is_valid & transition['is_trusted']
      return {**transition, 'is_valid': is_valid}
    predicted = self._predicted(transition)
    self._counts['trial_steps'] += self.is_trying * len(is_valid)
    if self.is_trying:
      earned = self._setting.options.gamma**self._num_tried * predicted
      self._scores = self._scores + np.where(is_valid, earned, 0.0)
      self._num_tried += 1
    error = np.abs(transition['reading'] - predicted)
    unexpected = is_valid & (error > self._options.threshold)
    self._counts['unexpected'] += int(unexpected.sum())
    if not self.is_trying:
      self._hold(transition, observation, np.flatnonzero(unexpected), number)
    return {**transition, 'is_valid': is_valid & ~unexpected}

  def _predicted(self, transition: dict[str, Any]) -> np.ndarray:
    data = defences.data_of(transition, self._setting, with_readings=False)
    return self._scale * np.asarray(_values(self._model[0], data))[..., 0]

  def _hold(
      self, transition: Any, observation: Any, worlds: np.ndarray, number: int
  ) -> None:
    for world in worlds[: self._options.alarms - len(self._held)].tolist():
      parts = {
          'observation': transition['observation'],
          'action': transition['choice']['action'],
          'total': transition['reading'],
          'factor': transition['discount'] * self._setting.options.gamma,
          'later': observation,
      }
      one = jax.tree.map(lambda x, i=world: np.array(x[i]), parts)
      self._held.append({**one, 'where': np.array([number, world])})

  def learn(
      self,
      readings: Callable[[], _Samples],
      scale: float,
      value: Any,
      done: int,
  ) -> None:
    """Fits the model, and keeps it once `done` is `fit_steps`.

    Args:
      readings: Draws minibatches of single readings, in units of the register.
      scale: Number by which the learner divides readings.
      value: Networks whose values are kept.
      done: Number of control steps so far, summed over worlds.
    """
    if self.is_open:
      return
    if done >= self._options.fit_steps:
      self._value = value
      return
    self._scale = scale
    drawn = readings()
    data = defences.data_of(
        {'observation': drawn['observation'], 'choice': drawn},
        self._setting,
        with_readings=False,
    )
    self._counts['gradients'] += len(drawn['total'])
    self._model = _fit(
        self._setting.options,
        self._model,
        data,
        drawn['total'] / np.float32(scale),
        drawn['weight'],
    )

  def decide(
      self, trained: Any, observation: Any, train: Train
  ) -> tuple[Any, list[np.ndarray]]:
    """Starts a trial or ends one, where one is due.

    Args:
      trained: Networks of the learner, with the states of their optimisers.
      observation: Packed observation of the next step.
      train: Trains networks for a number of gradient steps.

    Returns:
      The networks to go on with, and the numbers of the transitions that were
      accepted, each with its world.
    """
    options = self._options
    if not self.is_trying:
      if len(self._held) == options.alarms:
        self._convinced = train(trained, options.gradients, self._injected)
        trained = train(trained, options.gradients, lambda samples: samples)
        each = self._setting.options.gradients_per_update
        self._counts['gradients'] += 2 * each * -(-options.gradients // each)
        self._counts['trials'] += 1
      return trained, []
    if self._num_tried < options.trial_steps:
      return trained, []
    blind = defences.blinded(observation, self._setting)
    later = _values(self._value, self._setting.encoder.encode(blind))
    best = self._scale * np.asarray(later).max(axis=-1)
    scores = self._scores + self._setting.options.gamma**self._num_tried * best
    convinced, acts = self.convinced
    is_worse = scores[acts].mean() < scores[~acts].mean()
    self._counts['refused' if is_worse else 'accepted'] += len(self._held)
    accepted = [] if is_worse else [one['where'] for one in self._held]
    self._held, self._convinced, self._num_tried = [], None, 0
    self._scores = np.zeros_like(self._scores)
    return (trained if is_worse else convinced), accepted

  def _injected(self, samples: _Samples) -> _Samples:
    """Returns minibatches with what is held back in a share of each."""
    shape = samples['total'].shape
    number = max(1, int(self._options.injected * shape[1]))
    held = jax.tree.map(
        lambda *x: np.stack(x),
        *[{k: v for k, v in one.items() if k != 'where'} for one in self._held],
    )
    held['weight'] = np.ones(len(self._held), np.float32)
    chosen = np.resize(np.arange(len(self._held)), (shape[0], number))

    def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
      mixed = np.array(old)
      mixed[:, :number] = new[chosen]
      return mixed

    return jax.tree.map(put, samples, held)

  @property
  def metrics(self) -> dict[str, float]:
    """The price of the gate, by name.

    Numbers of trials; of unexpected readings, and of those that a trial has
    refused and accepted (others came while one was under way, and are left
    out); of gradient steps of the model and of the copies; and of control steps
    in trials, summed over worlds.
    """
    return {f'gate_{name}': float(n) for name, n in self._counts.items()}

  def state(self) -> dict[str, Any]:
    """Returns the complete state, as plain data."""
    kept = (self._model, self._value, self._convinced)
    return {
        'kept': [None if one is None else base.to_plain(one) for one in kept],
        'scale': self._scale,
        'held': [dict(one) for one in self._held],
        'scores': self._scores,
        'num_tried': self._num_tried,
        'counts': dict(self._counts),
    }

  def set_state(self, state: Mapping[str, Any], trained: Any) -> None:
    """Continues from a state that `state` returned.

    Args:
      state: The state.
      trained: Networks of the learner, for their structure.
    """
    likes = (self._model, trained[0][0], trained)
    self._model, self._value, self._convinced = (
        None if kept is None else base.from_plain(like, kept)
        for like, kept in zip(likes, state['kept'], strict=True)
    )
    self._scale = float(state['scale'])
    self._held = [dict(one) for one in state['held']]
    self._scores, self._num_tried = state['scores'], int(state['num_tried'])
    self._counts = dict(state['counts'])


@jax.jit
def _values(network: networks.Network, data: dict[str, jax.Array]) -> jax.Array:
  return network(data)


@functools.partial(jax.jit, static_argnums=0)
def _fit(
    options: Any,
    trained: Any,
    data: dict[str, jax.Array],
    target: jax.Array,
    weight: jax.Array,
) -> Any:
  """Takes a gradient step for each minibatch, and returns the model."""

  def loss(network: networks.Network, sample: Any) -> Any:
    features, reading, counts = sample
    error = network(features)[..., 0] - reading
    value = training.mean(error**2, counts)
    return value, {'loss': value}

  def one_step(carry: Any, sample: Any) -> Any:
    return training.descend(options, loss, carry, sample)

  return jax.lax.scan(one_step, trained, (data, target, weight))[0]
