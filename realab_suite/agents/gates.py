"""MCVL: a gate that refuses readings which make behaviour worse.

"Modification-considering value learning" (arXiv 2606.28955), for a replay. A
model of readings and a value function are learned in a first phase, and kept.
Later transitions whose reading the model does not expect are held back, until
there are enough for a *trial*: two copies of the networks are trained, one with
these transitions and one without, and each acts in half of the worlds. If the
one with them earns less by what was kept, they are refused.

The trial is a part of training, because a learner cannot reset its worlds. Its
control steps and its gradient steps are the price of the gate.
"""

from collections.abc import Callable
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite.agents import defences
from realab_suite.agents import networks
from realab_suite.agents import trusted_policies
from realab_suite.config import validation

_Positive = Annotated[int, pydantic.Field(ge=1, le=10**9)]
_COUNTED = (
    'trials', 'unexpected', 'refused', 'accepted', 'gradients', 'trial_steps',
)  # fmt: skip


@final
class Gate(validation.Model):
  """Holds back unexpected readings, and decides about them in trials.

  It keeps no state, but changes the one that `initial_state` returned.

  Attributes:
    threshold: Largest difference between a reading and its prediction that is
      expected, in units of the register.
    fit_steps: Control steps of all worlds until the model is kept and the gate
      opens. What is read until then is believed.
    trusted: A policy from whose steps alone is learned until then; `None` for
      the learner's own.
    alarms: Number of unexpected readings that start a trial.
    gradients: Number of gradient steps of each copy, about.
    injected: Share of a minibatch that begins with them.
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
  def _without_cloning(self) -> 'Gate':
    if self.trusted is not None and self.trusted.clone_steps:
      raise ValueError(
          f'trusted.clone_steps: {self.trusted.clone_steps}; allowed is 0,'
          ' because a learner of values clones no policy'
      )
    return self

  def initial_state(self, trained: Any, num_envs: int) -> dict[str, Any]:
    """Returns the state of a gate for untrained networks, a pytree."""
    return {
        # The model has the discount 0. `convinced` acts in every second world.
        **dict.fromkeys(('model', 'values', 'convinced'), trained),
        'scale': 1.0, 'is_open': False, 'is_trying': False, 'num_tried': 0,
        'scores': np.zeros(num_envs), 'is_judged': np.zeros(num_envs, bool),
        'changed': 0.0, 'counts': dict.fromkeys(_COUNTED, 0),
    }  # fmt: skip

  def sift(
      self, transition: dict[str, Any], setting: defences.Setting, state: Any
  ) -> dict[str, Any]:
    """Returns a transition without what is unexpected.

    Its entry `is_held` marks what is held back until a trial decides about it.
    """
    is_valid, counts = transition['is_valid'], state['counts']
    values = _values('model', transition['observation'], setting, state)
    action = transition['choice']['action'][:, np.newaxis]
    predicted = np.take_along_axis(values, action, axis=1)[:, 0]
    error = np.abs(transition['reading'] - predicted)
    is_alarm = is_valid & ~(error <= self.threshold) & state['is_open']
    state['changed'] = is_alarm.sum() / max(1, is_valid.sum())
    counts['unexpected'] += is_alarm.sum()
    # What follows in an episode says little without what was decided about.
    state['is_judged'] = state['is_judged'] & is_valid
    is_held = is_alarm & ~state['is_judged']
    if state['is_trying']:
      earned = setting.options.gamma ** int(state['num_tried']) * predicted
      state['scores'] = state['scores'] + np.where(is_valid, earned, 0.0)
      state['num_tried'] += 1
      counts['trial_steps'] += len(is_valid)
    return {**transition, 'is_valid': is_valid & ~is_alarm, 'is_held': is_held}

  def decide(
      self,
      trained: Any,
      replay: Any,
      num_held: int,
      observation: Any,
      setting: defences.Setting,
      state: dict[str, Any],
      train: Callable[..., Any],
  ) -> Any:
    """Starts a trial or ends one, if it is due; returns the networks then.

    Args:
      trained: Networks of the learner.
      replay: Its transitions; what is accepted becomes valid.
      num_held: Number of those held back whose returns are known.
      observation: Packed observation after them.
      setting: The learner.
      state: State, which changes.
      train: Trains networks for a number of gradient steps.
    """
    if not state['is_trying']:
      if num_held >= self.alarms:
        state['convinced'] = train(trained, self.gradients, self.injected)
        trained = train(trained, self.gradients)
        state |= {'is_trying': True, 'num_tried': 0}
        state['scores'] = np.zeros(setting.num_envs)
        state['counts']['trials'] += 1
      return trained
    if state['num_tried'] < self.trial_steps:
      return trained
    later = _values('values', observation, setting, state).max(axis=-1)
    scores = state['scores'] + setting.options.gamma**self.trial_steps * later
    is_worse = not scores[1::2].mean() >= scores[::2].mean()
    decision = 'refused' if is_worse else 'accepted'
    state['counts'][decision] += replay['is_held'].sum()
    replay['is_valid'] |= replay['is_held'] & (not is_worse)
    replay['is_held'][:] = state['is_trying'] = False
    state['is_judged'] = np.ones(setting.num_envs, bool)
    return trained if is_worse else state['convinced']


def _values(
    kept: str, observation: Any, setting: defences.Setting, state: Any
) -> np.ndarray:
  """Returns values of all actions, of networks to which readings are hidden."""
  blind = defences.blinded(observation, setting)
  values = networks.values(setting.encoder, state[kept][0][0], blind)
  return np.float32(state['scale']) * np.asarray(values)
