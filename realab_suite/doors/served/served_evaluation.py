"""Evaluation of an agent in another process, which the world is served to."""

from collections.abc import Callable, Iterator
import contextlib
import ctypes
import dataclasses
import os
import pathlib
import shutil
import signal
import sys
import tempfile
from typing import Any, final

from absl import logging

from realab_suite import errors
from realab_suite import worlds
from realab_suite.doors.served import agent_process
from realab_suite.doors.served import agent_server
from realab_suite.doors.served import served_world
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import storage

_PR_SET_DUMPABLE = 4  # Of prctl(2).
_PROVIDER_SECONDS = 60.0  # Time limit of a provider for one step.
_AGENT = 'agent'  # Name of the run.

_WARNING = (
    'a process alone is no boundary (isolation "%s"): the code of the agent may'
    ' access files and processes of this user, also the results. Run hostile'
    ' code in a container without network (docs/doors.md).'
)
_NO_CONTROL = (
    'a served run has no control; serve the control with the same flags, and'
    ' compare the rows'
)


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of a served run.

  Attributes:
    world: World of the episodes.
    design: Agent design, by name or path.
    overrides: Dotted overrides of the design.
    seed: Seed of the episodes. An agent that has it can clone the world.
    num_episodes: Number of episodes, including failed ones.
    address: Address to listen on, or `None` for a socket in a new folder.
    idle_seconds: Maximum time between requests of the agent.
    agent_command: Command that starts the agent, or `None` if it is started
      separately.
    output: New folder for the results.
  """

  world: worlds.World
  design: str
  overrides: tuple[str, ...]
  seed: int
  num_episodes: int
  address: str | None
  idle_seconds: float
  agent_command: str | None
  output: str


def serve(settings: Settings, say: Callable[[str], None]) -> None:
  """Serves a world until all episodes have ended, and writes their rows.

  Args:
    settings: Settings of the run.
    say: Called with messages for the user.

  Raises:
    RealabError: If the settings are invalid, or the agent exits before all
      episodes have ended.
  """
  hide_from_debuggers()
  # Only this user can access files and sockets that are created from here on.
  os.umask(0o077)
  logging.warning(_WARNING, results.SERVED)
  world = settings.world
  with contextlib.ExitStack() as stack:
    design = world.fitted(specs.load(settings.design, settings.overrides))
    env = world.load(design, settings.seed)
    stack.callback(env.close)
    env.mechanism.phases.guard_providers(lambda: deadline(_PROVIDER_SECONDS))
    address = settings.address
    if address is None:
      folder = tempfile.mkdtemp(prefix='realab-')
      stack.callback(shutil.rmtree, folder, ignore_errors=True)
      address = f'unix:{folder}/socket'
    output = storage.new_folder(settings.output)
    evaluation = stack.enter_context(
        evaluations.Evaluation(
            world, design, output, say, control=None, why_no_control=_NO_CONTROL
        )
    )
    evaluation.describe(
        {'design': design}, settings=dataclasses.asdict(settings)
    )
    info = evaluation.info(env, _AGENT, _AGENT, isolation=results.SERVED)

    def add(result: results.EpisodeResult) -> bool:
      evaluation.add(info, result)
      say(
          f'episode {result.episode}: {result.end.value}, true return'
          f' {result.true_return:.1f}, observed {result.observed_return:.1f}'
      )
      return evaluation.counts(result)

    listener = agent_server.Server(
        served_world.ServedWorld(env, settings.num_episodes, add),
        address,
        settings.idle_seconds,
    )
    agent = None
    with _removed_on_error(output):
      listener.start()
      stack.callback(listener.close)
      if settings.agent_command is not None:
        with storage.explained(output):
          agent = agent_process.AgentProcess(
              settings.agent_command,
              listener.address,
              output / 'agent.log',
              on_exit=listener.stop,
          )
        stack.callback(agent.stop)
      say(f'serving {world.domain}.{world.task} at {listener.address}')
      listener.stop_on(signal.SIGTERM)
      listener.stop_on(signal.SIGINT)
      # Takes half a minute, in which the agent starts and its requests wait.
      evaluation.measure()
    listener.run()
    rows = evaluation.rows.get(_AGENT, [])
    asked_for = [
        row for row in rows if not row.is_given_up or evaluation.counts(row)
    ]
    _check_all_written(len(asked_for), settings, agent, output)
    if any(map(evaluation.counts, rows)):
      _, text = evaluation.summarize(f'# {world.domain}.{world.task}')
      say(text)
    say(f'Results are in {settings.output}')


def hide_from_debuggers() -> None:
  """Denies other processes of this user access to memory, on Linux."""
  if sys.platform != 'linux':
    logging.warning(
        'other programs of this user can access the memory of this one; only'
        ' Linux can prevent it'
    )
    return
  if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0):
    raise errors.SpecError(
        'this process cannot be hidden from debuggers:'
        f' {os.strerror(ctypes.get_errno())}'
    )


@contextlib.contextmanager
def _removed_on_error(folder: pathlib.Path) -> Iterator[None]:
  """Removes leftovers so that a corrected command can be rerun."""
  try:
    yield
  except errors.SpecError:
    shutil.rmtree(folder, ignore_errors=True)
    raise


@contextlib.contextmanager
def deadline(seconds: float) -> Iterator[None]:
  """Limits the time of a block of code; for the main thread only.

  Code outside Python is not interrupted before it returns.

  Raises:
    TimeoutError: If the time is exceeded.
  """
  is_over = False

  def on_alarm(*unused: Any) -> None:
    if not is_over:
      raise TimeoutError(f'no answer within {seconds:g} s')

  old_handler = signal.signal(signal.SIGALRM, on_alarm)
  # The timer repeats, because the code may catch the first exception.
  signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
  try:
    yield
  finally:
    is_over = True
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, old_handler)


def _check_all_written(
    num_written: int,
    settings: Settings,
    agent: agent_process.AgentProcess | None,
    output: pathlib.Path,
) -> None:
  if num_written >= settings.num_episodes:
    return
  status = None if agent is None else agent.poll()
  why = (
      'stopped'
      if status is None
      else f'the agent exited with status {status} (see {output / "agent.log"})'
  )
  raise errors.ResultsError(
      f'{why} after {num_written} of {settings.num_episodes} episodes'
  )
