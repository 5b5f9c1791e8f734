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
from realab_suite.engine import seeding
from realab_suite.evaluation import results
from realab_suite.experiments import evaluations
from realab_suite.experiments import served_run
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from realab_suite.interop.rpc import agent_process
from realab_suite.interop.rpc import agent_server
from realab_suite.interop.rpc import served_world

_PR_SET_DUMPABLE = 4  # Of prctl(2).

_WARNING = (
    'the agent may run as the same user as this program (isolation "%s"), so'
    ' its code may access the files and processes of this user. To run it as'
    ' another user, start this program as root with --agent_user'
    ' (docs/doors.md).'
)
_NO_CONTROL = (
    'a served run has no control; give the control the same episodes with'
    ' --repeat, and compare the rows'
)


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of a served run.

  Attributes:
    world: World of the episodes.
    design: Agent design, by name or path.
    overrides: Dotted overrides of the design.
    seed: Seed of the episodes.
    repeat: Path of the record of a run to repeat, or `None` for a new run with
      a new salt. The world, the design and the seed in the record replace those
      here; `overrides` apply to its design.
    num_episodes: Number of episodes, including invalid ones.
    name: Name of the agent in the results.
    address: Address to listen on, or `None` for a socket in a new folder.
    idle_seconds: Maximum time between requests of the agent.
    provider_seconds: Time limit of a provider for one step.
    agent_command: Command that starts the agent, or `None` if it is started
      separately.
    agent_folder: Working directory of the agent, or `None` for a new folder.
    agent_user: User that the agent runs as, or `None` for that of this process.
    output: New folder for the results.
  """

  world: worlds.World
  design: str
  overrides: tuple[str, ...]
  seed: int
  repeat: str | None
  num_episodes: int
  name: str
  address: str | None
  idle_seconds: float
  provider_seconds: float
  agent_command: str | None
  agent_folder: str | None
  agent_user: str | None
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
  owner = (
      None
      if settings.agent_user is None
      else agent_process.owner_of(settings.agent_user)
  )
  if owner is None:
    logging.warning(_WARNING, results.SERVED)
  with contextlib.ExitStack() as stack:
    settings, design, seed = _chosen(settings)
    world = settings.world
    env = stack.enter_context(contextlib.closing(world.load(design, seed)))
    env.mechanism.guard_providers(lambda: deadline(settings.provider_seconds))
    address = settings.address
    if address is None:
      folder = tempfile.mkdtemp(prefix='realab-')
      stack.callback(shutil.rmtree, folder, ignore_errors=True)
      address = f'unix:{folder}/socket'
    output = _make_private_folder(settings.output)
    described = dataclasses.asdict(settings)
    record = {
        'settings': {**described.pop('world'), **described},
        'design': design.to_mapping(),
        'versions': results.versions(),
        'salt': seed.salt.hex(),
    }
    storage.write_sealed(output / served_run.NAME, record)
    evaluation = stack.enter_context(
        evaluations.Evaluation(
            world, design, output, say, control=None, why_no_control=_NO_CONTROL
        )
    )
    info = evaluation.info(
        env, settings.name, settings.name, salt_digest=seed.salt_digest
    )

    def add(result: results.EpisodeResult, isolation: str) -> None:
      of_episode = info.model_copy(update={'isolation': isolation})
      evaluation.add(of_episode, result)
      say(
          f'episode {result.episode}: {result.end.value}, true return'
          f' {result.true_return:.1f}, observed {result.observed_return:.1f}'
      )

    listener = agent_server.Server(
        served_world.ServedWorld(env, address, settings.num_episodes, add),
        address,
        settings.idle_seconds,
        owner,
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
              folder=settings.agent_folder,
              owner=owner,
              on_exit=listener.stop,
          )
        stack.callback(agent.stop)
      say(f'serving {world.domain}.{world.task} at {listener.address}')
      listener.stop_on(signal.SIGTERM)
      # Takes half a minute, in which the agent starts and its requests wait.
      evaluation.measure()
    listener.run()
    rows = evaluation.rows.get(settings.name, [])
    _check_all_written(len(rows), settings, agent, output)
    if any(row.counts for row in rows):
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


def _chosen(
    settings: Settings,
) -> tuple[Settings, specs.DesignSpec, seeding.SaltedSeed]:
  """Returns the settings, the design and the salted seed of a run."""
  if settings.repeat is None:
    design = specs.load(settings.design, settings.overrides)
    seed = seeding.SaltedSeed(settings.seed, seeding.new_salt())
    return settings, design, seed
  record = served_run.read(settings.repeat)
  here = results.versions()
  if record.versions != here:
    logging.warning(
        '%s: the episodes may differ from those recorded: %s',
        settings.repeat,
        storage.difference(record.versions, here, 'versions'),
    )
  design = specs.load(record.design, settings.overrides)
  chosen = dataclasses.replace(
      settings,
      world=record.settings.world,
      design=record.settings.design,
      overrides=(*record.settings.overrides, *settings.overrides),
      seed=record.settings.seed,
  )
  return chosen, design, record.seed


def _make_private_folder(output: str) -> pathlib.Path:
  """Creates the folder of the results, which only this user can enter.

  Raises:
    ResultsError: If it cannot be created or is not empty.
    SpecError: If it belongs to another user, who could replace its contents.
  """
  folder = storage.new_folder(output)
  with storage.explained(folder):
    owner = folder.stat().st_uid
    if owner != os.geteuid():
      raise errors.SpecError(
          f'output: {output} belongs to user {owner}; allowed is a folder of'
          f' user {os.geteuid()}'
      )
    folder.chmod(0o700)
  return folder


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
