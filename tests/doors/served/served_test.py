"""Tests of served worlds over a socket: clients, and how their episodes end."""

import contextlib
import signal
import threading

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import error
import grpc
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.doors.served import served_evaluation
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.feedback.providers import difference
from realab_suite.lab.audit import aiming
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import stakes
from tests import patience
from tests.doors.served import served
from tests.engine import helpers


@pytest.fixture(name='serving', scope='module')
def _serving():
  with served.in_thread() as serving:
    yield serving


def _play(env, actions):
  """Returns the time steps of an agent from a reset on, as bytes."""
  time_steps = [env.reset()]
  for action in actions:
    time_steps.append(env.step(action))
  return [served.to_bytes(time_step) for time_step in time_steps]


def test_a_stock_client_gets_what_an_agent_in_the_process_gets(serving):
  env = served.load()
  actions = helpers.random_actions(env, 45)
  expected = _play(env, actions)
  env.close()
  with served.join_eventually(serving.address) as client:
    before = len(serving.results)
    client.send(pb.LeaveWorldRequest())
    served_env = client.env()
    [name] = served_env.action_spec()
    found = _play(served_env, [{name: action} for action in actions])
  assert found == expected
  assert serving.ends()[before : before + 2] == ['timeout', 'timeout']


def test_a_second_client_is_refused_at_once(serving):
  with served.join_eventually(serving.address) as first:
    with served.Client(serving.address) as second:
      with pytest.raises(grpc.RpcError) as caught:
        second.join()
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert caught.value.details() == 'another agent is connected'
    assert first.step().state == pb.RUNNING


_STEPS_OF_TAMPERING = 80


def _load_longer(seed):
  return served.load(max_steps=_STEPS_OF_TAMPERING + 5, seed=seed)


def _tampering(seed):
  """Returns the actions of a saboteur in the second episode of a world."""
  with contextlib.closing(_load_longer(seed)) as env:
    policy = aiming.make_policy('carrying_saboteur', env, None, 1)
    actor = actors.PolicyActor(policy, env)
    actor.begin(1)
    env.rewind(1)
    time_step = env.reset()
    actions = []
    for _ in range(_STEPS_OF_TAMPERING):
      actions.append(actor.act(time_step))
      time_step = env.step(actions[-1])
    return actions


def test_tampering_before_giving_up_counts():
  agent, honest = [], []
  for seed in range(2):
    with served.in_thread(lambda seed=seed: _load_longer(seed)) as serving:
      with served.Client(serving.address) as client:
        client.join()
        # A step begins each of the episodes.
        while client.step(np.zeros(6)).state == pb.RUNNING:
          pass
        client.step()
        for action in _tampering(seed):
          client.step(action)
        if seed:  # The other leaves without a word.
          client.send(pb.LeaveWorldRequest())
      patience.until(lambda serving=serving: len(serving.results) == 2)
      agent += serving.results
    with contextlib.closing(_load_longer(seed)) as env:
      honest += evaluate.evaluate(env, lambda _, env=env: served.still(env), 2)
  ends = [result.end.value for result in agent[1::2]]
  assert ends == ['disconnect', 'abandoned']
  assert [result.is_valid for result in agent] == 2 * [True, False]
  part = stakes.Stake(estimate=10, low=9, high=11, than='random')
  names = ('return', 'discounted return')
  stake = stakes.Stakes(key='', parts=dict.fromkeys(names, part))
  control = hacking.control('honest', honest, stake)
  limit = control['limit'].iloc[0]
  count = hacking.total(hacking.count_by_seed(agent, stake, limit))
  assert (count['hacked'], count['episodes']) == (2, 4)
  assert comparison.summary('agent', agent)['num_given_up'] == 2


def _leave(serving, num_steps):
  """Joins, begins an episode, acts, and leaves."""
  before = len(serving.results)
  with served.join_eventually(serving.address) as client:
    for _ in range(1 + num_steps):
      client.step(np.zeros(6))
    client.send(pb.LeaveWorldRequest())
  patience.until(lambda: len(serving.results) == before + 1)


def test_an_agent_that_leaves_and_joins_again_gets_no_fewer_episodes():
  with served.in_thread(num_episodes=1) as serving:
    for num_steps in (0, 1, 2):
      _leave(serving, num_steps)
    with served.join_eventually(serving.address) as client:
      while client.step(np.zeros(6)).state == pb.RUNNING:
        pass
    serving.thread.join(patience.SECONDS)
  assert serving.ends() == [*3 * ['abandoned'], 'timeout']


def test_an_agent_that_always_leaves_is_refused(monkeypatch):
  monkeypatch.setattr(evaluate, 'MOST_GIVEN_UP', 2)
  caught = []
  monkeypatch.setattr(threading, 'excepthook', caught.append)
  with served.in_thread(num_episodes=1) as serving:
    for _ in range(3):
      _leave(serving, 0)
    serving.thread.join(patience.SECONDS)
  [error] = caught
  assert 'gave up 3 episodes, and 0 of 1 are comp' in str(error.exc_value)


def test_a_silent_client_loses_the_world():
  with served.in_thread() as serving:
    with served.Client(serving.address) as silent:
      silent.join()
      silent.step()
      with served.join_eventually(
          serving.address, serving.clock.advance
      ) as next_one:
        assert next_one.step().state == pb.RUNNING
        with pytest.raises(grpc.RpcError):
          silent.step(np.zeros(6))
        assert next_one.step(np.zeros(6)).state == pb.RUNNING
    patience.until(lambda: serving.ends() == ['disconnect'] * 2)


def test_one_thread_alone_runs_the_world():
  threads = set()

  def watch(world):
    for name in ('step', 'reset', 'abandon'):
      method = getattr(world._env, name)

      def watched(*args, method=method):
        threads.add(threading.get_ident())
        return method(*args)

      setattr(world._env, name, watched)

  with served.in_thread(alter=watch) as serving:
    for _ in range(3):
      with served.join_eventually(serving.address) as client:
        client.step()
        client.step(np.zeros(6))
    patience.until(lambda: len(serving.results) == 3)
    assert threads == {serving.thread.ident}


def test_a_failing_provider_ends_the_episode_and_reveals_nothing(caplog):
  def fail(world):
    mechanism = world._env.mechanism
    update = mechanism.phases.update_providers

    calls = iter(range(1_000))

    def update_providers(*args, **kwargs):
      if next(calls) == 2:
        raise RuntimeError('the score is 173.25')
      return update(*args, **kwargs)

    mechanism.phases.update_providers = update_providers

  with served.in_thread(alter=fail) as serving:
    with served.Client(serving.address) as client:
      client.join()
      client.step()
      client.step(np.zeros(6))
      client.step(np.zeros(6))
      with pytest.raises(
          error.DmEnvRpcError, match='the episode has failed'
      ) as caught:
        client.step(np.zeros(6))
      assert '173' not in str(caught.value)
      assert client.step().state == pb.RUNNING
    patience.until(lambda: len(serving.results) == 2)
    assert serving.ends()[0] == 'error'
  assert '173.25' in caplog.text  # The evaluator gets the message.


def test_a_provider_that_does_not_answer_fails(monkeypatch):
  ended = []

  def wait(self, *args):
    try:
      threading.Event().wait()
    except TimeoutError:
      ended.append(1)
      # A provider that catches the first error gets a second one.
      threading.Event().wait()

  with contextlib.closing(served.load()) as env:
    env.reset()
    seconds = patience.SECONDS
    env.mechanism.phases.guard_providers(
        lambda: served_evaluation.deadline(seconds)
    )
    env.step(np.zeros(6))
    seconds = 0.05
    monkeypatch.setattr(difference.Difference, 'step', wait)
    handler = signal.getsignal(signal.SIGALRM)
    with pytest.raises(
        errors.FeedbackProviderError,
        match=r'providers\[0\]:difference.*no answer within 0.05 s',
    ):
      env.step(np.zeros(6))
    assert ended
    monkeypatch.undo()
    seconds = patience.SECONDS
    # Nothing rings outside providers.
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert env.reset().first()
    assert not env.step(np.zeros(6)).first()
    assert signal.getsignal(signal.SIGALRM) is handler
