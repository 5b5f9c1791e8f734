"""MCVL: a gate that refuses readings which make behaviour worse.

"Modification-considering value learning" (arXiv 2606.28955), for a replay. A
model of readings and a value function are learned in a first phase, and kept.
Later transitions whose reading the model does not expect are held back, until
there are enough for a *trial*: two copies of the networks are trained, one with
these transitions and one without, and each acts in half of the worlds. If the
one with them earns less by what was kept, they are refused.

The trial is a part of training, because a learner cannot reset its worlds. Its
control steps and its gradient steps are the price of the gate.

A `Defence` gets a batch, and returns what to learn from it. A gate decides
about a transition much later, so its wrapper needs more of the learner: the
replay, in which held-back transitions become valid; gradient steps for copies
of the networks; the actions of a copy; and the networks themselves, which the
better copy replaces.
"""

from collections.abc import Mapping
import functools
from typing import Any, final

import jax
import numpy as np

from realab_suite import errors
from realab_suite.lab.agents import base
from realab_suite.lab.agents import defences
from realab_suite.lab.agents import features
from realab_suite.lab.agents import gate_settings
from realab_suite.lab.agents import networks
from realab_suite.lab.agents import q_learning

_COUNTED = (
    'trials',
    'unexpected',
    'refused',
    'accepted',
    'gradients',
    'trial_steps',
)
# Share of a minibatch that begins where readings were held back.
_INJECTED = 0.25


@final
class Gatekeeper(base.Wrapper):
  """Applies a gate to a learner, and keeps its state."""

  NAME = 'gate'

  def __init__(
      self, gate: gate_settings.Gate, learner: q_learning.QLearning
  ) -> None:
    """Makes a wrapper, or raises a `SpecError` if the gate does not fit."""
    _check_fit(gate, learner)
    self._gate, self._learner = gate, learner
    self._setting = setting = learner.setting
    learner.is_off_policy = False
    self._trusted = gate.trusted and gate.trusted.make(
        setting.controls,
        setting.num_envs,
        setting.encoder.names,
        'learner.gate',
    )
    self._state = _initial_state(learner)

  def treat(self, batch: dict[str, Any]) -> dict[str, Any]:
    """Returns the transitions of a step without what is unexpected.

    The entry `is_held` marks what is held back until a trial decides about it.
    """
    state, counts = self._state, self._state['counts']
    is_valid = batch['is_valid']
    if self._trusted is not None and not state['is_open']:
      is_valid = is_valid & self._trusted.acts
    values = self._values('model', batch['observation'])
    action = batch['choice']['action'][:, np.newaxis]
    predicted = np.take_along_axis(values, action, axis=1)[:, 0]
    error = np.abs(batch['reading'] - predicted)
    is_alarm = is_valid & ~(error <= self._gate.threshold) & state['is_open']
    state['changed'] = is_alarm.sum() / max(1, is_valid.sum())
    counts['unexpected'] += is_alarm.sum()
    # What follows in an episode says little without what was decided about.
    state['is_judged'] = state['is_judged'] & is_valid
    is_held = is_alarm & ~state['is_judged']
    if state['is_trying']:
      discount = self._setting.options.gamma ** int(state['num_tried'])
      earned = np.where(is_valid, discount * predicted, 0.0)
      state['scores'] = state['scores'] + earned
      state['num_tried'] += 1
      counts['trial_steps'] += len(is_valid)
    return {**batch, 'is_valid': is_valid & ~is_alarm, 'is_held': is_held}

  def holds(self, observation: features.Packed) -> bool:
    """Starts a trial or ends one, if it is due; returns True during one."""
    state, gate = self._state, self._gate
    if not state['is_trying']:
      if state['is_open'] and len(self._places()[0]) >= gate.alarms:
        self._start()
    elif state['num_tried'] >= gate.trial_steps:
      self._end(observation)
    return state['is_trying']

  def _start(self) -> None:
    """Trains two copies of the networks, and begins to try them out."""
    state, learner, gate = self._state, self._learner, self._gate
    trained = learner.networks
    state['convinced'] = self._trained(trained, gate.gradients, True)
    learner.networks = self._trained(trained, gate.gradients)
    state |= {'is_trying': True, 'num_tried': 0}
    state['scores'] = np.zeros(self._setting.num_envs)
    state['counts']['trials'] += 1

  def _end(self, observation: features.Packed) -> None:
    """Decides about what is held back, by what the copies have earned."""
    state, learner = self._state, self._learner
    later = self._values('values', observation).max(axis=-1)
    discount = self._setting.options.gamma**self._gate.trial_steps
    scores = state['scores'] + discount * later
    is_worse = not scores[1::2].mean() >= scores[::2].mean()
    replay, decision = learner.replay, 'refused' if is_worse else 'accepted'
    state['counts'][decision] += replay['is_held'].sum()
    replay['is_valid'] |= replay['is_held'] & (not is_worse)
    replay['is_held'][:] = state['is_trying'] = False
    state['is_judged'] = np.ones(self._setting.num_envs, bool)
    if not is_worse:
      learner.networks = state['convinced']

  def follow(self) -> None:
    """Updates the model until the gate opens, and copies the values."""
    state, learner = self._state, self._learner
    if not state['is_open']:
      state |= {
          'model': self._trained(state['model'], 1, is_model=True),
          'values': learner.networks,
          'scale': learner.scale.value,
          'is_open': learner.num_steps >= self._gate.fit_steps,
      }

  def steer(
      self,
      choice: base.Choice,
      time_step: base.TimeStep,
      observation: features.Packed,
      key: np.ndarray,
  ) -> base.Choice:
    state = self._state
    if state['is_trying']:
      learner, trained = self._learner, state['convinced']
      rate = learner.exploration
      trial_action = learner.action_of(trained, observation, rate, key)
      action = choice['action'].copy()
      action[1::2] = trial_action[1::2]
      return {**choice, 'action': action}
    if self._trusted is not None and not state['is_open']:
      return self._trusted.steer(choice, time_step, key)
    return choice

  def _places(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns slots and worlds of what is held back, if returns are known."""
    is_held = self._learner.replay['is_held']
    slots, worlds = np.nonzero(is_held)
    ages = (self._learner.num_stored - 1 - slots) % len(is_held)
    is_known = ages >= self._setting.options.num_returns
    return slots[is_known], worlds[is_known]

  def _trained(
      self,
      trained: Any,
      num_gradients: int,
      believes: bool = False,
      is_model: bool = False,
  ) -> Any:
    """Returns networks after about as many gradient steps.

    With `believes`, they learn what is held back, and see more of it. A model
    learns single readings, and does not see readings.
    """
    learner, options = self._learner, self._setting.options
    replay, places = learner.replay, None
    each = options.gradients_per_update
    if believes:
      is_valid = replay['is_valid'] | replay['is_held']
      replay, places = {**replay, 'is_valid': is_valid}, self._places()
    if is_model:
      blind = defences.blinded(replay['observation'], self._setting)
      replay = {**replay, 'observation': blind}
      options = options.model_copy(update={'gamma': 0.0})
    key = learner.key('update', learner.num_steps // self._setting.num_envs)
    for i in range(-(-num_gradients // each)):
      generator = base.generator_of(base.folded(key, i))
      begin = q_learning.draw(options, replay, learner.num_stored, generator)
      if places is not None:
        _inject(begin, places, generator)
      samples = q_learning.samples_at(options, replay, *begin)
      trained, _ = learner.updated(trained, samples)
      self._state['counts']['gradients'] += each
    return trained

  def _values(self, kept: str, observation: features.Packed) -> np.ndarray:
    """Returns values of all actions, of networks to which readings are hidden.

    The networks are what was kept as `model` or as `values`.
    """
    network = self._state[kept][0][0]
    blind = defences.blinded(observation, self._setting)
    values = _values(self._setting.encoder, network, blind)
    return np.float32(self._state['scale']) * np.asarray(values)

  @property
  def metrics(self) -> Mapping[str, float]:
    """Metrics by name; `changed` is the share of unexpected readings."""
    state = self._state
    return {
        'changed': float(state['changed']),
        'gate_is_open': float(state['is_open']),
        **{f'gate_{name}': float(n) for name, n in state['counts'].items()},
    }

  def state(self) -> dict[str, Any]:
    trusted = self._trusted and self._trusted.state()
    return {'gate': base.to_plain(self._state), 'trusted': trusted}

  def set_state(self, state: Mapping[str, Any]) -> None:
    self._state = base.from_plain(self._state, state['gate'])
    if self._trusted is not None:
      self._trusted.set_state(state['trusted'])


def _inject(
    begin: tuple[np.ndarray, np.ndarray],
    places: tuple[np.ndarray, np.ndarray],
    generator: np.random.Generator,
) -> None:
  """Lets a share of each minibatch begin at some of the places."""
  num_gradients, minibatch = begin[0].shape
  size = num_gradients, max(1, int(_INJECTED * minibatch))
  indices = generator.integers(len(places[0]), size=size)
  for one, place in zip(begin, places, strict=True):
    one[:, : size[1]] = place[indices]


def _check_fit(gate: gate_settings.Gate, learner: q_learning.QLearning) -> None:
  """Refuses a gate that could never open, or never hold a trial."""
  options, num_envs = learner.setting.options, learner.setting.num_envs
  if num_envs < 2:
    raise errors.SpecError(
        'learner.gate: in 1 world; must be in more, because a trial'
        ' compares two halves of them'
    )
  if gate.fit_steps <= options.min_replay:
    raise errors.SpecError(
        f'learner.gate.fit_steps: {gate.fit_steps}; must be more than'
        f' min_replay, {options.min_replay}, before which nothing is fitted'
    )
  most = (learner.num_slots - options.num_returns) * num_envs
  if gate.alarms > most:
    raise errors.SpecError(
        f'learner.gate.alarms: {gate.alarms}; must be at most {most},'
        ' the transitions of the replay whose returns are known'
    )


def _initial_state(learner: q_learning.QLearning) -> dict[str, Any]:
  """Returns the state of a gate before the first step."""
  num_envs = learner.setting.num_envs
  return {
      # The model has the discount 0. `convinced` acts in every second world.
      **dict.fromkeys(('model', 'values', 'convinced'), learner.networks),
      'scale': 1.0,
      'is_open': False,
      'is_trying': False,
      'num_tried': 0,
      'scores': np.zeros(num_envs),
      'is_judged': np.zeros(num_envs, bool),
      'changed': 0.0,
      'counts': dict.fromkeys(_COUNTED, 0),
  }


@functools.partial(jax.jit, static_argnums=0)
def _values(
    encoder: features.Encoder,
    network: networks.Network,
    observation: features.Packed,
) -> jax.Array:
  """Returns the value of each discrete action, `(worlds, actions)`."""
  return network(encoder.encode(observation))
