"""Tests of the program `serve`: agents, their logs, and signals."""

import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading

import pytest

from realab_suite.doors.served import agent_process
from realab_suite.doors.served import agent_server
from realab_suite.doors.served import served_evaluation
from realab_suite.doors.served import sockets
from realab_suite.evaluation import results
from realab_suite.lab.verdicts import stakes
from realab_suite.launchers import serve
from tests import patience
from tests.doors.served import served
from tests.launchers import in_process

_PYTHON = sys.executable
_SECRET_SEED = 2**127 + 1


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
  assert 'a process alone is no boundary' in ran.stderr
  # The log may also contain messages of gRPC about the end of the server.
  said = (output / 'agent.log').read_text().splitlines()
  assert len([line for line in said if line.startswith('1.0 ')]) == 2
  modes = {path.stat().st_mode & 0o077 for path in (output, *output.iterdir())}
  assert modes == {0}
  description = json.loads((output / 'run.json').read_text())
  assert description['settings']['world']['task'] == 'near'


@pytest.fixture(name='run')
def _run(monkeypatch):
  """Runs the program here, and keeps it from changing this process."""
  monkeypatch.setattr(served_evaluation, 'hide_from_debuggers', lambda: None)
  monkeypatch.setattr(os, 'umask', lambda mode: mode)
  numbers = signal.SIGTERM, signal.SIGINT
  handlers = {number: signal.getsignal(number) for number in numbers}
  yield lambda *flags: in_process.run(serve, *flags)
  for number, handler in handlers.items():
    signal.signal(number, handler)


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
        (['--output=x', '--target=y'], "flag 'target'"),
        (['--output=/proc/x'], '/proc/x'),
        (['--output=x', '--idle_seconds=0'], '--idle_seconds=0'),
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


_SHOW_WHAT_IS_GIVEN = """
import json, os
descriptors = '/proc/self/fd'
print(json.dumps([dict(os.environ), [
    os.readlink(f'{descriptors}/{name}') for name in os.listdir(descriptors)
    if os.path.exists(f'{descriptors}/{name}')
]]))
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')
def test_an_agent_inherits_nothing_of_its_evaluator(tmp_path, monkeypatch):
  monkeypatch.setenv('EVALUATORS_SECRET', 'secret')
  program, log = tmp_path / 'agent.py', tmp_path / 'log'
  program.write_text(_SHOW_WHAT_IS_GIVEN)
  with open(tmp_path / 'rows', 'w') as rows:
    os.set_inheritable(rows.fileno(), True)
    agent, ended = _start_agent(f'{_PYTHON} {program}', log)
    assert ended.wait(patience.SECONDS)
  agent.stop()
  variables, descriptors = json.loads(log.read_text())
  assert variables['REALAB_ADDRESS'] == 'unix:/x'
  assert 'EVALUATORS_SECRET' not in variables
  assert sorted(descriptors) == ['/dev/null', str(log), str(log)]


def test_an_agent_that_ignores_sigterm_is_killed(tmp_path, monkeypatch):
  monkeypatch.setattr(agent_process, '_PATIENCE_SECONDS', 0.1)
  agent, ended = _start_agent(
      """sh -c "trap '' TERM; echo stays; sleep 60" """, tmp_path / 'log'
  )
  patience.until((tmp_path / 'log').read_bytes)
  agent.stop()
  assert ended.wait(patience.SECONDS)
  assert agent.poll() == -signal.SIGKILL


def test_a_stopped_server_writes_its_results_and_one_line(tmp_path):
  (tmp_path / 'flags').write_text(f'--seed={_SECRET_SEED}\n')
  process = subprocess.Popen(
      [
          _PYTHON, '-m', 'realab_suite.launchers.serve', '--design=none',
          '--task=unlock_door.near', '--max_steps=20',
          f'--output={tmp_path / "results"}',
          f'--flagfile={tmp_path / "flags"}',
      ],
      cwd=served.ROOT, text=True,
      stdout=subprocess.PIPE, stderr=subprocess.PIPE,
  )  # fmt: skip
  with process:
    address = process.stdout.readline().split(' at ')[1].strip()
    with served.Client(address) as client:
      client.join()
      client.step()
      process.terminate()
      said = process.stderr.read().splitlines()
      assert process.wait(patience.SECONDS) == 2
  assert 'a process alone is no boundary' in said[0]
  assert said[1:] == ['error: stopped after 0 of 2 episodes']
  [row] = results.read_rows(tmp_path / 'results' / 'episodes.jsonl')
  assert (row.end.value, row.seed) == ('disconnect', _SECRET_SEED)
  assert not pathlib.Path(sockets.path_of(address)).exists()


def test_an_interrupt_waits_for_the_answer_to_a_request(tmp_path, caplog):
  is_interrupted = []

  class World:
    """A world that Ctrl-C interrupts in the middle of an answer."""

    def answer(self, request):
      signal.raise_signal(signal.SIGINT)
      is_interrupted.append(False)
      return request

    def settle(self):
      return True

    def disconnect(self):
      pass

  server = agent_server.Server(World(), f'unix:{tmp_path / "socket"}')
  server.start()
  stream = served.RawStream(server.address)
  stream.tell(served.JOIN)
  handler = signal.getsignal(signal.SIGINT)
  server.stop_on(signal.SIGINT)
  server.run()
  signal.signal(signal.SIGINT, handler)
  stream.close()
  assert is_interrupted == [False]
  assert not caplog.records
