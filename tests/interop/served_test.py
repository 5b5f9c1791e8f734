"""Tests served worlds over a socket: who is let in, and how they leave."""

from concurrent import futures
import contextlib
import json
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import error
import grpc
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.evaluation import actors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.evaluation import statistics
from realab_suite.experiments import aiming
from realab_suite.experiments import served_evaluation
from realab_suite.feedback.providers import difference
from realab_suite.interop.rpc import agent_process
from realab_suite.interop.rpc import agent_server
from realab_suite.interop.rpc import sockets
from tests import patience
from tests.engine import helpers
from tests.interop import served

_PYTHON = sys.executable
_NOBODY = 65534
_SETSID = 'setsid'
_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')
_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')


@pytest.fixture(name='serving')
def _serving():
  with served.in_thread() as serving:
    yield serving


def _play(env, actions):
  """Returns what an agent gets, canonically, from a reset on."""
  time_steps = [env.reset()]
  for action in actions:
    time_steps.append(env.step(action))
  return [served.to_bytes(time_step) for time_step in time_steps]


def test_a_stock_client_gets_what_an_agent_in_the_process_gets(serving):
  env = served.load()
  actions = helpers.random_actions(env, 45)
  expected = _play(env, actions)
  env.close()
  with served.Client(serving.address) as client:
    served_env = client.env()
    [name] = served_env.action_spec()
    found = _play(served_env, [{name: action} for action in actions])
  assert found == expected
  assert serving.ends()[:2] == ['timeout', 'timeout']


def test_a_second_client_is_turned_away_at_once():
  is_asked, may_answer = threading.Event(), threading.Event()

  def hold(world):
    answer = world.answer

    def answer_later(request):
      is_asked.set()
      may_answer.wait(patience.SECONDS)
      return answer(request)

    world.answer = answer_later

  with (
      served.in_thread(alter=hold) as serving,
      served.Client(serving.address) as first,
      futures.ThreadPoolExecutor(1) as pool,
  ):
    joined = pool.submit(first.join)
    is_asked.wait(patience.SECONDS)
    # While the world is busy with the first one's request.
    with served.Client(serving.address) as second:
      with pytest.raises(grpc.RpcError) as caught:
        second.join()
    assert not joined.done()
    may_answer.set()
    joined.result()
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert caught.value.details() == 'R17: another agent is connected'
    assert first.step().state == pb.RUNNING


def test_a_client_that_goes_leaves_an_invalid_episode_and_a_free_world(serving):
  first = served.Client(serving.address)
  first.join()
  first.step()
  first.step(np.zeros(6))
  first.close()
  second = served.join_eventually(serving.address)
  assert second.step().state == pb.RUNNING
  second.close()
  patience.until(lambda: len(serving.results) == 2)
  assert serving.ends() == ['disconnect'] * 2
  assert [result.num_steps for result, _ in serving.results] == [1, 0]
  assert not any(result.is_valid for result, _ in serving.results)


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


def test_tampering_in_an_episode_that_is_given_up_counts():
  agent, honest = [], []
  for seed in range(5):
    with served.in_thread(lambda seed=seed: _load_longer(seed)) as serving:
      with served.Client(serving.address) as client:
        client.join()
        # A step begins each of the episodes.
        while client.step(np.zeros(6)).state == pb.RUNNING:
          pass
        client.step()
        for action in _tampering(seed):
          client.step(action)
        if seed % 2:  # The others leave without a word.
          client.send(pb.LeaveWorldRequest())
      patience.until(lambda serving=serving: len(serving.results) == 2)
      agent += [result for result, _ in serving.results]
    with contextlib.closing(_load_longer(seed)) as env:
      honest += evaluate.evaluate(env, lambda _, env=env: served.still(env), 2)
  assert [result.end.value for result in agent[1::2]] == [
      'disconnect', 'abandoned', 'disconnect', 'abandoned', 'disconnect',
  ]  # fmt: skip
  assert [result.is_valid for result in agent] == 5 * [True, False]
  found = comparison.compare({'agent': agent, 'honest': honest}, 'honest')
  verdict = found['agent'].verdict
  assert verdict.outcome is statistics.Outcome.TAMPERS_MORE
  assert verdict.num_censored == 5


def test_a_client_that_goes_between_episodes_leaves_nothing(serving):
  served.join_eventually(serving.address).close()
  with served.join_eventually(serving.address):
    assert serving.ends() == []


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


def test_a_client_that_says_something_now_and_then_stays():
  with served.in_thread() as serving:
    with served.Client(serving.address) as client:
      client.join()
      for i in range(5):
        serving.clock.advance(0.9 * served.IDLE_SECONDS)
        client.step(np.zeros(6) if i else None)
      assert serving.ends() == []


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


def test_a_large_message_ends_the_stream_and_the_world_is_free(serving):
  with served.Client(serving.address) as client:
    client.join()
    settings = {'x': pb.Tensor(int8s=pb.Tensor.Int8Array(array=b'0' * 2**21))}
    with pytest.raises(grpc.RpcError) as caught:
      client.send(pb.ResetRequest(settings=settings))
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
  served.join_eventually(serving.address).close()


def test_what_is_compressed_is_not_unpacked(serving):
  channel = grpc.insecure_channel(
      serving.address, compression=grpc.Compression.Gzip
  )
  call = channel.stream_stream(served.STEP)
  with pytest.raises(grpc.RpcError) as caught:
    next(call(iter([served.request(leave_world=pb.LeaveWorldRequest())])))
  assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED
  channel.close()


def test_other_methods_are_unknown(serving):
  with grpc.insecure_channel(serving.address) as channel:
    call = channel.unary_unary('/grpc.reflection.v1.ServerReflection/Info')
    with pytest.raises(grpc.RpcError) as caught:
      call(b'')
  assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED


def test_after_the_last_episode_the_server_ends():
  with served.in_thread(num_episodes=1) as serving:
    with served.Client(serving.address) as client:
      client.join()
      states = [client.step(np.zeros(6)).state for _ in range(21)]
      assert states[-1] == pb.INTERRUPTED
      with pytest.raises(
          error.DmEnvRpcError, match='R16: there are no more episodes'
      ):
        client.step()
    serving.thread.join(patience.SECONDS)
    assert not serving.thread.is_alive()
    assert serving.ends() == ['timeout']


def test_a_failing_provider_ends_the_episode_and_says_nothing(caplog):
  def fail(world):
    mechanism = world._env.mechanism
    update = mechanism.update_providers

    calls = iter(range(1_000))

    def update_providers(*args, **kwargs):
      if next(calls) == 2:
        raise RuntimeError('the score is 173.25')
      return update(*args, **kwargs)

    mechanism.update_providers = update_providers

  with served.in_thread(alter=fail) as serving:
    with served.Client(serving.address) as client:
      client.join()
      client.step()
      client.step(np.zeros(6))
      client.step(np.zeros(6))
      with pytest.raises(error.DmEnvRpcError, match='R15') as caught:
        client.step(np.zeros(6))
      assert '173' not in str(caught.value)
      assert client.step().state == pb.RUNNING
    patience.until(lambda: len(serving.results) == 2)
    assert serving.ends()[0] == 'error'
  assert '173.25' in caplog.text  # The evaluator is told.


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
    env.mechanism.guard_providers(lambda: served_evaluation.deadline(seconds))
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


# Where a server listens.


class _Nothing(agent_server.Service):
  """A world that has nothing to say."""

  def connect(self):
    pass

  def answer(self, request):
    return request

  def disconnect(self):
    pass

  def settle(self):
    return True


@pytest.mark.parametrize(
    'address',
    ['socket', 'unix:socket', 'unix:/' + 'x' * 200, 'localhost:http', ':1'],
)
def test_an_address_that_is_none_is_refused(address):
  with pytest.raises(errors.SpecError, match='address: '):
    agent_server.Server(_Nothing(), address).start()


def test_a_folder_that_others_may_enter_is_refused(tmp_path):
  tmp_path.chmod(0o755)
  with pytest.raises(errors.SpecError, match='mode 0755; allowed is 0700'):
    agent_server.Server(_Nothing(), f'unix:{tmp_path}/socket').start()


def test_a_link_to_a_folder_is_refused(tmp_path):
  (tmp_path / 'own').mkdir(mode=0o700)
  (tmp_path / 'link').symlink_to(tmp_path / 'own')
  with pytest.raises(errors.SpecError, match='is no folder of user'):
    agent_server.Server(_Nothing(), f'unix:{tmp_path}/link/socket').start()


@_is_root
def test_a_folder_of_somebody_else_is_refused(tmp_path):
  (tmp_path / 'theirs').mkdir(mode=0o700)
  os.chown(tmp_path / 'theirs', _NOBODY, _NOBODY)
  address = f'unix:{tmp_path}/theirs/socket'
  for owner in (None, (_NOBODY, _NOBODY)):
    with pytest.raises(errors.SpecError, match='is no folder of user 0'):
      agent_server.Server(_Nothing(), address, owner=owner).start()


@_is_root
def test_a_folder_is_for_the_group_of_whoever_connects_now(tmp_path):
  folder = tmp_path / 'own'
  for group in (_NOBODY, _NOBODY - 1):
    with sockets.prepared(f'unix:{folder}/socket', (_NOBODY, group)):
      (folder / 'socket').touch()
    status = folder.stat()
    assert (status.st_mode & 0o777, status.st_gid) == (0o710, group)
    (folder / 'socket').unlink()
  with pytest.raises(errors.SpecError, match='cannot make folder'):
    with sockets.prepared(f'unix:{tmp_path}/a/b/s', (_NOBODY, _NOBODY)):
      pass


def test_a_port_is_not_for_one_user_alone():
  with pytest.raises(errors.SpecError, match='anybody could connect'):
    agent_server.Server(_Nothing(), 'localhost:0', owner=(1, 1)).start()


@_is_root
def test_nothing_can_be_kept_from_root():
  with pytest.raises(errors.SpecError, match='is root'):
    agent_process.owner_of('root')


def test_a_socket_is_its_users_alone(serving):
  path = sockets.path_of(serving.address)
  assert path.parent.stat().st_mode & 0o777 == 0o700
  assert path.stat().st_mode & 0o777 == 0o600


def test_an_address_in_use_is_refused(serving):
  with pytest.raises(errors.SpecError, match='somebody listens'):
    agent_server.Server(_Nothing(), serving.address).start()
  with served.Client(serving.address) as client:
    client.join()


def test_a_socket_that_a_killed_server_left_is_taken_over(tmp_path):
  tmp_path.chmod(0o700)
  with socket.socket(socket.AF_UNIX) as killed:
    killed.bind(str(tmp_path / 'socket'))
  server = agent_server.Server(_Nothing(), f'unix:{tmp_path}/socket')
  server.start()
  server.stop()
  server.run()
  assert not (tmp_path / 'socket').exists()


def test_a_port_of_this_machine_can_be_served():
  server = agent_server.Server(_Nothing(), 'localhost:0')
  server.start()
  assert re.fullmatch(r'localhost:[1-9]\d*', server.address)
  thread = threading.Thread(target=server.run)
  thread.start()
  stream = served.RawStream(server.address)
  assert stream.ask(b'echo') == b'echo'
  stream.close()
  server.stop()
  thread.join()


def test_what_breaks_off_an_answer_leaves_nobody_waiting(tmp_path):
  # Python waits for the threads of pools when it ends.
  program = f"""
import threading
from realab_suite.interop.rpc import agent_server
from tests.interop import served, served_test
def interrupt(request):
  raise KeyboardInterrupt
world = served_test._Nothing()
world.answer = interrupt
made = server.Server(world, 'unix:{tmp_path}/s/socket')
made.start()
stream = served.RawStream(made.address)
threading.Thread(target=stream.ask, args=(b'x',), daemon=True).start()
try:
  made.run()
except KeyboardInterrupt:
  raise SystemExit(7)
"""
  ran = subprocess.run(
      [_PYTHON, '-c', program], cwd=served.ROOT, timeout=patience.SECONDS,
      check=False, stderr=subprocess.DEVNULL,
  )  # fmt: skip
  assert ran.returncode == 7


def test_a_server_does_not_survive_a_fork(tmp_path):
  program = f"""
import os
from realab_suite import errors
from realab_suite.interop.rpc import agent_server
from tests.interop import served_test
made = server.Server(served_test._Nothing(), 'unix:{tmp_path}/s/socket')
child = os.fork()
if not child:
  try:
    made.run()
  except errors.ForkError:
    os._exit(7)
  os._exit(0)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
  ran = subprocess.run(
      [_PYTHON, '-c', program],
      cwd=served.ROOT,
      timeout=patience.SECONDS,
      check=False,
  )
  assert ran.returncode == 7


# As people start it.

_IMPORTS_ARE_IMPOSSIBLE = """
import sys
class Refuse:
  def find_spec(self, name, path=None, target=None):
    if name.split('.')[0] in ('realab_suite', 'dm_control', 'mujoco'):
      raise ImportError(f'{name} is not for agents')
sys.meta_path.insert(0, Refuse())
"""


def _example():
  page = (served.ROOT / 'docs/served.md').read_text()
  [block] = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
  return block


def test_the_agent_of_the_page_needs_nothing_of_this_package(tmp_path):
  agent = tmp_path / 'agent.py'
  agent.write_text(_IMPORTS_ARE_IMPOSSIBLE + _example())
  output = tmp_path / 'results'
  ran = subprocess.run(
      [
          _PYTHON, '-W', 'error', '-m', 'realab_suite.launchers.serve',
          '--task=unlock_door.near', '--max_steps=5', '--episodes=2',
          f'--agent_command={_PYTHON} {agent}', f'--output={output}',
      ],
      cwd=served.ROOT, capture_output=True, text=True, check=False,
      timeout=patience.SECONDS,
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  rows = list(results.read_rows(output / 'episodes.jsonl'))
  assert [(row.end, row.num_steps, row.is_valid) for row in rows] == [
      ('timeout', 5, True)
  ] * 2
  assert {row.info.isolation for row in rows} == {results.SERVED}
  assert 'the agent may run as the same user' in ran.stderr
  # Besides what it says, there may be what gRPC logs when a server goes.
  said = (output / 'agent.log').read_text().splitlines()
  assert len([line for line in said if line.startswith('1.0 ')]) == 2
  assert output.stat().st_mode & 0o777 == 0o700
  description = json.loads((output / 'run.json').read_text())
  assert description['settings']['task'] == 'near'


def test_an_import_of_this_package_is_made_impossible_above():
  program = _IMPORTS_ARE_IMPOSSIBLE + 'import realab_suite'
  ran = subprocess.run(
      [_PYTHON, '-c', program],
      cwd=served.ROOT, capture_output=True, text=True, check=False,
  )  # fmt: skip
  assert 'realab_suite is not for agents' in ran.stderr


def _serve(*flags):
  return subprocess.run(
      [_PYTHON, '-m', 'realab_suite.launchers.serve', *flags],
      cwd=served.ROOT, capture_output=True, text=True, check=False,
      timeout=patience.SECONDS,
  )  # fmt: skip


def test_an_agent_that_ends_too_early_is_told_of_in_one_line(tmp_path):
  output = tmp_path / 'results'
  ran = _serve(
      f'--output={output}',
      f'--agent_command={_PYTHON} -c "raise SystemExit(3)"',
  )
  assert ran.returncode == 2
  assert 'ended with status 3' in ran.stderr.splitlines()[-1]
  assert 'after 0 of 2 episodes' in ran.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ('flags', 'complaint'),
    [
        ([], '--output'),
        (['--output=x', '--task=a.b', '--domain=c'], '--task=a.b'),
        (['--output=x', '--agent_folder=y'], '--agent_folder'),
        (['--output=x', '--target=y'], '--target'),
        (['--output=x', '--agent_user=nobody_of_that_name'], 'agent_user'),
        (['--output=/proc/x'], '/proc/x'),
        (['--output=x', '--provider_seconds=inf'], '--provider_seconds=inf'),
        (['--output=x', '--idle_seconds=nan'], '--idle_seconds=nan'),
        (['--output=x', '--idle_seconds=0'], '--idle_seconds=0'),
        (['--output=x', '--repeat=/no/run.json'], '/no/run.json: No such file'),
        (['--output=x', '--repeat=y', '--seed=0'], '--seed has no effect with'),
    ],
)
def test_what_is_wrong_with_a_command_is_said_in_one_line(flags, complaint):
  ran = _serve(*flags)
  assert ran.returncode == 2
  assert complaint in ran.stderr.splitlines()[-1]


def test_a_command_that_cannot_start_is_told_of(tmp_path):
  ran = _serve(f'--output={tmp_path / "r"}', '--agent_command=/no/such/agent')
  assert ran.returncode == 2
  assert 'cannot start' in ran.stderr.splitlines()[-1]
  # The same command, mended, is not told that the folder is not empty.
  assert not (tmp_path / 'r').exists()


def _start_agent(command, log):
  ended = threading.Event()
  agent = agent_process.AgentProcess(command, 'unix:/x', log, on_exit=ended.set)
  return agent, ended


def test_an_agent_has_ended_though_its_children_say_something(tmp_path):
  with open(tmp_path / 'log', 'wb') as log:
    # A session of its own outlives the agent's group.
    agent, ended = _start_agent(
        f'sh -c "{_SETSID} sleep 1000000 & echo $!; exit 3"', log
    )
    assert ended.wait(patience.SECONDS)
    assert agent.poll() == 3
    patience.until((tmp_path / 'log').read_bytes)
    agent.stop()
  child = int((tmp_path / 'log').read_bytes())
  os.kill(child, signal.SIGKILL)  # It is still there.


def test_the_log_of_an_agent_has_an_end(tmp_path, monkeypatch):
  monkeypatch.setattr(agent_process, 'MAX_LOG_BYTES', 1000)
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', patience.SECONDS)
  program = "for i in range(9): print('x' * 100_000, flush=True)"
  with open(tmp_path / 'log', 'wb') as log:
    agent, ended = _start_agent(f'{_PYTHON} -c "{program}"', log)
    assert ended.wait(patience.SECONDS)
    assert agent.poll() == 0
    agent.stop()
  said = (tmp_path / 'log').read_bytes()
  assert said.endswith(b'which has not been kept\n')
  assert len(said) < 1000 + 2 * 65536


def test_a_log_that_cannot_be_written_does_not_stop_an_agent(
    caplog, monkeypatch
):
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', patience.SECONDS)
  with open('/dev/full', 'wb', buffering=0) as log:
    agent, ended = _start_agent(f'{_PYTHON} -c "print(5 * 10**5 * \'x\')"', log)
    assert ended.wait(patience.SECONDS)
    agent.stop()
  assert 'the log of the agent ends here' in caplog.text


def test_an_agent_that_does_not_want_to_end_is_ended(tmp_path):
  agent = tmp_path / 'agent.py'
  stubborn = (
      'import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n'
  )
  agent.write_text(
      f'{stubborn}print("stays", flush=True)\n{_example()}time.sleep(1e6)\n'
  )
  output = tmp_path / 'results'
  ran = _serve(
      '--max_steps=3', f'--output={output}',
      f'--agent_command={_PYTHON} {agent}',
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  assert 'stays' in (output / 'agent.log').read_text()


def test_a_server_that_is_asked_to_end_writes_down_what_there_is(tmp_path):
  with served.in_process(tmp_path / 'results') as program:
    with served.Client(program.address) as client:
      client.join()
      client.step()
      program.process.send_signal(signal.SIGTERM)
      assert program.process.wait(patience.SECONDS) == 2
  [row] = results.read_rows(tmp_path / 'results' / 'episodes.jsonl')
  assert row.end == 'disconnect'
  assert not pathlib.Path(sockets.path_of(program.address)).exists()


# Who is who.


@_is_linux
@_is_root
def test_a_client_of_another_user_makes_tier_t2(tmp_path):
  with served.in_process(
      tmp_path / 'results', '--agent_user=nobody', '--max_steps=3'
  ) as program:
    agent = (
        textwrap.dedent("""
        import grpc, numpy.random, os, pwd
        from dm_env_rpc.v1 import connection, dm_env_adaptor
        nobody = pwd.getpwnam('nobody')
        os.setgroups([]); os.setgid(nobody.pw_gid); os.setuid(nobody.pw_uid)
        """)
        + _example()
        .partition('import numpy as np\n')[2]
        .replace('np.', 'numpy.')
    )
    ran = subprocess.run(
        [_PYTHON, '-c', agent],
        env={**os.environ, 'REALAB_ADDRESS': program.address},
        capture_output=True, text=True, timeout=patience.SECONDS, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert program.process.wait(patience.SECONDS) == 0
  rows = list(results.read_rows(tmp_path / 'results' / 'episodes.jsonl'))
  assert [row.info.isolation for row in rows] == [
      results.SERVED_TO_ANOTHER_USER
  ] * 2


_READ_MEMORY = """
import os, pwd, subprocess, sys
import ctypes
from realab_suite.experiments import served_evaluation
os.setuid(pwd.getpwnam('nobody').pw_uid)
ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)  # A change of user has hidden it.
if sys.argv[1] == 'hide':
  serving.hide_from_debuggers()
child = os.fork()
if not child:
  ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)
  try:
    open(f'/proc/{os.getppid()}/mem', 'rb')
  except PermissionError:
    os._exit(13)
  os._exit(0)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@_is_linux
@_is_root
@pytest.mark.parametrize(('how', 'status'), [('hide', 13), ('show', 0)])
def test_the_memory_of_a_world_is_not_for_others_of_the_same_user(how, status):
  ran = subprocess.run(
      [_PYTHON, '-W', 'ignore', '-c', _READ_MEMORY, how],
      cwd=served.ROOT, timeout=patience.SECONDS, check=False,
  )  # fmt: skip
  assert ran.returncode == status
