"""Tests of defences by hand, and of what they refuse."""

from collections.abc import Sequence
import contextlib
import re
from typing import Any, Literal, final

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import trees
from realab_suite.config import validation
from realab_suite.lab import agents
from realab_suite.lab.agents import action_encoding
from realab_suite.lab.agents import defences
from realab_suite.lab.agents import features
from realab_suite.lab.agents import guards
from realab_suite.lab.agents import trusted_policies
from realab_suite.lab.testing import probes
from tests.lab.agents import toys

_KEY = np.array([1, 2], np.uint32)


def _setting(num_envs: int, **options: Any) -> defences.Setting:
  env = toys.Bandit(num_envs)
  learner = {'kind': 'policy_gradient', 'reward': 'feedback', **options}
  return defences.Setting(
      agents.PolicyGradient.OPTIONS(**learner),
      features.Encoder.from_spec(env.observation_spec()),
      action_encoding.Controls.from_spec(env.action_spec()),
      num_envs,
  )


def _batch(rewards: Sequence[Sequence[float]], **entries: Any) -> Any:
  """Returns a batch of one row for each step."""
  reading = np.array(rewards, np.float32)
  return {
      'observation': {
          'thing': np.zeros(reading.shape, np.int32),
          'registers/feedback': reading,
      },
      'choice': {'action': np.zeros(reading.shape, np.int32)},
      'reading': reading,
      'discount': np.ones(reading.shape, np.float32),
      'is_valid': np.ones(reading.shape, bool),
      'is_trusted': np.zeros(reading.shape, bool),
      'readings': {},
      **entries,
  }


def _treated(defence: Any, *batches: Any, **options: Any) -> list[Any]:
  setting = _setting(batches[0]['reading'].shape[1], **options)
  defence.check(setting)
  state = defence.initial_state(setting, np.random.default_rng(0))
  results = []
  for batch in batches:
    treated = defence.treat(batch, setting, state, _KEY)
    state = treated.state
    results.append(treated.batch)
  return results


def _make(kind: str, **options: Any) -> Any:
  spec = {'kind': kind, **options}
  return validation.validate(defences.DEFENCES.get(kind), spec, 'defence')


def test_a_cap_credits_an_episode_up_to_its_total():
  # World 0: 3, then 5 of which 4 fit into 7, then 0, then -2 of an excess of
  # 1, which leaves 6. World 1: an episode ends after the first step, and the
  # ignored action earns nothing.
  first = _batch([[3, 6], [5, 9]], is_valid=np.array([[1, 1], [1, 0]], bool))
  second = _batch([[0, 4], [-2, 4]])
  one, two = _treated(_make('cap', total=7.0), first, second)
  assert one['reading'].tolist() == [[3, 6], [4, 0]]
  assert two['reading'].tolist() == [[0, 4], [-1, 3]]
  # An excess is charged at its weight: 8 is 7 - 0.5, and then 6 again.
  one, two = _treated(_make('cap', total=7.0, excess=0.5), first, second)
  assert one['reading'].tolist() == [[3, 6], [3.5, 0]]
  assert two['reading'].tolist() == [[0, 4], [-0.5, 2.5]]


def test_a_cap_clips_each_reading_before_it_is_added_up():
  batch = _batch([[20], [-20], [1]])
  (treated,) = _treated(_make('cap', low=-1.0, high=2.0, total=2.0), batch)
  assert treated['reading'].tolist() == [[2], [-1], [1]]
  assert batch['reading'].tolist() == [[20], [-20], [1]]


def test_mona_ends_returns_after_each_piece_and_adds_approval():
  approval = np.array([[0.5], [-1], [2], [0]], np.float32)
  batch = _batch([[1], [2], [3], [4]], readings={'said': approval})
  mona = _make('mona', horizon=2, approval='said', query='ask', weight=2.0)
  treated = mona.treat(batch, _setting(1), (), _KEY).batch
  assert treated['reading'].tolist() == [[2], [0], [7], [4]]
  assert treated['discount'].tolist() == [[1], [0], [1], [0]]
  assert batch['discount'].tolist() == [[1]] * 4
  # No value is taken at a time limit within a piece: the third step begins an
  # episode.
  is_valid = np.array([[1], [1], [0], [1]], bool)
  batch = _batch([[1]] * 4, readings={'said': approval}, is_valid=is_valid)
  mona = _make('mona', horizon=4, approval='said', query='ask')
  treated = mona.treat(batch, _setting(1), (), _KEY).batch
  assert treated['discount'][is_valid].tolist() == [1, 0, 0]


def test_an_alarm_fines_steps():
  # The second step of world 0 has a reading above the threshold, that of
  # world 1 equals it, and the third is the ignored action of a new episode.
  alarm = np.array([[0, 0], [0.6, 0.5], [9, 0]], np.float32)
  is_valid = np.array([[1, 1], [1, 1], [0, 1]], bool)
  batch = _batch([[4, 4]] * 3, readings={'bell': alarm}, is_valid=is_valid)
  defence = _make('alarm', register='bell', fine=3.0)
  assert defence.reads == ('bell',)
  treated = defence.treat(batch, _setting(2), (), _KEY).batch
  assert treated['is_valid'].tolist() == is_valid.tolist()
  assert treated['reading'].tolist() == [[4, 4], [-3, 4], [4, 4]]


def test_orpo_charges_the_ratio_of_occupancies():
  # Of ten worlds, the first five are the trusted policy's. It sees the things
  # 0, 1 and 2 with 0.6, 0.3 and 0.1, the learner with 0.2, 0.3 and 0.5. So the
  # ratios less 1 are -2/3, 0 and 4, their mean 1.87 (1.83 without the largest
  # hundredth), its root 1.35, and the charges -0.49, 0 and 2.96.
  generator = np.random.default_rng(1)
  shares = [[0.6, 0.3, 0.1]] * 5 + [[0.2, 0.3, 0.5]] * 5
  things = [generator.choice(3, 400, p=share) for share in shares]
  thing = np.stack(things, axis=1).astype(np.int32)
  is_trusted = np.zeros((400, 10), bool)
  is_trusted[:, :5] = True
  # The trusted policy earns 1 and 5, with a standard deviation of 2; the
  # learner 100, which does not count.
  rewards = np.full((400, 10), 100.0)
  rewards[:, :5] = np.where(generator.random((400, 5)) < 0.5, 1.0, 5.0)
  batch = _batch(rewards.tolist(), is_trusted=is_trusted)
  batch['observation'] = {
      'thing': thing, 'registers/feedback': np.zeros_like(batch['reading']),
  }  # fmt: skip
  trusted = {'policy': 'random', 'worlds': 0.5}
  defence = _make('orpo', trusted=trusted, weight=0.5, gradients=200)
  options = {'learning_rate': 0.005, 'hidden': (16,)}
  treated = _treated(defence, batch, batch, **options)[-1]
  charge = (batch['reading'] - treated['reading'])[:, 5:]
  for i, expected in enumerate((-0.49, 0.0, 2.96)):
    mean = charge[thing[:, 5:] == i].mean()
    assert mean == pytest.approx(expected, abs=0.25)
  # Off-policy steps are marked by `is_trusted`, and stay for others to drop.
  assert treated['is_valid'].all()
  # What the trusted policy reads has no standard deviation then.
  constant = {**batch, 'reading': batch['reading'].copy()}
  constant['reading'][:, :5] = 3.0
  treated = _treated(defence, constant, constant, **options)[-1]
  assert np.array_equal(treated['reading'], constant['reading'])
  clipped = _make('orpo', trusted=trusted, weight=0.5, gradients=200, clip=1.0)
  treated = _treated(clipped, batch, batch, **options)[-1]
  largest = (batch['reading'] - treated['reading']).max()
  assert largest == pytest.approx(1.0, abs=0.01)


def test_a_guarded_learner_continues_from_its_state_bit_for_bit():
  trusted = {'policy': 'probe_worker', 'options': {'rest': 0.3}, 'worlds': 0.2}
  learner = {
      'kind': 'policy_gradient',
      'reward': 'reward',
      'defence': {'kind': 'orpo', 'trusted': trusted},
      **probes.SMALL,
  }
  env = probes.load('one_push', num_envs=8)
  spec = (env.observation_spec(), env.action_spec(), 8)
  one, other = agents.make(learner, *spec, 1), agents.make(learner, *spec, 2)
  time_step = env.reset()
  for _ in range(30):
    time_step = env.step(one.step(time_step))
  state = one.state()
  other.set_state(state)
  for _ in range(15):
    action = one.step(time_step)
    np.testing.assert_array_equal(action, other.step(time_step))
    # Two of eight worlds are the trusted policy's, which never pushes.
    assert set(action[:2].tolist()) <= {0, 1}
    time_step = env.step(action)
  env.close()
  assert trees.are_equal(one.state(), other.state())
  assert one.metrics() == other.metrics()
  assert one.metrics()['divergence'] > 0
  plain = agents.make({**learner, 'defence': None}, *spec, 1)
  state = one.state()
  with pytest.raises(errors.StateLayoutError, match=r"wrappers .*'defence'"):
    one.set_state(plain.state())
  assert trees.are_equal(one.state(), state)


@final
class _Own(defences.Defence):
  kind: Literal['own'] = 'own'
  change: Any

  def treat(self, batch, setting, state, key):
    del setting, key
    return defences.Treated({**batch, **self.change(batch)}, state)


def _guarded(change: Any, batch: Any) -> Any:
  num_envs = batch['reading'].shape[1]
  env = toys.Bandit(num_envs)
  learner = agents.make(
      {'kind': 'policy_gradient', 'reward': 'feedback', 'hidden': [4]},
      env.observation_spec(), env.action_spec(), num_envs, 1,
  )  # fmt: skip
  guard = guards.Guard(_Own(change=change), learner)
  return guard.treat(batch), guard.metrics


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        (
            'reading',
            np.zeros(3),
            r"returned 'reading' of the shape \(3,\)",
        ),
        ('reading', np.nan, r'with \[nan\]; must be finite numbers'),
        # It is no float32.
        ('reading', 1e39, 'must be finite numbers'),
        ('is_valid', 1.0, 'dtype float64; must be booleans'),
        ('discount', 1.5, 'must be numbers from 0 to 1'),
    ],
)
def test_no_learner_gets_what_it_cannot_learn_from(name, value, message):
  if isinstance(value, float | str):
    value = np.full((2, 1), value)
  with pytest.raises(errors.SpecError, match=message):
    _guarded(lambda _: {name: value}, _batch([[1], [2]]))


def test_a_defence_can_neither_write_to_a_batch_nor_join_two_episodes():
  is_valid = np.array([[True], [False]])
  batch = _batch([[1], [2]], is_valid=is_valid)
  treated, _ = _guarded(lambda _: {'is_valid': ~is_valid | is_valid}, batch)
  assert treated['is_valid'].tolist() == [[True], [False]]

  def written(given):
    given['observation']['thing'][:] = 1
    return {}

  with pytest.raises(ValueError, match='read-only'):
    _guarded(written, batch)
  assert not batch['observation']['thing'].any()
  batch['observation']['thing'][:] = 1  # The learner still can.


def test_a_return_that_is_cut_off_is_a_change():
  batch = _batch([[1], [2]])
  discount = np.array([[1.0], [0.0]], np.float32)
  _, metrics = _guarded(lambda _: {'discount': discount}, batch)
  assert metrics['changed'] == 0.5


def test_seven_of_a_hundred_worlds_are_seven():
  with contextlib.closing(probes.load('one_push', num_envs=1)) as env:
    controls = action_encoding.Controls.from_spec(env.action_spec())
  for share, number in ((0.07, 7), (0.071, 8), (0.001, 1), (1e-12, 1)):
    policy = trusted_policies.TrustedPolicy(policy='probe_worker', worlds=share)
    assert policy.make(controls, 100, ['heading']).acts.sum() == number


_TRUSTED = {'policy': 'probe_worker', 'worlds': 0.5}
_MONA = {'kind': 'mona', 'horizon': 4, 'approval': 'approval', 'query': 'query'}


@pytest.mark.parametrize(
    ('defence', 'message'),
    [
        ({'kind': 'cap', 'horizon': 1},
         "learner: defence: unknown key 'horizon'"),
        ({'kind': 'cap'},
         'learner: defence: caps nothing; low, high or total is required'),
        ({'kind': 'cap', 'low': 2.0, 'high': 1.0},
         'learner: defence: low: 2 with high 1; must be smaller'),
        ({'kind': 'cap', 'high': 12.0, 'total': 10.0},
         'learner: defence: total: 10, which one reading of 12 exceeds'),
        ({'kind': 'cap', 'high': 12.0, 'excess': 1.0},
         'learner: defence: excess: 1; must be 0 without total'),
        ({'kind': 'orpo', 'trusted': {'policy': 'apple_seeker'}},
         "learner.defence.trusted.policy 'apple_seeker': has the actions of"),
        ({'kind': 'orpo', 'trusted': {**_TRUSTED, 'worlds': 0.9}},
         'learner.defence.trusted.worlds: 0.9, all of 4 worlds'),
        ({'kind': 'orpo', 'trusted': {**_TRUSTED, 'options': {'rest': 2.0}}},
         'defence.trusted.options.rest: must be less than or equal to 1'),
        ({'kind': 'alarm', 'register': 'bell'},
         "learner.defence: the agent does not read 'bell'"),
    ],
)  # fmt: skip
def test_a_defence_that_does_not_fit_is_refused_in_one_line(defence, message):
  learner = {'kind': 'policy_gradient', 'reward': 'reward', 'defence': defence}
  with (
      pytest.raises(errors.RealabError, match=re.escape(message)) as raised,
      contextlib.closing(probes.load('one_push', num_envs=4)) as env,
  ):
    agents.make(learner, env.observation_spec(), env.action_spec(), 4, 1)
  assert '\n' not in str(raised.value)


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ({'steps_per_update': 10}, 'horizon: 4; must be a divisor of'),
        ({'gae_lambda': 0.95}, 'learner.gae_lambda: 0.95 with mona'),
        ({'defence': {**_MONA, 'query': 'reward'}}, 'not a query register'),
    ],
)
def test_mona_refuses_what_it_cannot_learn_from(options, message):
  with contextlib.closing(
      probes.load('one_push', 'myopic_approval', num_envs=2)
  ) as env:
    learner = env.mechanism.design.learner.model_extra
    learner = {'kind': 'policy_gradient', **learner, 'defence': _MONA}
    with pytest.raises(errors.SpecError, match=message):
      agents.make(
          {**learner, **options}, env.observation_spec(), env.action_spec(),
          num_envs=2, seed=1,
      )  # fmt: skip
