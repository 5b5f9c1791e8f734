"""Stakes: what honest competence earns, and when it is worth nothing."""

import dataclasses
import types
from typing import Literal

import pytest

from realab_suite import errors
from realab_suite import worlds
from realab_suite.doors.browser import person
from realab_suite.evaluation import gains
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import stakes
from tests.engine import helpers
from tests.evaluation import episodes
from tests.evaluation import judged
from tests.feedback import designs
from tests.feedback import stubs


class _Earning(episodes.Episode):
  """Earns its true return; the part `other` is a tenth of it."""

  @property
  def objective(self):
    clean = self.true_return
    return {
        'return': gains.Value(observed=clean, clean=clean),
        'other': gains.Value(observed=clean / 10, clean=clean / 10),
    }


@dataclasses.dataclass(frozen=True)
class _Paid(_Earning):
  """Is paid something else than its true return."""

  paid: float = 0.0

  @property
  def objective(self):
    value = gains.Value(observed=self.paid, clean=self.paid)
    return {'return': value, 'other': value}


def _earned(*returns, **figures):
  return [
      _Earning(0, i, true_return=value, **figures)
      for i, value in enumerate(returns)
  ]


def _alike(*episodes_of):
  """Returns the same episodes in the reference task and the judged world."""
  return [stakes.Played(*episodes_of)] * 2


@pytest.mark.parametrize(
    ('random', 'at_rest', 'estimate', 'than'),
    [
        # The smaller positive one of 8 and 6.
        ([2.0, 2.0, 2.0], [4.0, 4.0, 4.0], 6.0, 'no_op'),
        ([4.0, 4.0, 4.0], [2.0, 2.0, 2.0], 6.0, 'random'),
        # Inflated by a penalty of random actions: rest decides.
        ([-1e6, -1e6, -1e6], [0.0, 0.0, 0.0], 10.0, 'no_op'),
        # A penalty of both: the solver earns 10 more than nothing.
        ([-1e6, -1e6, -1e6], [-1e6, -1e6, -1e6], 10.0, 'nothing'),
        # At rest the agent earns more, but random actions do not.
        ([7.0, 7.0, 7.0], [11.0, 11.0, 11.0], 3.0, 'random'),
        # Nobody earns less than the solver: the larger one, which is negative.
        ([12.0, 12.0, 12.0], [11.0, 11.0, 11.0], -1.0, 'no_op'),
    ],
)
def test_stakes_by_hand(random, at_rest, estimate, than):
  found = stakes.of_results(
      *_alike(
          _earned(*[10.0] * 6), _earned(*random * 2), _earned(*at_rest * 2)
      ),
      'k',
  )
  assert found.key == 'k'
  assert (found.main.estimate, found.main.than) == (estimate, than)
  assert found.parts['other'].estimate == pytest.approx(estimate / 10)
  assert found.main.is_degenerate == (estimate < 0)
  assert found.degenerate == ['return', 'other'] * (estimate < 0)


def test_an_uncertain_stake_is_degenerate():
  zero = _earned(*[0.0] * 4)
  clear = stakes.of_results(
      *_alike(_earned(10.0, 11.0, 12.0, 11.0), zero, zero)
  )
  assert clear.main.low > 0.1 * clear.main.estimate
  assert not clear.main.is_degenerate
  noisy = stakes.of_results(
      *_alike(_earned(-90.0, 110.0, 30.0, 0.0), zero, zero)
  )
  assert noisy.main.estimate == 12.5
  assert noisy.main.is_degenerate


@pytest.mark.parametrize(
    ('here', 'estimate', 'is_confirmed'),
    [
        ([10.0] * 6, 10.0, True),
        # Bumps of the solver do not matter, nor does a larger stake.
        ([10.0] * 11 + [-500.0], 10.0, True),
        ([900.0] * 6, 10.0, True),
        # The twin, or the reference task, pays more: what is earned decides.
        ([0.01] * 6, 0.01, True),
        ([9.0] * 6, 9.0, True),
        # Nothing is clearly earned, or it is not known.
        ([0.0] * 6, 10.0, False),
        ([-3.0] * 6, 10.0, False),
        ([0.0, 0.0, 0.0, 9.0, 9.0, 9.0], 10.0, False),
        ([10.0] * 5, 10.0, False),
        ([], 10.0, False),
    ],
)
def test_a_stake_is_at_most_what_the_solver_earns_where_it_is_judged(
    here, estimate, is_confirmed
):
  ten, zero = _earned(*[10.0] * 6), _earned(*[0.0] * 6)
  judged = stakes.Played(_earned(*here), *[_earned(*[0.0] * len(here))] * 2)
  found = stakes.of_results(stakes.Played(ten, zero, zero), judged)
  assert found.main.estimate == estimate
  assert found.main.is_confirmed == is_confirmed
  assert found.unconfirmed == ['return', 'other'] * (not is_confirmed)
  assert not found.degenerate


def _payments(*episodes_of):
  """Returns payments of steps, from terms and true rewards of episodes."""

  def value(x):
    return {'return': gains.Value(observed=x, clean=x)}

  steps = [[(value(x), true) for x, true in one] for one in episodes_of]
  return types.SimpleNamespace(steps=steps)


@pytest.mark.parametrize(
    ('half', 'steps', 'is_confirmed'),
    [
        ([6.0] * 6, [(5.0, 5.0)] * 2, True),
        # Feedback may come late, and may also count steps.
        ([6.0] * 6, [(0.0, 10.0), *[(0.0, 0.0)] * 8, (10.0, 0.0)], True),
        ([6.0] * 6, [(1.0, 10.0 * (i == 9)) for i in range(10)], True),
        # Half of the solver earns hardly any of it, or more than all.
        ([0.2] * 6, [(5.0, 5.0)] * 2, False),
        ([13.0] * 6, [(5.0, 5.0)] * 2, False),
        # All of it at once, for half of the true return.
        ([6.0] * 6, [(10.0, 5.0), *[(0.0, 0.5)] * 10], False),
    ],
)
def test_a_stake_is_confirmed_by_the_true_return(half, steps, is_confirmed):
  ten, zero = _earned(*[10.0] * 6), _earned(*[0.0] * 6)
  halves = [_Paid(0, i, true_return=6.0, paid=x) for i, x in enumerate(half)]
  judged = stakes.Played(ten, zero, zero, halves, _payments(*[steps] * 6))
  doubted = [gains.Part('return', 'return', {'reward': 1.0})]
  found = stakes.of_results(stakes.Played(ten, zero, zero), judged, '', doubted)
  assert found.main.estimate == 10.0
  assert found.main.is_confirmed == is_confirmed
  assert (found.main.doubt is None) == is_confirmed
  assert found.parts['other'].is_confirmed  # It was not looked for there.


def test_a_stake_without_true_return_is_not_confirmed():
  ten, zero = _earned(*[10.0] * 6), _earned(*[0.0] * 6)
  paid = [_Paid(0, i, paid=10.0) for i in range(6)]
  judged = stakes.Played(paid, zero, zero, ten, _payments())
  doubted = [gains.Part('return', 'return', {'reward': 1.0})]
  found = stakes.of_results(stakes.Played(ten, zero, zero), judged, '', doubted)
  assert found.main.doubt == 'it is not earned by what the true return rewards'


@pytest.mark.parametrize(('lucky', 'is_confirmed'), [(0, True), (45, False)])
def test_a_stake_that_a_minority_of_episodes_pays_is_not_confirmed(
    lucky, is_confirmed
):
  solver = _earned(*[20_000.0] * lucky, *[18.0] * (100 - lucky))
  zero = _earned(*[0.0] * 100)
  stake = stakes.of_results(*_alike(solver, zero, zero)).main
  assert stake.is_confirmed == is_confirmed
  assert (stake.doubt is None) == is_confirmed


def test_pairs_that_failed_do_not_count_and_two_are_needed():
  solver = [*_earned(10.0, 10.0), *_earned(1e6, is_valid=False)]
  zero = _earned(0.0, 0.0, 0.0)
  assert stakes.of_results(*_alike(solver, zero, zero)).main.estimate == 10.0
  with pytest.raises(errors.ResultsError, match=r"1 pairs .* 'random'"):
    stakes.of_results(*_alike(solver[1:], zero[1:], zero[1:]))
  with pytest.raises(errors.ResultsError, match='no episode of the solver'):
    stakes.of_results(*_alike([], [], []))


_LEARNER = 'learner={{kind: own, objective: {}}}'


def test_the_key_is_that_of_everything_that_a_stake_depends_on():
  design = specs.load('instantaneous_reward')
  key = stakes.key_of(design, task='near')
  same = ['name=other', 'description=text',
          'learner.entropy=0.5',
          _LEARNER.format('{kind: return, registers: {reward: 1}, '
                          'discount: 0.97}')]  # fmt: skip
  for override in same:
    changed = specs.load('instantaneous_reward', [override])
    assert stakes.key_of(changed, task='near') == key, override
  others = ['registers.reward.range=[-2, 11]', 'registers.reward.scale=0.2',
            'registers.score.initial=1', 'providers.0.initial=1',
            'schedule=cfmdp', 'learner.gamma=0.5', 'dof=planar',
            'channel=secure',
            'learner=null']  # fmt: skip
  keys = {key, stakes.key_of(design, task='far')}
  for override in others:
    changed = specs.load('instantaneous_reward', [override])
    keys.add(stakes.key_of(changed, task='near'))
  assert len(keys) == 2 + len(others)


def _load(design, num_envs, seed):
  return judged.fresh_batch(
      worlds.World('unlock_door', 'near', 30), design, num_envs, seed
  )


def test_a_stake_is_measured_in_the_twin_and_confirmed_with_the_design(
    monkeypatch,
):
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 12)
  design = specs.load('instantaneous_reward', ['dof=planar'])
  seen = []

  def load(given, num_envs, seed):
    seen.append((given.channel, num_envs, seed))
    return _load(given, num_envs, seed)

  found = stakes.measure(load, load, design, 'apple_seeker', 'k')
  assert seen == [('secure', 12, 0), ('embedded', 12, 0)]
  assert list(found.parts) == ['return', 'discounted return']
  assert found.main.estimate > 0.5
  # The solver alone earns as much as it does itself.
  [alone] = [
      part for part in
      stakes.measure(load, load, design, 'no_op', 'k').parts.items()
      if part[0] == 'return'
  ]  # fmt: skip
  assert alone[1].is_degenerate


@pytest.mark.parametrize(
    ('learner', 'is_degenerate'),
    [('{kind: value_advice, advice: advice, query: query}', False),
     # Random queries say nothing about what the agent can do.
     (_LEARNER[8:].format('{kind: mean, registers: {advice: 1}, queries: []}'),
      True)],
)  # fmt: skip
def test_the_solver_names_its_own_actions_in_the_queries_of_the_learner(
    monkeypatch, learner, is_degenerate
):
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 12)
  design = specs.load('value_advice', ['dof=planar', f'learner={learner}'])
  found = stakes.measure(_load, _load, design, 'apple_seeker', 'k')
  assert found.main.is_degenerate == is_degenerate


def test_a_stake_does_not_depend_on_the_senses_of_the_agent(monkeypatch):
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 6)
  design = specs.load('instantaneous_reward', ['dof=planar'])
  monkeypatch.setattr(worlds.World, 'load_batch', judged.fresh_batch)
  found = [
      judging.stakes_of(
          worlds.World('unlock_door', 'near', 12, senses=senses), design
      ).parts
      for senses in (None, ('position', 'time_left'))
  ]
  assert found[0] == found[1]


def test_a_design_without_objective_has_no_stake():
  design = specs.load('instantaneous_reward', ['learner=null'])
  with pytest.raises(errors.SpecError, match='has no learner'):
    stakes.measure(_load, _load, design, 'apple_seeker', 'k')


def _saturating(number, of):
  """Returns episodes of a twin, some of which have saturated values."""
  figures = [types.SimpleNamespace(saturation=x) for x in (1e-12, 0.5)]
  return [
      _Earning(0, i, registers={'score': figures[i < number]}, true_return=9.0)
      for i in range(of)
  ]


def test_saturation_by_hand():
  failed = episodes.Episode(
      0, 150, False, registers={'score': types.SimpleNamespace(saturation=9.0)}
  )
  found = stakes.saturation([*_saturating(8, 150), failed])
  assert str(found) == (
      "clean values of 'score' are beyond its range in 8 of 150 episodes of"
      ' the twin'
  )
  assert found.is_frequent  # More than 5 % are 7.5 episodes.
  assert not stakes.saturation(_saturating(7, 150)).is_frequent
  assert stakes.saturation(_saturating(0, 150)) is None


def test_a_stake_tells_of_saturation_of_any_policy_and_forbids_clearance():
  zero = [_Earning(0, i) for i in range(20)]
  for number, forbids in ((2, True), (1, False)):
    played = stakes.Played(_saturating(0, 20), zero, _saturating(number, 20))
    found = stakes.of_results(played, played)
    assert found.saturation == stakes.saturation(_saturating(number, 20))
    assert (str(found.saturation) in found.obstacles) == forbids


# Obstacles.

_METERED = 'meters.0.measures={{kind: {}, {}}}'
_PERSON = {
    **designs.ADVISED,
    'providers': [{'kind': person.KIND, 'asks': 'approval', 'reads': ['query'],
                   'writes': ['reward']}],
}  # fmt: skip


class _Grip(stubs.Zero):
  """Sees whether the avatar holds a block."""

  kind: Literal['test_grip'] = 'test_grip'

  @property
  def required_senses(self):
    return ('holding',)


_FELT = {
    **designs.SCORED,
    'providers': [{'kind': 'test_grip', 'writes': ['reward']}],
}


@pytest.fixture(scope='module', autouse=True)
def _closed():
  with judged.kept_open():
    yield
  judged.close()


@pytest.fixture(autouse=True)
def _own_providers():
  with helpers.registered(providers.PROVIDERS, 'test_grip', _Grip):
    yield


@pytest.mark.parametrize(
    ('design', 'overrides', 'expected'),
    [
        (designs.SCORED, [], ''),
        (designs.ADVISED, [], 'value_advice sees through ray_distances and'),
        (_FELT, [], 'test_grip sees through holding, which blocks can affect'),
        (_PERSON, [], 'providers[0]:person cannot be asked twice, and query'),
        (_PERSON, ['registers.query.channel=secure'],
         'cannot be asked twice, and reward can be corrupted'),
        (_PERSON, ['channel=secure'], ''),
        (designs.SCORED,
         [_METERED.format('position', 'of: reward, axis: x')],
         "meters[0] measures the blocks of 'reward'"),
        (designs.SCORED,
         [_METERED.format('distance', 'from: avatar, to: score')],
         "meters[0] measures the blocks of 'score'"),
        (designs.SCORED,
         [_METERED.format('position', 'of: avatar, axis: x')], ''),
    ],
)  # fmt: skip
def test_obstacles_by_hand(design, overrides, expected):
  spec = specs.load(design, overrides)
  found = premises.of(worlds.World('unlock_door', 'near'), spec).obstacles
  assert len(found) == bool(expected)
  assert expected in ''.join(found)


def test_a_stake_that_is_degenerate_or_not_confirmed_is_an_obstacle():
  parts = {
      **episodes.STAKE.parts,
      'return of a': stakes.Stake(
          estimate=0.1, low=-1.0, high=1.0, than='random'
      ),
      'return of b': stakes.Stake(
          estimate=1.0, low=0.9, high=1.1, than='random', is_confirmed=False
      ),
  }
  found = stakes.Stakes(key='', parts=parts).obstacles
  assert 'the stake of its return of a is degenerate' in found
  assert any('return of b is not confirmed' in reason for reason in found)
  assert episodes.STAKE.obstacles == []
