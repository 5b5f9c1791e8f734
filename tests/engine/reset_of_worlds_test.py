"""Resets of single worlds of a batch, and new seeds for loaded worlds."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.evaluation import ledgers

_NUM_ENVS = 3
_MAX_STEPS = 8
_NUM_STEPS = 20
# World 1 is reset in mid-episode and, later, after its end; world 2 with 0.
_RESETS = {3: [1], 11: [1, 2], 14: [2, 0]}


def _load(seed: Any = 1, **kwargs: Any) -> Any:
  return suite.load_batch(
      'unlock_door', 'near', {'random': seed}, {'max_steps': _MAX_STEPS},
      num_envs=_NUM_ENVS, design='instantaneous_reward', **kwargs,
  )  # fmt: skip


def _single(world: int, seed: Any = 1) -> Any:
  return suite.load(
      'unlock_door', 'near', {'random': seed},
      {'max_steps': _MAX_STEPS, 'world': world},
      design='instantaneous_reward',
  )  # fmt: skip


def _actions(seed: int = 3) -> np.ndarray:
  shape = (_NUM_STEPS, _NUM_ENVS, 6)
  return np.random.default_rng(seed).uniform(-1, 1, shape)


def _row(time_step: Any, row: int) -> tuple[Any, ...]:
  observation = {k: v[row].tobytes() for k, v in time_step.observation.items()}
  return int(time_step.step_type[row]), observation


def _alone(time_step: Any) -> tuple[Any, ...]:
  observation = {k: v.tobytes() for k, v in time_step.observation.items()}
  return int(time_step.step_type), observation


def _summary(episode: Any) -> tuple[Any, ...]:
  return (
      episode.seed, episode.world, episode.episode, episode.end,
      episode.true_rewards, repr(episode.entries),
  )  # fmt: skip


def test_worlds_that_are_reset_equal_single_worlds_and_so_do_the_others():
  batch, envs = _load(), [_single(world) for world in range(_NUM_ENVS)]
  batch_ledger, ledgers_alone = ledgers.BatchLedger(), []
  batch.add_sink(batch_ledger)
  for env in envs:
    ledgers_alone.append(ledgers.Ledger())
    env.add_sink(ledgers_alone[-1])
  time_step = batch.reset()
  expected = [env.reset() for env in envs]
  for i, actions in enumerate(_actions()):
    for world in range(_NUM_ENVS):
      assert _row(time_step, world) == _alone(expected[world]), (i, world)
    if i in _RESETS:
      first = batch.reset(_RESETS[i])
      assert first.first().all()
      for row, world in enumerate(_RESETS[i]):
        assert _row(first, row) == _alone(envs[world].reset()), (i, world)
    time_step = batch.step(actions)
    expected = [env.step(actions[w]) for w, env in enumerate(envs)]
  for world, ledger in enumerate(ledgers_alone):
    found = [_summary(one) for one in batch_ledger.episodes(world)]
    assert found == [_summary(one) for one in ledger.episodes]


def test_worlds_that_do_not_exist_are_refused():
  batch = _load()
  message = 'must be integers from 0 to'
  for worlds in ([3], [0, 0], [], 1):
    with pytest.raises(errors.SpecError, match=message):
      batch.reset(worlds)
    with pytest.raises(errors.SpecError, match=message):
      agent_view.BatchAgentView(batch).reset(worlds)


def test_an_error_in_a_reset_ends_all_episodes(monkeypatch):
  batch = _load()
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  batch.reset()

  def fail(*unused: Any) -> None:
    raise RuntimeError('no start')

  with monkeypatch.context() as context:
    context.setattr(type(batch.task), 'initialize_episode', fail)
    with pytest.raises(RuntimeError, match='no start'):
      batch.reset([1])
  ends = [ledger.episodes(w)[0].end.value for w in range(_NUM_ENVS)]
  assert ends == ['error', 'abandoned', 'error']
  assert batch.step(_actions()[0]).first().all()


@pytest.mark.parametrize('load', [_load, lambda seed: _single(0, seed)])
def test_a_new_seed_begins_the_episodes_of_a_world_loaded_with_it(load):
  env, new = load(1), load(5)
  env.reset()
  env.step(_actions()[0] if load is _load else _actions()[0, 0])
  env.rewind(random=5)
  for _ in range(2):
    found, expected = env.reset(), new.reset()
    for key, value in expected.observation.items():
      assert found.observation[key].tobytes() == value.tobytes(), key


def test_worlds_of_a_batch_may_have_seeds_of_their_own():
  batch = _load()
  batch.rewind([4, 5, 6])
  time_step = batch.reset()
  for world in range(_NUM_ENVS):
    assert _row(time_step, world) == _alone(_single(world, 4 + world).reset())
  batch.rewind()
  again = batch.reset()
  assert _row(again, 1) == _row(time_step, 1)


def test_other_seeds_are_refused():
  batch = _load()
  for random in (-1, [1, 2], [1, 2, 'x'], 'seed'):
    with pytest.raises(errors.SpecError, match='random'):
      batch.rewind(random)
