"""Episodes that a person plays in a browser, with the summary of any agent.

The person acts by keyboard and sees the view of the avatar, as well as the
observed and the true return. The actions are those of `dmlab_like`.
"""

from collections.abc import Callable
import contextlib
import dataclasses
import functools
import math
import time
from typing import Any, final

from realab_suite import policies
from realab_suite import worlds
from realab_suite.engine import environment
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import stakes
from realab_suite.experiments import evaluations
from realab_suite.experiments import result_tables
from realab_suite.experiments import storage
from realab_suite.experiments import tracking
from realab_suite.feedback import specs
from realab_suite.interop.browser import keyboards
from realab_suite.interop.browser import servers
from realab_suite.interop.browser import views

PERSON = 'person'
"""Name of the run of the person."""

# Longest wait for a message, in seconds.
_PATIENCE = 0.2


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of episodes to play.

  Attributes:
    world: World of the episodes.
    design: The design.
    seed: Seed of the episodes.
    num_episodes: Number of episodes.
    rate: Largest number of control steps per second.
    output: New folder for the results, or `None`.
  """

  world: worlds.World
  design: specs.DesignSpec
  seed: int
  num_episodes: int
  rate: float
  output: str | None


def play(
    settings: Settings,
    server: servers.PageServer,
    say: Callable[[str], None],
) -> list[result_tables.Line]:
  """Plays episodes, and compares them with those of a scripted policy.

  Args:
    settings: Settings of the episodes.
    server: Server of the page `play`.
    say: Called with messages for the user.

  Returns:
    The summary of the person and of the control: the solver of the task, or
    random actions if it has none.

  Raises:
    RealabError: If the settings are invalid, before anything is written.
  """
  world, design = settings.world, settings.design
  control = world.solver or stakes.RANDOM
  with contextlib.ExitStack() as stack:
    env = stack.enter_context(
        contextlib.closing(world.load(design, settings.seed))
    )
    session = _Session(env, server, settings)
    stack.callback(session.close)
    keyboard = keyboards.Keyboard(session.take, env.action_set)
    baseline = policies.make(control)
    for policy in (keyboard, baseline):
      actors.make(policy, env)  # Raises errors before anything is written.
    folder = None
    if settings.output is not None:
      folder = storage.new_folder(settings.output)
    evaluation = stack.enter_context(
        evaluations.Evaluation(world, design, folder, say, control=control)
    )
    evaluation.measure()
    described = dataclasses.asdict(settings)
    described['design'] = design.to_mapping()
    evaluation.describe({}, **described)
    recorder = tracking.Tracker(env, session.on_step)
    for name, policy, sinks in (
        (PERSON, keyboard, [recorder]),
        (control, baseline, []),
    ):
      if name == control:
        server.send({'type': 'working', 'text': 'The control acts'})
      info = evaluation.info(env, name, name)
      evaluate.evaluate(
          env,
          policy,
          settings.num_episodes,
          sinks=sinks,
          on_episode=functools.partial(evaluation.add, info),
      )
    lines, text = evaluation.summarize(f'# {session.title}')
    server.send({'type': 'summary', 'text': text})
    say(f'{text}\n\n{session.speed()}')
  return lines


def state(
    track: tracking.Track, title: str, action: str | None
) -> dict[str, Any]:
  """Returns the state of an episode for the page, as plain data without NaN.

  Args:
    track: Track of the episode so far.
    title: Title of the page.
    action: Name of the last action, or `None`.
  """
  registers = []
  for name, register in track.registers.items():
    clean, read = register.clean[-1], register.reading[-1]
    registers.append(
        {
            'name': name,
            'role': register.role,
            'clean': _known(clean),
            'written': _known(register.applied[-1]),
            'read': _known(read),
            'corruption': _known(read - clean),
        }
    )
  return {
      'type': 'state',
      'title': title,
      'episode': track.episode,
      'step': track.num_steps,
      'max_steps': track.max_steps,
      'time': float(track.times[-1]),
      'action': action,
      'true_return': track.true_return,
      'observed_return': track.observed_return,
      'registers': registers,
  }


def _known(value: float) -> float | None:
  return value if math.isfinite(value) else None


@final
class _Session:
  """Shows episodes in the page, and paces them."""

  def __init__(
      self,
      env: environment.Environment,
      server: servers.PageServer,
      settings: Settings,
  ) -> None:
    self._server = server
    self._view = views.first_person(env)
    self._keys = keyboards.Keys()
    self._action_set = env.action_set
    self._period = 1.0 / settings.rate
    world = settings.world
    self.title = f'{world.domain}.{world.task}, {settings.design.name}'
    self._is_running = False
    self._deadline = 0.0
    self._action: str | None = None
    self._track: tracking.Track | None = None
    self._num_steps, self._seconds = 0, 0.0

  def take(self) -> list[str]:
    """Returns the keys of a control step."""
    keys = self._keys.take()
    index = keyboards.action(keys, self._action_set)
    self._action = self._action_set.actions[index][0]
    return keys

  def on_step(self, unused_physics: Any, track: tracking.Track) -> None:
    """Shows a control step, and waits for the next one."""
    if not track.num_steps:
      self._action = None
    self._track = track
    self._show()
    while not (self._is_running and self._server.is_connected):
      self._receive(_PATIENCE)
      self._deadline = time.monotonic() + self._period
    while (left := self._deadline - time.monotonic()) > 0:
      self._receive(left)
    now = time.monotonic()
    if track.num_steps:
      self._num_steps += 1
      self._seconds += now - self._deadline + self._period
    self._deadline = max(self._deadline, now) + self._period

  def _show(self) -> None:
    """Shows the present state."""
    if self._track is not None:
      self._server.send(state(self._track, self.title, self._action))
      self._server.send_picture(0, self._view.draw())

  def speed(self) -> str:
    """Returns the measured speed, as a sentence."""
    rate = self._num_steps / max(self._seconds, 1e-9)
    return f'The person acted in {rate:.1f} control steps per second.'

  def close(self) -> None:
    """Frees the graphics resources."""
    self._view.close()

  def _receive(self, timeout: float) -> None:
    """Processes the messages that arrive within a time, in seconds."""
    match self._server.receive(timeout):
      case {'type': 'down', 'code': str(code)}:
        self._keys.press(code)
      case {'type': 'up', 'code': str(code)}:
        self._keys.release(code)
      case {'type': 'blur'}:
        self._keys.release_all()
      case {'type': 'hello'}:
        # A page that has just been opened waits for a key.
        self._keys.release_all()
        self._is_running = False
        self._show()
      case {'type': 'run' | 'pause' as kind}:
        self._keys.release_all()
        self._is_running = kind == 'run'
