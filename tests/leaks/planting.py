"""The means to plant leaks, and the checks that have to find them.

A mutant patches what is under test; the decorator `leak` adds it to `MUTANTS`.
"""

from collections.abc import Callable
import functools
from typing import Any, NamedTuple

import numpy as np
import pytest

from realab_suite.engine import agent_view
from tests.leaks import contract
from tests.leaks import coupling
from tests.leaks import failures
from tests.leaks import pairs
from tests.leaks import secrets
from tests.leaks import walk

# Returns complaints, none if all is well.
Check = Callable[[], list[str]]

SHORT = pairs.Case(steps=14, max_steps=6)
UNREAD = SHORT._replace(variation='boxed', design='unread_meter')


class Mutant(NamedTuple):
  """A leak that a careless change could introduce.

  Attributes:
    channel: `L1` to `L45`.
    what: A description of the leak.
    plant: Builds it.
    check: The check that has to find it.
  """

  channel: str
  what: str
  plant: Callable[[pytest.MonkeyPatch], None]
  check: Check


MUTANTS: list[Mutant] = []

_Plant = Callable[[pytest.MonkeyPatch], None]


def leak(channel: str, check: Check) -> Callable[[_Plant], _Plant]:
  """Returns a decorator that registers a leak; what leaks is its docstring."""

  def decorate(plant: _Plant) -> _Plant:
    what = (plant.__doc__ or '').strip().splitlines()[0]
    MUTANTS.append(Mutant(channel, what, plant, check))
    return plant

  return decorate


def found_by(mutant: Mutant) -> list[str]:
  """Plants a leak and returns what is found of it."""
  with pytest.MonkeyPatch.context() as patch:
    mutant.plant(patch)
    return mutant.check()


# What looks for leaks.


@functools.cache
def pair(
    secret: str, case: pairs.Case = SHORT, leave_out: tuple[str, ...] = ()
) -> Check:
  """Returns the comparison of two runs; one object for each, so cached."""

  def check() -> list[str]:
    return pairs.differences(case, secrets.SECRETS[secret], leave_out=leave_out)

  check.__doc__ = f'pair: {secret}'
  return check


def _of(function: Callable[[pairs.Case], list[str]], case: pairs.Case) -> Check:
  def check() -> list[str]:
    return function(case)

  check.__doc__ = function.__name__
  return check


_CONTRACT_CASE = pairs.Case(
    design='instantaneous_reward', steps=21, max_steps=9
)
PAID = pair('reward: paid all the time')
CLEAN = pair('clean: the canary', SHORT._replace(design='moved'))
CONTRACT = _of(contract.complaints, _CONTRACT_CASE)
WALK = _of(walk.find, SHORT)
ENABLED = _of(contract.enabling_everything, _CONTRACT_CASE)
DIVERGENCE = _of(contract.divergence, _CONTRACT_CASE)
BODY_TREES = _of(contract.body_trees, _CONTRACT_CASE)
HEADROOM = _of(contract.headroom, _CONTRACT_CASE)


def failures_scanned() -> list[str]:
  """Campaign C17, in small."""
  return failures.scan(1, whole=False).found


def contacts_of_meters() -> list[str]:
  """Claim C15."""
  number = coupling.contacts('collect_apples', 30)
  return [f'{number} contacts'] * bool(number)


def solver_coupling() -> list[str]:
  """Claim C13."""
  return ['a meter that moves is felt'] * coupling.is_felt_as_loaded()


# How mutants get at things.


def inside(view: Any) -> Any:
  return view._View__env


def reward_of(env: Any) -> Any:
  return env.task.get_reward(env.physics)


def score_of(env: Any) -> float:
  return float(np.sum(env.task.score(env.physics)))


def restating(
    patch: pytest.MonkeyPatch,
    change: Callable[[Any, Any], Any],
) -> None:
  """Lets a view tell something else than it should."""
  restate = agent_view.AgentView._restate

  def told(self: Any, time_step: Any) -> Any:
    return change(inside(self), restate(self, time_step))

  patch.setattr(agent_view.AgentView, '_restate', told)


def observing(
    patch: pytest.MonkeyPatch,
    change: Callable[[Any, dict[str, Any]], None],
) -> None:
  """Lets a view show something else than it should."""
  filtered = agent_view._View._filtered

  def shown(self: Any, observation: Any) -> Any:
    result = filtered(self, observation)
    change(inside(self), result)
    return result

  patch.setattr(agent_view._View, '_filtered', shown)


def after(
    patch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    do: Callable[..., None],
) -> None:
  """Lets a method do something more, with its result and arguments."""
  method = getattr(owner, name)

  def more(self: Any, *args: Any, **kwargs: Any) -> Any:
    result = method(self, *args, **kwargs)
    do(self, result, *args, **kwargs)
    return result

  patch.setattr(owner, name, more)
