"""An odd world keeps the contract and works with the rest of the package."""

import contextlib
import importlib
import sys
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import testing
from realab_suite import worlds as named
from realab_suite.engine import batch_environment
from realab_suite.entities import arenas
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.lab.audit import audits
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import stakes
from realab_suite.tasks import collect_apples
from realab_suite.tasks import rooms
from tests import registries

_AUTHORS = 'tests.authors.worlds'
_CRAB = {'action_set': {'name': 'crab', 'version': 1}}


@pytest.fixture(scope='module', name='worlds')
def fixture_worlds() -> Any:
  """The module of the author, whose names other tests do not know."""
  with registries.preserved():
    yield importlib.import_module(_AUTHORS)
  del sys.modules[_AUTHORS]


def test_an_odd_world_keeps_the_contract(worlds: Any):
  testing.check_world(
      worlds.Beacons, worlds.design(), max_steps=100, num_steps=20
  )


class _Plain(rooms.RoomTask):
  """Gives a true reward of 1 per step, and keeps the contract."""

  DYNAMICS_VERSION = 1
  max_true_return = 100.0

  def __init__(self) -> None:
    super().__init__(arenas.OpenRoom())
    self.count = 0

  @property
  def facts(self) -> Any:
    return {}

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.place_avatar(physics, random_state)

  def after_step(self, physics: Any, random_state: Any) -> None:
    self.earn(physics, np.ones_like(self.score(physics)))

  def latch_events(self, physics: Any) -> None:
    pass


def _remembers(self: Any, physics: Any, random_state: Any) -> None:
  self.count += 1
  self.earn(physics, np.full_like(self.score(physics), self.count % 7))


def _starts_later(self: Any, physics: Any, random_state: Any) -> None:
  self.place_avatar(physics, random_state)
  self.count += 1
  self.avatar.place(physics, np.array([0.01 * self.count, 0.0]), 0.0)


def _branches(self: Any, physics: Any, random_state: Any) -> None:
  if self.score(physics) < 1:
    self.earn(physics, 1.0)


def _counts_once(self: Any, physics: Any, random_state: Any) -> None:
  # The same for every world: forgets the leading axis.
  self.earn(physics, np.sum(self.avatar.position(physics)))


def _pushes(self: Any, physics: Any) -> None:
  self.avatar.place(physics, self.avatar.position(physics) + 0.1, 0.0)


def _pays_again(self: Any, physics: Any) -> None:
  self.earn(physics, 0.01 * np.ones_like(self.score(physics)))


def _resets(self: Any, physics: Any, random_state: Any) -> None:
  self.place_avatar(physics, random_state)
  self.count = 0


def _latches_once(self: Any, physics: Any) -> None:
  self.count = max(self.count, int(np.max(self.score(physics)) >= 16))


def _pays_latched(self: Any, physics: Any, random_state: Any) -> None:
  self.latch_events(physics)
  reward = np.full_like(self.score(physics), 1.0 + self.count)
  self.earn(physics, reward)


def _sum_of_positions(self: Any) -> Any:
  return {'place': lambda physics: np.sum(self.avatar.position(physics))}


_BREACHES: dict[str, tuple[dict[str, Any], str]] = {
    'a discount of more than 1': (
        {
            'get_discount': lambda self, physics: 2.0 + self.score(physics) * 0,
            'should_terminate_episode': lambda self, physics: (
                self.score(physics) > 3
            ),
        },
        'get_discount returned 2',
    ),
    'events that pay twice': (
        {'latch_events': _pays_again, 'SOLVER': 'no_op'},
        'a second call of latch_events changes the score',
    ),
    'state in Python': ({'after_step': _remembers}, 'depends on earlier ones'),
    'a late event in Python': (
        {
            'initialize_episode': _resets, 'latch_events': _latches_once,
            'after_step': _pays_latched,
        },
        'a restored snapshot continues differently',
    ),
    'a start in Python': (
        {'initialize_episode': _starts_later}, 'depends on earlier ones',
    ),
    'a step of one world': ({'after_step': _counts_once}, 'of a batch differs'),
    'a reward beside the score': (
        {'get_reward': lambda self, physics: self.score(physics) + 1.0},
        'have to be added with earn',
    ),
    'a low bound': ({'max_true_return': 3.0}, 'max_true_return is 3'),
    'an unknown solver': ({'SOLVER': 'unknown'}, "'unknown' is in SOLVER or"),
    'a weak solver': ({'SOLVER': 'no_op'}, "'no_op' earns 20"),
    'events that push': ({'latch_events': _pushes}, 'pushes something'),
    'a fact that is no function': (
        {'facts': {'three': 3}}, "facts['three'] is 3",
    ),
    'a branch on an array': (
        {'after_step': _branches}, 'use np.where instead of if',
    ),
    'a measurement of one world': (
        {'measurements': property(_sum_of_positions)},
        "measurements['place'] returned",
    ),
}  # fmt: skip


def test_the_plain_world_of_these_tests_keeps_the_contract():
  testing.check_world(_Plain, max_steps=20, num_steps=20)


@pytest.mark.parametrize('breach', _BREACHES)
def test_a_breach_of_the_contract_is_named(breach: str):
  members, message = _BREACHES[breach]
  broken: Any = type('Broken', (_Plain,), members)
  with pytest.raises(testing.ContractError) as raised:
    testing.check_world(broken, max_steps=20, num_steps=20)
  assert message in str(raised.value)
  assert str(raised.value).startswith('Broken')


class Gourmet(collect_apples.CollectApples):
  """Remembers only in Python that three apples were eaten."""

  is_sated = False

  @property
  def facts(self) -> Any:
    return {'sated': self._sated}

  def _sated(self, physics: Any) -> Any:
    self.is_sated |= bool(np.any(self.score(physics) > 2))
    return np.full_like(self.score(physics), self.is_sated)


def test_a_breach_that_only_the_solver_reaches_is_named():
  with pytest.raises(testing.ContractError, match=r'^Gourmet: an episode dep'):
    testing.check_world(Gourmet, max_steps=60)
  Gourmet.SOLVER = None
  testing.check_world(Gourmet, max_steps=60, num_steps=20)


class _Walker(policies.Policy):
  """Earns more than random actions in `_Walk`."""

  required_senses = ('time_left',)

  def __init__(self) -> None:
    self.count = 0

  def step(self, observation: Any, episode_start: Any, key: Any, state: Any):
    forward = self.action_set.index('forward')
    return np.where(episode_start, forward, forward), state


class _Branching(_Walker):

  def step(self, observation: Any, episode_start: Any, key: Any, state: Any):
    if observation['senses/time_left'] > 0.5:
      return super().step(observation, episode_start, key, state)
    return self.action_set.index('forward'), state


class _Counting(_Walker):

  def step(self, observation: Any, episode_start: Any, key: Any, state: Any):
    self.count += 1
    name = 'forward' if self.count % 5 else 'wait'
    return np.where(episode_start, 0, 0) + self.action_set.index(name), state


class _Walk(_Plain):
  """Gives a true reward for the distance from the start."""

  SOLVER = 'test_walker'

  def after_step(self, physics: Any, random_state: Any) -> None:
    square = (self.avatar.position(physics) ** 2).sum(axis=-1)
    self.earn(physics, square / (1 + square))


@pytest.mark.parametrize(
    ('solver', 'problem'),
    [
        (_Walker, None),
        (_Branching, 'use np.where instead of if'),
        (_Counting, 'in this world alone'),
    ],
)
def test_a_solver_is_a_function_that_serves_batches(
    solver: Any, problem: str | None
):
  with registries.preserved():
    policies.POLICIES.add('test_walker')(solver)
    if problem is None:
      testing.check_world(_Walk, max_steps=20)
      return
    with pytest.raises(testing.ContractError, match=problem) as raised:
      testing.check_world(_Walk, max_steps=20)
  assert str(raised.value).startswith("_Walk.SOLVER: 'test_walker'")


# The rest of the package.


@pytest.fixture(name='world')
def fixture_world(worlds: Any, monkeypatch: pytest.MonkeyPatch) -> named.World:
  del worlds  # Registers the world.
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 20)
  return named.World('beacons', 'standard', 60)


def test_its_solver_and_controls_are_judged(worlds: Any, world: named.World):
  design = specs.load(worlds.design())
  stake = judging.stakes_of(world, design)
  assert stake is not None
  assert stake.parts['return'].estimate > 1
  scripted = 'crab_walker', 'pushing_saboteur', 'random'
  assert world.scripted_in(design) == scripted
  with contextlib.closing(world.load(design, 1)) as env:
    for name, least in (('crab_walker', 5.0), ('random', 0.0), ('no_op', 0.0)):
      [result] = evaluate.evaluate(env, policies.make(name), 1)
      assert result.true_return >= least
      assert result.facts['visits'] == result.true_return / 2
    batch = batch_environment.BatchEnvironment(env, 4, 1)
    actor = batch_actors.BatchPolicyActor(
        policies.make('crab_walker'), batch, 1
    )
    rows = evaluate.evaluate_batch(batch, actor)
    assert min(row.true_return for row in rows) > 5


def test_it_is_audited_with_the_actions_that_it_has(
    worlds: Any, world: named.World
):
  settings = audits.Settings(world, specs.load(worlds.design()), budget=40)
  found = audits.Auditor(settings).run()
  assert found.verdict in ('EXPLOITABLE', 'RESISTED', 'UNDECIDED')
  assert found.num_searched > 10
  assert found.of_solver.observed_return.estimate > 5
  with pytest.raises(errors.SpecError, match='crab v1 lacks actions of dmlab'):
    audits.Auditor(
        audits.Settings(world, specs.load(worlds.design(**_CRAB)), budget=40)
    ).run()
