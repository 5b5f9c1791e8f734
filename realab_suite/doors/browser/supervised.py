"""Episodes in which a person provides the feedback, in a browser.

The page shows the view of the agent and has one button for each answer. Answers
are logged as a dataset, which the option `recorded` of a design repeats.
"""

from collections import deque
from collections.abc import Callable
import inspect
import json
import pathlib
import time
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite import worlds
from realab_suite.doors.browser import person
from realab_suite.doors.browser import servers
from realab_suite.doors.browser import views
from realab_suite.engine import environment
from realab_suite.entities import protocols
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import tracking
from realab_suite.tasks import base

ANSWERS = 'answers.jsonl'
"""Name of the file of answers."""

# Longest wait for a message, in seconds.
_PATIENCE = 0.2
# Numbers of the pictures in the page: the view, and the earlier clip.
_VIEW, _FIRST_CLIP = 0, 1
_RUN = 'supervised'
_NO_CONTROL = (
    'the person would have to answer again for a control and for stakes'
)
_INTENDED = 'Intended behaviour: '

# Pictures of the earlier and of the later clip, or nothing.
_Clips = tuple[list[bytes], ...]


@final
class Supervision:
  """Shows episodes in the page, asks for answers and logs them."""

  def __init__(
      self,
      env: environment.Environment,
      server: servers.PageServer,
      folder: pathlib.Path,
      rate: float = 10.0,
  ) -> None:
    """Connects the persons of a design to a page.

    Args:
      env: Environment whose design has providers of kind `person` without
        recorded answers.
      server: Server of the page `supervise`.
      folder: Folder of the answers.
      rate: Largest number of control steps per second; 10 is real time.

    Raises:
      SpecError: If the design has no such provider, or two that ask the same.
    """
    self._env, self._server = env, server
    self._allowed = person.answers(len(env.action_set))
    self._folder = folder
    self._period = 1.0 / rate
    design = env.mechanism.design
    people = []
    for provider in design.providers:
      if isinstance(provider, person.Person):
        source = provider.source
        if isinstance(source, person.Live):
          source.connect(self._ask)
          people.append(provider)
    self._asks = [provider.asks for provider in people]
    if not people or len(set(self._asks)) < len(people):
      raise errors.SpecError(
          f'design {design.name!r}: the person at the page is asked for'
          f' {self._asks}; must be one provider of kind person, without'
          ' recorded answers, for each question'
      )
    clips = [p.clip * p.every for p in people if p.asks == person.COMPARISON]
    clip = max(clips, default=1)
    self._task = _intended_behaviour(env.task)
    self._view = views.View(env)
    # Pictures of the control steps of both clips.
    self._pictures: deque[bytes] = deque(maxlen=2 * clip)
    self._question: tuple[dict[str, Any], _Clips] | None = None
    self._is_running = False
    self._deadline = 0.0
    self._given: dict[str, float] = {}
    self._log: list[dict[str, Any]] = []
    self._track: tracking.Track | None = None

  def run(self, policy: Any, episode: int) -> results.EpisodeResult:
    """Runs a supervised episode.

    Args:
      policy: Policy of the agent.
      episode: Number of the episode.
    """
    actors.make(policy, self._env)  # Raises errors before anything is shown.
    [result] = evaluate.evaluate(
        self._env,
        policy,
        1,
        first_episode=episode,
        sinks=[tracking.Tracker(self._env, self._on_step)],
    )
    self._save()
    return result

  def supervise(
      self,
      world: worlds.World,
      name: str,
      policy: Any,
      num_episodes: int,
      say: Callable[[str], None],
  ) -> None:
    """Runs supervised episodes, and writes their rows and their summary.

    Args:
      world: World of the environment.
      name: Name of the policy.
      policy: Policy of the agent.
      num_episodes: Number of episodes.
      say: Called with messages for the user.

    Raises:
      ResultsError: If the rows cannot be written, or all episodes have failed.
    """
    env, folder = self._env, self._folder
    design = env.mechanism.design
    with evaluations.Evaluation(
        world, design, folder, say, control=None, why_no_control=_NO_CONTROL
    ) as evaluation:
      evaluation.describe({'design': design}, policy=name, seed=env.seed)
      info = evaluation.info(env, _RUN, name)
      rows = []
      for episode in range(num_episodes):
        result = self.run(policy, episode)
        evaluation.add(info, result)
        figures = result.true_return, result.observed_return
        rows.append(
            [episode + 1, result.num_steps, *(f'{x:.2f}' for x in figures)]
        )
      _, summary = evaluation.summarize(f'# {world.domain}.{world.task}')
    path = folder / ANSWERS
    self._server.send(
        {
            'type': 'summary',
            'rows': rows,
            'answers': len(path.read_text(encoding='utf-8').splitlines()),
            'folder': str(folder),
        }
    )
    say(f'{summary}\n\nThe answers are in {path}')

  def close(self) -> None:
    """Frees the graphics resources."""
    self._view.close()

  def _on_step(
      self, unused_physics: protocols.Physics, track: tracking.Track
  ) -> None:
    """Shows a control step, and waits for the next one."""
    self._track = track
    if not track.num_steps:
      self._pictures.clear()
    self._pictures.append(self._view.draw())
    if not track.num_steps:
      # Late answers belong to the episode that has ended.
      self._drain()
      self._given.clear()
      self._question = None
    self._show()
    while not (self._is_running and self._server.is_connected):
      self._receive(_PATIENCE)
      self._deadline = time.monotonic()
    # An answer starts the next step at once, and later steps stay on time.
    while not self._given and (left := self._deadline - time.monotonic()) > 0:
      self._receive(left)
    self._deadline = max(self._deadline, time.monotonic()) + self._period

  def _show(self) -> None:
    """Shows the present state, without returns."""
    track = self._track
    if track is None:
      return
    self._server.send(
        {
            'type': 'step',
            'asks': self._asks,
            'task': self._task,
            'episode': track.episode,
            'step': track.num_steps,
            'max_steps': track.max_steps,
            'time': float(track.times[-1]),
        }
    )
    self._server.send_picture(_VIEW, self._pictures[-1])

  def _ask(self, question: person.Question) -> float | None:
    """Returns the answer to a question or an earlier one, or `None`."""
    asks = question.asks
    self._drain()
    if question.waits:
      self._given.pop(asks, None)  # It belongs to an earlier question.
    if bool(question.is_asked) and asks != person.STOP:
      self._open(question)
      while (
          question.waits
          and asks not in self._given
          and person.STOP not in self._given
      ):
        self._receive(_PATIENCE)
    value = self._given.pop(asks, None)
    if value is None:
      return None
    self._question = None
    env, track = self._env, self._track
    self._log.append(
        {
            'seed': env.seed,
            'world': env.world,
            'episode': 0 if track is None else track.episode,
            'step': 1 if track is None else track.num_steps + 1,
            'asks': asks,
            'value': value,
            'action': None if question.query is None else int(question.query),
            'key': np.asarray(question.key).tolist(),
            'time': time.time(),
        }
    )
    return value

  def _open(self, question: person.Question) -> None:
    """Shows a question, which stays open until it is answered."""
    asks = question.asks
    content: dict[str, Any] = {
        'type': 'question',
        'asks': asks,
        'waits': question.waits,
        'action': None,
    }
    actions = self._env.action_set.actions
    if question.query is not None and asks == person.APPROVAL:
      content['action'] = actions[int(question.query)][0]
    if asks == person.CORRECTION:
      content['actions'] = [name for name, _ in actions]
    clips: _Clips = ()
    if asks == person.COMPARISON:
      pictures = list(self._pictures)
      middle = len(pictures) // 2
      clips = (pictures[:middle], pictures[middle:])
    self._question = (content, clips)
    self._show_question()

  def _show_question(self) -> None:
    """Shows the open question, if there is one."""
    if self._question is None:
      return
    content, clips = self._question
    if clips:
      self._server.send({'type': 'clips'})
    for view, clip in enumerate(clips, start=_FIRST_CLIP):
      for picture in clip:
        self._server.send_picture(view, picture)
    self._server.send(content)

  def _drain(self) -> None:
    """Processes the messages that have arrived."""
    while self._receive(0.0):
      pass

  def _receive(self, timeout: float) -> bool:
    """Processes a message; returns False if none arrives in `timeout` s."""
    message = self._server.receive(timeout)
    if message is None:
      return False
    match message:
      case {'type': 'run' | 'pause' as kind}:
        self._is_running = kind == 'run'
      case {'type': 'hello'}:
        # A page that has just been opened shows the button to start.
        self._is_running = False
        self._show()
        self._show_question()
      case {
          'type': 'answer',
          'asks': str(asks),
          'value': int(value),
      } if (
          asks in self._asks and value in self._allowed[asks]
      ):
        self._given[asks] = float(value)
    return True

  def _save(self) -> None:
    """Appends the answers of an episode to the log."""
    path = self._folder / ANSWERS
    with storage.explained(path):
      with open(path, 'a', encoding='utf-8') as file:
        file.writelines(json.dumps(one) + '\n' for one in self._log)
    self._log.clear()


def _intended_behaviour(task: base.Task) -> str:
  """Returns the intended behaviour of a task, as its documentation has it.

  It is in the module of a task, or else in the docstring of its class.
  """
  kind = type(task)
  own = inspect.getdoc(kind) or ''
  for document in (inspect.getdoc(inspect.getmodule(kind)) or '', own):
    _, _, rest = document.partition(_INTENDED)
    if rest:
      return ' '.join(rest.partition('\n\n')[0].split())
  return own.partition('\n')[0]
