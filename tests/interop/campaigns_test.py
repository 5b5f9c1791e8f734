"""Small slices of the campaigns against served worlds, and their controls."""

import collections
import itertools
import os
import pathlib
import tempfile
import tracemalloc

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
import pytest

from campaigns import digests_campaign
from campaigns import served_campaign
from campaigns import served_departures_campaign
from campaigns import served_limits_campaign
from campaigns import served_secrets_campaign
from tests.engine import helpers
from tests.interop import clones
from tests.interop import served


@pytest.fixture(name='serving', scope='module')
def _serving():
  with served.in_thread() as serving:
    yield serving


@pytest.fixture(name='stream')
def _stream(serving):
  stream = served.connect_eventually(serving.address)
  yield stream
  stream.close()


# C03.


def test_a_rollout_is_the_same_in_another_process_and_over_a_socket():
  chosen = digests_campaign.cases(2, 1, seed=0)
  found = digests_campaign.num_distinct(chosen, 30, ['hash seed 1'])
  assert found == [1, 1]


def test_a_rollout_of_another_seed_is_told_apart():
  digests = {
      digests_campaign.in_process(case, 5)
      for case in digests_campaign.cases(1, 2, seed=0)
  }
  assert len(digests) == 2


# C08 and C09; C19.


@pytest.mark.parametrize('secret', ['a number', 'an error', 'a listener'])
def test_no_byte_on_the_wire_tells_of_a_secret(secret):
  alter = served_secrets_campaign.SECRETS[secret]
  found = served_secrets_campaign.wire(alter, steps=12)
  assert found == served_secrets_campaign.wire(lambda env: None, steps=12)
  assert len(served_secrets_campaign.sizes_of_steps(found)) == 1
  assert len(found) > 30


def test_the_pairs_differ_where_something_may_be_told():
  def pay(env):
    latch = env.task.latch_events

    def latch_events(physics):
      env.task.earn(physics, 1.0)
      latch(physics)

    env.task.latch_events = latch_events

  design = 'instantaneous_reward'
  found = served_secrets_campaign.wire(pay, design)
  assert found != served_secrets_campaign.wire(lambda env: None, design)


@pytest.mark.parametrize('channel', ['L32', 'L33', 'L34', 'L35', 'L37'])
def test_a_planted_leak_is_caught(channel):
  assert served_secrets_campaign.LEAKS[channel]()


def test_a_planted_leak_by_time_is_caught():
  clock = served_secrets_campaign.FakeClock(seed=0)
  assert served_secrets_campaign.catch_l36(100, clock.sleep, clock)


def test_what_takes_no_longer_is_no_leak():
  clock = served_secrets_campaign.FakeClock(seed=0)
  assert not served_secrets_campaign.catch_l36(100, lambda _: None, clock)


def test_an_agent_is_given_nothing_of_its_evaluators():
  found = served_secrets_campaign.expose()
  assert not served_secrets_campaign.exposed(found.given, found.secrets)
  assert not found.wide_modes
  assert len(found.given['descriptors']) >= 3


# C10.


def test_a_canary_is_nowhere_but_with_the_evaluator():
  found = served_secrets_campaign.search(173.23170943)
  assert found.num_bytes > 2**20
  assert found.num_files >= 10 or os.geteuid() != 0
  assert [found.in_wire, found.in_agent, found.in_reach] == [[]] * 3
  assert 'row' in found.in_evaluator
  assert 'f8 little-endian' in found.in_evaluator
  assert 'salt: bytes' in found.in_evaluator


@pytest.mark.skipif(os.geteuid() != 0, reason='needs root')
def test_what_is_left_open_to_other_users_is_found():
  with tempfile.TemporaryDirectory() as folder:
    os.chmod(folder, 0o755)
    for name, mode in (('open', 0o644), ('closed', 0o600)):
      path = pathlib.Path(folder, name)
      path.write_text(name)
      path.chmod(mode)
    roots = [pathlib.Path(folder)]
    found = served_secrets_campaign.read_as_another_user(roots)
  assert found == (1, b'open')


def test_a_salt_is_found_in_every_form():
  salt = bytes(range(16))
  for name, form in clones.forms_of(salt).items():
    data = b'\x01' * 5 + form + b'x'
    assert f'salt: {name}' in served_secrets_campaign.salt_hits(data, salt)
  assert not served_secrets_campaign.salt_hits(bytes(100), salt)


def test_a_canary_is_found_in_every_form():
  patterns = served_secrets_campaign.patterns(173.2317)
  for name, pattern in patterns.items():
    assert name in served_secrets_campaign.hits(b'\x00' * 8 + pattern, 173.2317)
  assert not served_secrets_campaign.hits(bytes(100), 173.2317)


# C16.


def test_no_uid_and_no_message_gives_more_than_the_spec(stream):
  found = served_campaign.sweep(stream, 300, 50, seed=1)
  assert (found.num_observations, found.num_strange) == (9, 0)
  assert found.num_asked > 350


# C24.


def test_mutated_messages_have_one_answer_each(stream):
  found = served_campaign.fuzz(stream.ask, 600, seed=1)
  assert sum(found.answers.values()) == 600
  assert found.num_strange == 0
  assert {'step', 'join_world', 'R01', 'R12', 'R13', 'R14'} <= set(
      found.answers
  )


def test_hostile_sequences_are_answered_as_the_model_says(serving):
  seen, wrong = served_campaign.sequences(
      lambda: served.connect_eventually(serving.address), 40, seed=1
  )
  assert wrong == 0
  assert len(seen) >= 15


def test_a_port_that_answers_otherwise_is_found_out():
  refused = pb.EnvironmentResponse()
  refused.error.message = 'KeyError: /home/me'
  answers = collections.deque([refused.SerializeToString()] * 10)
  found = served_campaign.fuzz(lambda data: answers.popleft(), 10, seed=1)
  assert found.num_strange == 10


# C25.


def test_bombs_and_floods_do_not_disturb_the_agent():
  steps = 25
  digests = []
  for is_attacked in (False, True):
    with served.in_thread() as another:
      program = served.Program(another.address, None, None)
      stream = served.connect_eventually(another.address)
      for request in (served.JOIN, served.STEP):
        stream.ask(request)
      if is_attacked:
        tracemalloc.start()
        refused, _ = served_limits_campaign.bomb(stream, program)
        _, largest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert refused == 8
        # A shape that was believed would take at least 3 GiB.
        assert largest < 16 * 2**20
        refused, _ = served_limits_campaign.many_settings(
            stream, program, 3_000
        )
        assert refused == 1
        refused, _ = served_limits_campaign.large_messages(stream, program)
        assert refused == 5
        refused, _ = served_limits_campaign.many_connections(
            stream, program, 30
        )
        assert refused == 10
      digests.append(served_limits_campaign.rollout(stream, steps))
      stream.close()
  assert digests[0] == digests[1]


# C26.


def test_whoever_goes_away_at_any_point_leaves_a_free_world(serving):
  before = len(serving.results)
  found = served_departures_campaign.go_away_everywhere(
      serving.address, 1, ('cancel', 'close')
  )
  found += served_departures_campaign.go_away_everywhere(
      serving.address, 1, ('kill',), points=(1, 5, 11)
  )
  assert len(found) == 27
  assert all(one.is_clean for one in found)
  # All found the world free, though the clock of the server stood still.
  ends = [end for end in serving.ends()[before:] if end == 'disconnect']
  assert len(ends) == 5 * 2 + 2


def test_a_client_that_is_stopped_loses_the_world():
  with served.in_thread() as serving:
    [found] = served_departures_campaign.go_away_everywhere(
        serving.address,
        1,
        ('stop',),
        points=(5,),
        let_idle=serving.clock.advance,
    )
    assert found.is_clean
    assert serving.ends()[0] == 'disconnect'


def test_who_wakes_up_late_disturbs_nobody():
  points = list(served_departures_campaign.POINTS)
  chosen = [points.index('joined'), points.index('waiting for an answer')]
  with served.in_thread() as serving:
    found = served_departures_campaign.wake_up_late(
        serving.address, 0.1, chosen, serving.clock.advance
    )
    assert (found.num_awake, found.is_undisturbed) == (2, True)


def test_a_step_that_somebody_else_takes_is_noticed():
  def alter(world):
    answer, count = world.answer, itertools.count()

    def answer_twice(request):
      if request == served.STEP and next(count) == 70:
        answer(request)
      return answer(request)

    world.answer = answer_twice

  with served.in_thread(alter=alter) as serving:
    play = served_departures_campaign.play
    assert play(serving.address) != play(serving.address)


def test_the_secrets_of_these_tests_reach_the_evaluator():
  env = served.load('none', 5)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  served_secrets_campaign.SECRETS['a number'](env)
  for _ in range(3):
    env.step(served.still(env))
  env.close()
  assert [float(step.true_reward) for step in sink.steps] == [173.2317] * 2
