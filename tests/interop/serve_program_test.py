"""Tests of the program `serve`: agents, their logs, and other users."""

import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading

import pytest

from realab_suite.evaluation import results
from realab_suite.evaluation import stakes
from realab_suite.experiments import served_evaluation
from realab_suite.interop.rpc import agent_process
from realab_suite.interop.rpc import agent_server
from realab_suite.interop.rpc import sockets
from realab_suite.launchers import serve
from tests import patience
from tests.interop import served
from tests.launchers import in_process

_PYTHON = sys.executable
_SETSID = 'setsid'
_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')
_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')


# The program.


_IMPORTS_ARE_IMPOSSIBLE = """
import sys

class Refuse:
  def find_spec(self, name, path=None, target=None):
    if name.split('.')[0] in ('realab_suite', 'dm_control', 'mujoco'):
      raise ImportError(f'{name} is not for agents')
sys.meta_path.insert(0, Refuse())
"""


def _example():
  page = (served.ROOT / 'docs/doors.md').read_text()
  [block] = re.findall(r'```python\n(# agent.py\n.*?)```', page, re.DOTALL)
  return block


def test_the_documented_agent_does_not_import_this_package(tmp_path):
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
  assert [(row.end.value, row.num_steps, row.is_valid) for row in rows] == [
      ('timeout', 5, True)
  ] * 2
  assert {row.info.isolation for row in rows} == {results.SERVED}
  assert {tuple(stakes.of(row).parts) for row in rows} == {
      ('return', 'discounted return')
  }
  assert ran.stdout.count('Not judged: ') == 1
  assert 'the agent may run as the same user' in ran.stderr
  # The log may also contain messages of gRPC about the end of the server.
  said = (output / 'agent.log').read_text().splitlines()
  assert len([line for line in said if line.startswith('1.0 ')]) == 2
  assert output.stat().st_mode & 0o777 == 0o700
  description = json.loads((output / 'run.json').read_text())
  assert description['settings']['task'] == 'near'


@pytest.fixture(name='run')
def _run(monkeypatch):
  """Runs the program here, and keeps it from changing this process."""
  monkeypatch.setattr(served_evaluation, 'hide_from_debuggers', lambda: None)
  monkeypatch.setattr(os, 'umask', lambda mode: mode)
  handler = signal.getsignal(signal.SIGTERM)
  yield lambda *flags: in_process.run(serve, *flags)
  signal.signal(signal.SIGTERM, handler)


@pytest.fixture(name='interruptible')
def _interruptible():
  """Lets Ctrl-C interrupt; tests in the background of a script may ignore it.

  So would the programs that they start.
  """
  handler = signal.signal(signal.SIGINT, signal.default_int_handler)
  yield
  signal.signal(signal.SIGINT, handler)


def test_an_agent_that_ends_early_gives_one_line(tmp_path, run):
  ended = run(
      f'--output={tmp_path / "results"}', '--max_steps=3', '--design=none',
      f'--agent_command={_PYTHON} -c "raise SystemExit(3)"',
  )  # fmt: skip
  assert ended.status == 2
  assert 'exited with status 3' in ended.stderr.splitlines()[-1]
  assert 'after 0 of 2 episodes' in ended.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ('flags', 'complaint'),
    [
        ([], '--output'),
        (['--output=x', '--task=a.b', '--domain=c'], '--task=a.b'),
        (['--output=x', '--agent_folder=y'], '--agent_folder'),
        (['--output=x', '--target=y'], "flag 'target'"),
        (['--output=x', '--agent_user=nobody_of_that_name'], 'agent_user'),
        (['--output=/proc/x'], '/proc/x'),
        (['--output=x', '--provider_seconds=inf'], '--provider_seconds=inf'),
        (['--output=x', '--idle_seconds=nan'], '--idle_seconds=nan'),
        (['--output=x', '--idle_seconds=0'], '--idle_seconds=0'),
        (['--output=x', '--repeat=/no/run.json'], '/no/run.json: No such file'),
        (['--output=x', '--repeat=y', '--seed=0'], '--seed has no effect with'),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(run, flags, complaint):
  ended = run(*flags)
  assert ended.status == 2
  assert complaint in ended.stderr.splitlines()[-1]


def test_a_command_that_cannot_start_is_reported(tmp_path, run):
  ended = run(f'--output={tmp_path / "r"}', '--agent_command=/no/such/agent')
  assert ended.status == 2
  assert 'cannot start' in ended.stderr.splitlines()[-1]
  # The folder is removed, so that a corrected command can be rerun.
  assert not (tmp_path / 'r').exists()


def _start_agent(command, log):
  ended = threading.Event()
  agent = agent_process.AgentProcess(command, 'unix:/x', log, on_exit=ended.set)
  return agent, ended


def test_an_agent_has_ended_though_a_child_still_runs(tmp_path, monkeypatch):
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', 0.1)
  # A session of its own outlives the agent's group.
  agent, ended = _start_agent(
      f'sh -c "{_SETSID} sleep 1000000 & echo $!; exit 3"', tmp_path / 'log'
  )
  assert ended.wait(patience.SECONDS)
  assert agent.poll() == 3
  patience.until((tmp_path / 'log').read_bytes)
  agent.stop()
  child = int((tmp_path / 'log').read_bytes())
  os.kill(child, signal.SIGKILL)  # It is still there.


def test_the_log_of_an_agent_is_limited(tmp_path, monkeypatch):
  monkeypatch.setattr(agent_process, 'MAX_LOG_BYTES', 1000)
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', patience.SECONDS)
  program = "for i in range(9): print('x' * 100_000, flush=True)"
  agent, ended = _start_agent(f'{_PYTHON} -c "{program}"', tmp_path / 'log')
  assert ended.wait(patience.SECONDS)
  assert agent.poll() == 0
  agent.stop()
  said = (tmp_path / 'log').read_bytes()
  assert said.endswith(b'was not recorded\n')
  assert len(said) < 1000 + 2 * 65536


def test_a_log_that_cannot_be_written_does_not_stop_an_agent(
    caplog, monkeypatch
):
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', patience.SECONDS)
  agent, ended = _start_agent(
      f'{_PYTHON} -c "print(5 * 10**5 * \'x\')"', '/dev/full'
  )
  assert ended.wait(patience.SECONDS)
  agent.stop()
  assert 'the log of the agent ends here' in caplog.text


def test_an_agent_that_ignores_sigterm_is_killed(tmp_path, monkeypatch):
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', 0.1)
  agent, ended = _start_agent(
      """sh -c "trap '' TERM; echo stays; sleep 60" """, tmp_path / 'log'
  )
  patience.until((tmp_path / 'log').read_bytes)
  agent.stop()
  assert ended.wait(patience.SECONDS)
  assert agent.poll() == -signal.SIGKILL


@pytest.mark.parametrize(
    ('number', 'status', 'error'),
    [
        (signal.SIGTERM, 2, 'error: stopped after 1 of 2 episodes'),
        (
            signal.SIGINT,
            130,
            'error: interrupted; results up to this point are on disk',
        ),
    ],
)
@pytest.mark.usefixtures('interruptible')
def test_a_stopped_server_writes_its_results_and_one_line(
    tmp_path, number, status, error
):
  with served.in_process(
      tmp_path / 'results', '--max_steps=20', '--design=none'
  ) as program:
    with served.Client(program.address) as client:
      client.join()
      client.step()
      program.process.send_signal(number)
      said = program.process.stderr.read().splitlines()
      assert program.process.wait(patience.SECONDS) == status
  assert 'the agent may run as the same user' in said[0]
  assert said[1:] == [error]
  [row] = results.read_rows(tmp_path / 'results' / 'episodes.jsonl')
  assert row.end.value == 'disconnect'
  assert not pathlib.Path(sockets.path_of(program.address)).exists()


@pytest.mark.usefixtures('interruptible')
def test_an_interrupt_waits_for_the_answer_to_a_request(tmp_path, caplog):
  is_interrupted = []

  class World:
    """A world that Ctrl-C interrupts in the middle of an answer."""

    def connect(self):
      pass

    def answer(self, request):
      signal.raise_signal(signal.SIGINT)
      is_interrupted.append(False)
      return request

    def settle(self):
      return True

    disconnect = connect

  path = tmp_path / 'folder'
  path.mkdir(mode=0o700)
  server = agent_server.Server(World(), f'unix:{path / "socket"}')
  server.start()
  stream = served.RawStream(server.address)
  stream.tell(served.JOIN)
  with pytest.raises(KeyboardInterrupt):
    server.run()
  stream.close()
  assert is_interrupted == [False]
  assert not caplog.records
