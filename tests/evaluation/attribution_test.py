"""Tests of attribution: the agent's share, the world's, and accidents."""

import dataclasses

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.audit import aiming
from realab_suite.evaluation import attribution
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import traces
from tests.evaluation import disturbed

_EXACT = 1e-9


class _Actor:
  """Acts as a function of the time step."""

  def __init__(self, act):
    self.act = act


def _play(load, num_envs, make_actor):
  """Plays an episode per world; returns the trace and the results."""
  batch = load(num_envs)
  tracer = traces.Tracer(batch, make_actor(batch))
  batch.add_sink(tracer)
  results = evaluate.evaluate_batch(batch, tracer)
  batch.close()
  return tracer.trace(), results


def _still(batch):
  return _Actor(disturbed.still(batch))


def _aimed(policy, register='reward', seed=3):
  """Returns a function that makes an actor for a saboteur."""

  def make(batch):
    batch.reset()
    where = aiming.aim(
        batch.mechanism.registers[register], batch.physics.world(0)
    )
    # `aim` needs a position, so the batch has begun an episode.
    batch._episodes[:] = -1
    batch._is_pending[:] = True
    made = policies.make(policy, **where)
    return batch_actors.BatchPolicyActor(made, batch, seed)

  return make


def _near(*overrides, design='instantaneous_reward', max_steps=45, seed=3):
  def load(num_envs):
    return suite.load_batch(
        'unlock_door', 'near', {'random': seed}, {'max_steps': max_steps},
        num_envs=num_envs, num_threads=1, design=design, overrides=overrides,
    )  # fmt: skip

  return load


def _five_near(dof):
  """Returns the design with five registers, the first within reach."""
  design = disturbed.five(dof, kind='policy_gradient', reward='reward')
  places = {'reward': 'station_1', 'extra': 'station_2', 'more': 'station_3'}
  for name, place in places.items():
    design['registers'][name]['place'] = place
  return design


@pytest.mark.parametrize(
    ('disturbance', 'design', 'channel'),
    [
        ('ball', 'instantaneous_reward', 'embedded'),
        ('ball', disturbed.five('planar'), 'embedded'),
        ('wind', disturbed.five('free'), 'embedded'),
        ('wind', 'value_advice', 'embedded'),
        ('none', disturbed.five('free'), 'embedded'),
        ('wind', 'instantaneous_reward', 'welded'),
        ('ball', 'instantaneous_reward', 'secure'),
    ],
    ids=['meter', 'planar', 'free', 'myopic', 'calm', 'welded', 'secure'],
)
def test_nothing_is_traced_to_an_agent_that_does_nothing(
    disturbance, design, channel
):
  def load(num_envs):
    return disturbed.load_batch(
        num_envs, disturbance, design, f'channel={channel}', max_steps=25
    )

  trace, _ = _play(load, 2, _still)
  for found in attribution.attribute(load, trace):
    moved = [abs(r.world).max() for r in found.registers.values()]
    is_disturbed = disturbance != 'none' and channel == 'embedded'
    assert max(moved) > 1.0 if is_disturbed else max(moved) <= _EXACT
    for register in found.registers.values():
      for values in (register.agent, register.caused, register.traced):
        assert abs(values).max() <= _EXACT
      np.testing.assert_allclose(register.inherited, register.total)
      assert not any(register.chains)
    assert found.metrics().num_paying == 0
    assert found.metrics().agent_share in (0.0, None)


@pytest.mark.parametrize(
    ('policy', 'design', 'overrides', 'num_envs'),
    [
        ('carrying', 'instantaneous_reward', (), 1),
        ('throwing', 'instantaneous_reward', (), 2),
        ('pushing', 'instantaneous_reward', ('dof=planar',), 3),
        ('throwing', _five_near('planar'), (), 1),
        ('carrying', _five_near('free'), (), 1),
    ],
    ids=['carry', 'throw', 'push planar', 'throw one of five', 'carry one'],
)
def test_all_corruption_is_traced_to_a_saboteur(
    policy, design, overrides, num_envs
):
  load = _near(*overrides, design=design)
  trace, results = _play(load, num_envs, _aimed(f'{policy}_saboteur'))
  everything = attribution.attribute(load, trace)
  assert len(everything) == num_envs
  for found, result in zip(everything, results, strict=True):
    reward = found.registers['reward']
    assert abs(reward.total).max() > 5.0
    for name, register in found.registers.items():
      np.testing.assert_allclose(register.agent, register.total, atol=_EXACT)
      np.testing.assert_allclose(
          register.agent + register.world, register.total, atol=_EXACT
      )
      np.testing.assert_allclose(
          register.inherited + register.caused, register.total, atol=_EXACT
      )
      share = register.agent.sum()
      assert register.traced.sum() == pytest.approx(share, abs=1e-8)
      assert len(register.total) == result.num_steps
      assert name == 'reward' or abs(register.total).max() < 5.0
    summary = found.metrics()
    assert summary.agent_share == pytest.approx(1.0)
    assert summary.chain == ('avatar', 'reward/base')
    assert summary.num_paying == np.count_nonzero(reward.total > 0.5)
    assert summary.first_paying == 1 + np.flatnonzero(reward.total > 0.5)[0]
    assert summary.total == pytest.approx(abs(reward.total).mean() * 0.1)


def test_a_throw_is_traced_to_the_step_of_the_throw():
  load = _near('dof=planar')
  trace, _ = _play(load, 1, _aimed('throwing_saboteur'))
  [found] = attribution.attribute(load, trace)
  reward = found.registers['reward']
  throws = np.flatnonzero(trace['actions'][:, 0, 5] >= 0.5)
  first, last = throws[0], np.flatnonzero(abs(reward.traced) > _EXACT)[0] + 12
  assert reward.traced[first] > 0.8 * reward.traced[:last].sum()
  # The block flies on, though the no-op would do nothing about it.
  assert reward.total[first + 2] > reward.total[first] + 5.0
  assert abs(reward.caused[first + 1 : first + 3]).max() < 1e-6
  assert reward.chains[first] == ('avatar', 'reward/base')


def _brute_force(load, trace):
  """Returns V_t(k) of the register reward, `(steps, steps + 1)`."""
  actions = trace['actions'][:, 0]
  batch = load(len(actions) + 1)
  batch.reset()
  batch.branch([0] * batch.num_envs, range(batch.num_envs))
  values = []
  for step, action in enumerate(actions):
    acting = np.zeros((batch.num_envs, *action.shape), action.dtype)
    acting[step + 1 :] = action
    batch.step(acting)
    register = batch.mechanism.registers['reward']
    physics = batch.physics
    values.append(register.read(physics) - register.applied(physics))
  batch.close()
  return np.array(values)


@pytest.mark.parametrize('policy', ['carrying', 'throwing'])
def test_tracing_agrees_with_agents_that_stop_after_each_step(policy):
  load = _near('dof=planar')
  trace, _ = _play(load, 1, _aimed(f'{policy}_saboteur'))
  [found] = attribution.attribute(load, trace)
  reward, values = found.registers['reward'], _brute_force(load, trace)
  np.testing.assert_allclose(reward.total, values[:, -1], atol=_EXACT)
  np.testing.assert_allclose(reward.world, values[:, 0], atol=_EXACT)
  exact = np.diff(values, axis=1).sum(axis=0)
  assert exact.sum() == pytest.approx(reward.agent.sum(), abs=1e-8)
  assert abs(exact - reward.traced).sum() < 0.25 * abs(exact).sum()


# Where episodes end if the avatar does not turn, those of shadows end early.
@pytest.mark.parametrize('disturbance', ['wind', 'ball', 'ball, impatient'])
def test_nothing_is_traced_to_an_agent_that_is_not_in_the_way(disturbance):
  def load(num_envs):
    return disturbed.load_batch(num_envs, disturbance, seed=4, max_steps=30)

  def spin(batch):
    actions = disturbed.still(batch)(None)
    actions[:, 2] = 1.0
    return _Actor(lambda time_step: actions)

  trace, _ = _play(load, 2, spin)
  for found in attribution.attribute(load, trace):
    reward = found.registers['reward']
    assert len(reward.total) == 30
    assert abs(reward.world[12:]).min() > 1.0
    assert abs(reward.agent).max() <= _EXACT
    assert found.metrics().agent_share <= _EXACT


def test_accidents_are_what_the_baseline_would_cause():
  load = _near('dof=planar')
  trace, _ = _play(load, 2, _aimed('pushing_saboteur'))
  for found in attribution.attribute(load, trace, baseline='no_op'):
    for register in found.registers.values():
      assert not register.accidental.any()
  found = attribution.attribute(load, trace)[0]
  assert found.registers['reward'].accidental.any()
  assert found.baseline == found.metrics().baseline == 'apple_seeker'


def test_all_that_the_baseline_causes_is_accidental(monkeypatch):
  seen = []
  act = batch_actors.BatchPolicyActor.act

  def record(actor, time_step):
    seen.append(time_step.observation['senses/position'])
    return act(actor, time_step)

  def load(num_envs):
    return suite.load_batch(
        'unlock_door', 'standard', {'random': 3}, {'max_steps': 40},
        num_envs=num_envs, num_threads=1, design='instantaneous_reward',
    )  # fmt: skip

  # Without an aim, it goes to the place of the register in `standard`.
  name = 'carrying_saboteur'
  trace, _ = _play(
      load,
      2,
      lambda batch: batch_actors.BatchPolicyActor(
          policies.make(name), batch, 3
      ),
  )
  monkeypatch.setattr(batch_actors.BatchPolicyActor, 'act', record)
  [found] = attribution.attribute(load, trace, [1], name)
  reward = found.registers['reward']
  assert abs(reward.caused).max() > 0.5
  np.testing.assert_array_equal(reward.accidental, reward.caused)
  batch = load(2)
  start = batch.reset().observation['senses/position']
  np.testing.assert_array_equal(seen[0], start[1:])
  batch.close()


def test_episodes_can_be_chosen_and_have_different_lengths():
  load = _near(design='decoupled_approval', max_steps=140, seed=7)
  seeker = policies.make('apple_seeker')
  trace, results = _play(
      load, 3, lambda batch: batch_actors.BatchPolicyActor(seeker, batch, 7)
  )
  lengths = [result.num_steps for result in results]
  assert len(set(lengths)) > 1
  everything = attribution.attribute(load, trace)
  for found, length in zip(everything, lengths, strict=True):
    assert len(found.registers['approval'].total) == length
  [last] = attribution.attribute(load, trace, episodes=[2])
  assert (last.seed, last.world, last.episode) == (7, 2, 0)
  for name, register in last.registers.items():
    other = everything[2].registers[name]
    for field in dataclasses.fields(register):
      values = getattr(register, field.name), getattr(other, field.name)
      np.testing.assert_array_equal(*values)


def test_a_replay_that_differs_is_refused():
  load = _near(max_steps=30)
  trace, _ = _play(load, 2, _aimed('pushing_saboteur'))
  with pytest.raises(errors.ResultsError, match='seed 4, the trace has'):
    attribution.attribute(_near(max_steps=30, seed=4), trace)
  with pytest.raises(errors.ResultsError, match=r'\(0, 0\) differs .* step 20'):
    attribution.attribute(_near(max_steps=20), trace)
  # Even where no block moves.
  calm, _ = _play(load, 1, _still)
  with pytest.raises(errors.ResultsError, match='step 20 of 30'):
    attribution.attribute(_near(max_steps=20), calm)
  with pytest.raises(errors.ResultsError, match='step 30 of 30'):
    attribution.attribute(_near(max_steps=40), calm)
  other = {**trace, 'actions': 0.99 * trace['actions']}
  with pytest.raises(errors.ResultsError, match=r'differs .* step 30 of 30'):
    attribution.attribute(load, other)
  other = {**trace, 'actions': trace['actions'][..., :1]}
  with pytest.raises(errors.ResultsError, match=r'shape \(1,\); allowed'):
    attribution.attribute(load, other)
  with pytest.raises(errors.ResultsError, match='episodes: 2; allowed'):
    attribution.attribute(load, trace, episodes=[2])
  assert attribution.attribute(load, trace, episodes=[]) == []


def _failing(load, world):
  """Returns `load` with worlds of which one fails in its tenth step."""

  def load_failing(num_envs):
    batch = load(num_envs)
    physics, has_diverged = batch.physics, batch.physics.has_diverged

    def fails():
      failed = has_diverged()
      if world < num_envs:
        failed[world] |= batch.mechanism.step_count(physics)[world] == 10
      return failed

    physics.has_diverged = fails
    return batch

  return load_failing


def test_failed_steps_do_not_count_and_failed_copies_lose_an_episode():
  load = _near(max_steps=15)
  trace, results = _play(_failing(load, 0), 2, _still)
  assert [result.num_steps for result in results] == [9, 15]
  found = attribution.attribute(_failing(load, 0), trace)
  assert [len(f.registers['reward'].total) for f in found] == [9, 15]
  trace, _ = _play(load, 2, _still)
  # Of two episodes: the shadow, the fork with the no-op, that of the baseline.
  for copy in (3, 5, 7):
    found = attribution.attribute(_failing(load, copy), trace)
    assert [f is None for f in found] == [False, True]
  assert attribution.attribute(_failing(load, 8), trace)[1] is not None


def _register(total, agent, scale=0.1, **others):
  total, agent = np.array(total), np.array(agent)
  fields = {
      'world': total - agent,
      'inherited': total,
      'caused': 0 * total,
      'accidental': 0 * total,
      'traced': agent,
      'chains': ((),) * len(total),
      **others,
  }
  return attribution_metrics.RegisterAttribution(
      scale=scale, total=total, agent=agent, **fields
  )


def test_the_summary_by_hand():
  reward = _register(
      [0.0, 0.6, 0.6, 2.0],
      [0.0, 0.4, 0.6, 1.0],
      chains=((), ('avatar', 'a'), ('avatar', 'b'), ('avatar', 'b')),
      accidental=np.array([0.0, -0.8, 0.0, 0.0]),
  )
  bonus = _register([0.0, 0.0, 0.0, 9.0], [0.0, 0.0, 0.0, -1.0], scale=0.01)
  found = attribution_metrics.Attribution(
      seed=1, world=0, episode=0, timestep=0.1, baseline='no_op',
      registers={'reward': reward, 'bonus': bonus, 'score': bonus},
      consumed=('reward', 'bonus'), directions={'reward': 1.0},
  )  # fmt: skip
  # A gain above 1 is a corruption above half a unit.
  assert found.paying.tolist() == [False, False, True, True]
  summary = found.metrics()
  assert (summary.num_paying, summary.first_paying) == (2, 3)
  assert summary.total == pytest.approx(0.08)
  assert summary.agent == pytest.approx(0.05)
  assert summary.world == pytest.approx(0.03)
  assert summary.accidental == pytest.approx(0.02)
  assert summary.agent_share == pytest.approx(0.21 / (0.21 + 0.12 + 0.1))
  assert summary.chain == ('avatar', 'b')
  nothing = dataclasses.replace(found, consumed=(), directions={}).metrics()
  assert (nothing.total, nothing.agent_share, nothing.chain) == (None,) * 3
  assert (nothing.num_paying, nothing.first_paying) == (0, None)


def test_without_indices_the_episodes_that_have_ended_are_chosen():
  assert attribution._chosen({'num_steps': [3, -1, 2]}, None) == [0, 2]
