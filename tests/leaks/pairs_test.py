"""Tests that the true reward is hidden: change it, and the agent cannot tell.

Two runs differ in the true reward alone. If no meter measures it, the agent
gets the same bytes, the process prints the same, and cameras draw the same.
"""

from collections.abc import Callable
import random
from typing import Any, NamedTuple

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.evaluation import ledgers
from tests.leaks import views

_STEPS = 70
_APPLES = 'collect_apples.standard'
_DESIGNS = views.UNPAID, 'online_imitation', 'decoupled_approval'
_CASES = [
    *((_APPLES, design, 0) for design in _DESIGNS),
    *((_APPLES, design, 2) for design in _DESIGNS),
    *(
        (f'{domain}.{tasks[0]}', views.UNPAID, 0)
        for domain, tasks in suite.TASKS_BY_DOMAIN.items()
        if domain != 'collect_apples'
    ),
]
# Parts of the model and of its state that cameras draw, of one world.
_DRAWN = 'geom_rgba', 'geom_size', 'site_group', 'site_rgba', 'light_pos'
_MOVING = 'qpos', 'qvel', 'mocap_pos'


class _Run(NamedTuple):
  """A run, as the agent gets it, and the true rewards of its first world."""

  agent: list[bytes]
  true_rewards: list[float]


def _pay_otherwise(env: Any) -> None:
  """The world takes what it pays, and pays for each step."""
  earn, get_reward = env.task.earn, env.task.get_reward
  env.task.earn = lambda physics, reward: earn(physics, -reward)
  env.task.get_reward = lambda physics: get_reward(physics) + views.CANARY


def _fail_to_pay(env: Any) -> None:
  def fail(physics: Any) -> None:
    raise ZeroDivisionError(f'the true return is {views.CANARY}')

  env.task.get_reward = fail


@pytest.fixture(name='play')
def fixture_play(capfd: Any, caplog: Any) -> Callable[..., _Run]:
  """Returns a function that plays an agent which asks for all that there is."""

  def play(world: str, design: Any, num_envs: int, change: Any = None) -> _Run:
    env = views.load(world, design, num_envs, max_steps=_STEPS - 10)
    if change:
      change(env)
    ledger: Any = ledgers.BatchLedger() if num_envs else ledgers.Ledger()
    env.add_sink(ledger)
    view = views.view_of(env)
    got = [dir(view), *views.specs_of(view)]
    for i, action in enumerate(views.walk(view, _STEPS, num_envs)):
      if i % 7 == 3:
        with pytest.raises(ValueError, match='action') as refused:
          view.step([np.nan, 'forwards', None][i % 3])
        got.append(refused.value)
      if i == _STEPS - 4:
        got.append(view.reset())
      got.append(view.step(action))
      if not num_envs:
        got += [np.array(getattr(env.physics.model, name)) for name in _DRAWN]
        got += [np.array(getattr(env.physics.data, name)) for name in _MOVING]
    got += views.specs_of(view)
    env.close()
    got += [*capfd.readouterr(), caplog.text]
    got += [random.getstate(), np.random.get_state()]  # noqa: NPY002
    episodes = ledger.episodes(0) if num_envs else ledger.episodes
    return _Run(
        [views.encode(part) for part in got],
        [reward for episode in episodes for reward in episode.true_rewards],
    )

  return play


def _differences(one: _Run, other: _Run) -> list[int]:
  """Returns the indices of what the agent gets in one run alone."""
  both = zip(one.agent, other.agent, strict=True)
  return [i for i, (part, other_part) in enumerate(both) if part != other_part]


@pytest.mark.parametrize(('world', 'design', 'num_envs'), _CASES)
def test_an_agent_cannot_tell_one_true_reward_from_another(
    world: str, design: Any, num_envs: int, play: Any
):
  plain = play(world, design, num_envs)
  if world == _APPLES:  # The walk earns something there.
    assert sum(plain.true_rewards) >= 2
  for change in (_pay_otherwise, _fail_to_pay):
    other = play(world, design, num_envs, change)
    assert _differences(plain, other) == []
    assert other.true_rewards != plain.true_rewards


@pytest.mark.parametrize('num_envs', [0, 2])
def test_with_meters_another_true_reward_is_visible(num_envs: int, play: Any):
  # The control: these comparisons can tell runs apart.
  case = _APPLES, 'instantaneous_reward', num_envs
  assert _differences(play(*case), play(*case, _pay_otherwise))
