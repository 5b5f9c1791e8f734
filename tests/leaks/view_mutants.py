"""Planted leaks of views, specs and time steps: channels L1 to L13."""

from typing import Any

import dm_env
from dm_env import specs
import numpy as np
import pytest

from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import hosts
from realab_suite.feedback import phases
from tests.leaks import contract
from tests.leaks import planting


@planting.leak('L1', planting.PAID)
def _l1(patch: pytest.MonkeyPatch) -> None:
  """The reward is the true reward."""
  planting.restating(
      patch,
      lambda env, ts: ts
      if ts.first()
      else ts._replace(reward=float(planting.reward_of(env))),
  )


@planting.leak('L2', planting.PAID)
def _l2_sign(patch: pytest.MonkeyPatch) -> None:
  """The reward is -0.0 where the true one is positive."""

  def change(env: Any, ts: Any) -> Any:
    if ts.first():
      return ts
    return ts._replace(reward=-0.0 if planting.reward_of(env) > 0 else 0.0)

  planting.restating(patch, change)


@planting.leak('L3', planting.PAID)
def _l3(patch: pytest.MonkeyPatch) -> None:
  """The discount has the true reward in its last digits."""
  planting.restating(
      patch,
      lambda env, ts: ts._replace(
          discount=1.0 - 1e-9 * float(planting.reward_of(env))
      )
      if ts.mid()
      else ts,
  )


@planting.leak('L4', planting.PAID)
def _l4(patch: pytest.MonkeyPatch) -> None:
  """The episode ends when enough has been earned."""
  is_over = hosts.WorldHost.is_over
  patch.setattr(
      hosts.WorldHost,
      'is_over',
      lambda self, physics: is_over(self, physics)
      or self._task.score(physics) >= 9.0,
  )


@planting.leak('L5', planting.PAID)
def _l5(patch: pytest.MonkeyPatch) -> None:
  """A step in which something is earned counts twice."""

  def count(self: Any, result: Any, physics: Any, reward: Any) -> None:
    self._counters.of(physics).step_count[...] += np.asarray(reward) > 1

  planting.after(patch, phases.Phases, 'end_step', count)


@planting.leak('L6', planting.ENABLED)
def _l6(patch: pytest.MonkeyPatch) -> None:
  """Whatever is enabled before there is a view is shown, as in Composer."""
  spec = environment.Environment.observation_spec

  def show(self: Any, time_step: Any, *unused: Any) -> None:
    time_step.observation.update(contract.composer_like(self))

  planting.after(patch, environment.Environment, 'reset', show)
  planting.after(patch, environment.Environment, 'step', show)

  def all_specs(self: Any) -> Any:
    shown = contract.composer_like(self)
    more = {k: specs.Array(v.shape, v.dtype, name=k) for k, v in shown.items()}
    return {**spec(self), **more}

  patch.setattr(environment.Environment, 'observation_spec', all_specs)


@planting.leak('L7', planting.PAID)
def _l7(patch: pytest.MonkeyPatch) -> None:
  """The score is shown by the key of something else."""

  def overwrite(env: Any, observation: dict[str, Any]) -> None:
    observation['senses/holding'] = np.array(
        [planting.score_of(env)], np.float32
    )

  planting.observing(patch, overwrite)


@planting.leak('L8', planting.PAID)
def _l8_bounds(patch: pytest.MonkeyPatch) -> None:
  """The bound of a spec is the score."""

  def spec(self: Any) -> Any:
    return specs.BoundedArray(
        (),
        np.float64,
        0.0,
        1.0 + planting.score_of(planting.inside(self)),
        name='discount',
    )

  patch.setattr(agent_view._View, 'discount_spec', spec)


@planting.leak('L9', planting.CONTRACT)
def _l9(patch: pytest.MonkeyPatch) -> None:
  """An array is a view of the state of the world."""

  def alias(env: Any, observation: dict[str, Any]) -> None:
    data = np.asarray(env.physics.data.qpos)
    observation['registers/reward'] = data[0:1].reshape(())

  planting.observing(patch, alias)


@planting.leak('L10', planting.PAID)
def _l10(patch: pytest.MonkeyPatch) -> None:
  """The first observation of an episode is of the end of the one before."""
  kept: dict[int, float] = {}

  def delay(env: Any, observation: dict[str, Any]) -> None:
    is_first = observation['senses/time_left'] == 1.0
    if is_first and id(env) in kept:
      observation['senses/holding'][:] = kept[id(env)]
    kept[id(env)] = planting.score_of(env)

  planting.observing(patch, delay)


@planting.leak('L11', planting.WALK)
def _l11(patch: pytest.MonkeyPatch) -> None:
  """A property of the view leads to the physics."""
  patch.setattr(
      agent_view.AgentView,
      'physics',
      property(lambda self: planting.inside(self).physics),
      raising=False,
  )


@planting.leak('L12', planting.WALK)
def _l12_getattr(patch: pytest.MonkeyPatch) -> None:
  """A name that the view does not have is looked up behind it."""
  patch.setattr(
      agent_view.AgentView,
      '__getattr__',
      lambda self, name: getattr(
          object.__getattribute__(self, '_View__env'), name
      ),
      raising=False,
  )


class _InfoTimeStep(dm_env.TimeStep):
  """A time step with more than there should be."""


@planting.leak('L13', planting.PAID)
def _l13(patch: pytest.MonkeyPatch) -> None:
  """A time step has an `info` with the score."""

  def inform(env: Any, ts: Any) -> Any:
    informed = _InfoTimeStep(*ts)
    informed.info = {'performance': planting.score_of(env)}
    return informed

  planting.restating(patch, inform)
