"""Provoked failures, and the errors that agents get from them: campaign C17."""

from collections.abc import Callable, Iterator
import contextlib
import re
from typing import Any, Literal, NamedTuple, final

from dm_control import composer
from dm_control.rl import control
import numpy as np

from realab_suite import errors
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.feedback import providers
from tests.engine import helpers
from tests.leaks import pairs
from tests.leaks import secrets

_PATH = '/srv/truth/ledger.bin'
_TOLD = (errors.ActionError, errors.ClosedError, errors.WorldError)
# Patterns that no text for an agent may match.
_FORBIDDEN = {
    'the canary': re.compile(r'173\.23|1\.732317'),
    'a path': re.compile(r'(?<![\w.])[/\\][A-Za-z_][\w.-]*[/\\]|\.py\b'),
    'a traceback': re.compile(r'Traceback|File "|line \d+'),
    'a spec': re.compile(
        r'two_block|station_|no_meters|unread_meter|providers?\[|register'
    ),
    'another line': re.compile(r'\n'),
}
_WORLD_ERROR = re.compile(
    r'error \d+ of this view: the world failed; the evaluator has the exception'
)
_OURS = (agent_view.__file__, __file__)


@final
class FailingProvider(providers.Provider):
  """Fails in a given way, with a message that must not reach an agent.

  Attributes:
    how: One of `_FAILURES`.
  """

  kind: Literal['leaks_failing'] = 'leaks_failing'
  how: str

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[Any, Any]:
    return _FAILURES[self.how](np.full(np.shape(episode_start), 1.0)), state


def _raise(error: BaseException) -> Callable[..., Any]:
  def fail(*args: Any, **kwargs: Any) -> Any:
    raise error

  return fail


def _raise_from(cause: BaseException, error: BaseException) -> Any:
  def fail(*args: Any, **kwargs: Any) -> Any:
    error.add_note(f'the score was {secrets.CANARY}')
    raise error from cause

  return fail


_FAILURES: dict[str, Callable[[np.ndarray], Any]] = {
    'raises': _raise(ValueError(f'score was {secrets.CANARY}')),
    'raises a path': _raise(OSError(2, 'missing', _PATH)),
    'raises what agents are told': _raise(errors.ActionError(_PATH)),
    'returns a text': lambda value: {'reward': f'score {secrets.CANARY}'},
    'returns nothing': lambda value: None,
    'returns another key': lambda value: {f'score_{secrets.CANARY}': value},
    'returns another shape': lambda v: {'reward': np.full(7, secrets.CANARY)},
    'returns no number': lambda value: {'reward': value * np.nan},
    'returns too much': lambda value: {'reward': value * secrets.CANARY},
}


def _errors() -> list[Callable[..., Any]]:
  """Functions that raise what a task, a sink or a library might."""
  canary = f'the true return is {secrets.CANARY}'
  return [
      _raise(ValueError(canary)),
      _raise(ZeroDivisionError(f'in {_PATH}: {canary}')),
      _raise(OSError(2, 'missing', _PATH)),
      _raise(errors.ActionError(canary)),
      _raise(errors.ClosedError(canary)),
      _raise(errors.RegisterValueError(f"register 'score': {canary}")),
      _raise(errors.SpecError(f'{_PATH}: registers.score.range')),
      _raise(composer.EpisodeInitializationError(canary)),
      _raise(control.PhysicsError(canary)),
      _raise(AssertionError(canary)),
      _raise(StopIteration(secrets.CANARY)),
      _raise_from(ValueError(canary), errors.WorldError(_PATH)),
      _raise_from(OSError(_PATH), errors.ActionError(canary)),
  ]


_HOOKS = (
    'initialize_episode',
    'before_step',
    'after_step',
    'latch_events',
    'should_terminate_episode',
    'get_discount',
    'senses',
)
# Arrays, objects and numbers that are no actions; some try to be funny.
_HOSTILE: tuple[Any, ...] = (
    None,
    'forwards',
    b'\x00',
    np.nan,
    [],
    [[1.0], [2.0, 3.0]],
    {'env': 'step'},
    object(),
    1j,
    np.zeros((2, 2, 2)),
    np.full(6, np.nan),
    np.full(6, np.inf),
    np.full(6, 1e300),
    np.zeros(6, bool),
    np.array(['a'] * 6),
)


class Provoked(NamedTuple):
  """A failure.

  Attributes:
    how: The way in which it was provoked.
    error: The agent's error, or `None` if it got an ordinary time step.
  """

  how: str
  error: BaseException | None


def provoke(num_envs: int, seed: int) -> Iterator[Provoked]:
  """Yields about 120 failures of one world or many."""
  case = pairs.Case(seed=seed, num_envs=num_envs, steps=2)
  env = case.load()
  secrets.SECRETS['reward: the canary'].change(env)
  kept: list[Exception] = []
  view = pairs.view_of(env, kept)
  actions = pairs.walk(view.action_spec(), case)
  view.reset()
  for hostile in _HOSTILE:
    yield Provoked(f'action {hostile!r:.20}', _error(view.step, hostile))
  for hook in _HOOKS:
    for fail in _errors():
      view.reset()
      setattr(env.task, hook, fail)
      # What fails in a reset does so here.
      yield Provoked(f'{hook} in step', _error(view.step, actions[0]))
      yield Provoked(f'{hook} in reset', _error(view.reset))
      delattr(env.task, hook)
  for fail in _errors():
    sink = _failing_sink(env, fail)
    env.add_sink(sink)
    yield Provoked('sink', _error(view.reset))
    yield Provoked('sink', _error(view.step, actions[0]))
    env.remove_sink(sink)
  env.close()
  yield Provoked('closed environment', _error(view.step, actions[0]))
  yield Provoked('closed environment', _error(view.reset))
  view.close()
  for method in (view.reset, view.action_spec, view.observation_spec):
    yield Provoked('closed view', _error(method))
  if not kept:
    yield Provoked('silence', ValueError('the evaluator was told of nothing'))


def provoke_providers(num_envs: int, seed: int) -> Iterator[Provoked]:
  """Yields failures of feedback providers."""
  with helpers.registered(
      providers.PROVIDERS, 'leaks_failing', FailingProvider
  ):
    for how in _FAILURES:
      design = {
          **secrets.NO_METERS,
          'providers': [
              {'kind': 'leaks_failing', 'how': how, 'writes': ['reward']}
          ],
      }
      case = pairs.Case(seed=seed, num_envs=num_envs, steps=2)
      env = case.load(design=design)
      view = pairs.view_of(env)
      actions = pairs.walk(view.action_spec(), case)
      for _ in range(3):
        view.reset()
        yield Provoked(f'provider {how}', _error(view.step, actions[0]))
      env.close()


def _failing_sink(env: Any, fail: Callable[..., Any]) -> Any:
  """An evaluator that fails."""
  if not isinstance(env, environment.Environment):
    return _FailingBatchSink(fail)
  sink = helpers.RecordingSink()
  sink.step_ended = fail  # type: ignore[method-assign]
  return sink


class _FailingBatchSink(events.BatchEventSink):
  """The same for many worlds."""

  def __init__(self, fail: Callable[..., Any]) -> None:
    self._fail = fail

  def step_ended(self, step: events.BatchStep) -> None:
    self._fail()


def _error(call: Callable[..., Any], *arguments: Any) -> BaseException | None:
  try:
    call(*arguments)
  except Exception as error:  # Whatever it is, the agent gets it.
    return error
  return None


def complaints(provoked: Provoked) -> Iterator[str]:
  """Yields what an exception says that it should not."""
  error = provoked.error
  if error is None:
    return
  if type(error) not in _TOLD:
    yield f'{provoked.how}: {type(error).__name__}'
  if isinstance(error, errors.WorldError):
    if not _WORLD_ERROR.fullmatch(str(error)):
      yield f'{provoked.how}: {error}'
  if error.__cause__ is not None or error.__context__ is not None:
    yield f'{provoked.how}: what it came from'
  said = [str(error), *map(repr, error.args), *getattr(error, '__notes__', [])]
  for text in (*said, repr(vars(error))):
    yield from (f'{provoked.how}: {c}' for c in complaints_about_text(text))
  trace = error.__traceback__
  while trace:
    if trace.tb_frame.f_code.co_filename not in _OURS:
      yield f'{provoked.how}: a frame of {trace.tb_frame.f_code.co_filename}'
    trace = trace.tb_next


def complaints_about_text(text: str) -> Iterator[str]:
  """Yields what is in a text that should not be."""
  for what, pattern in _FORBIDDEN.items():
    if pattern.search(text):
      yield f'{what} in {text!r:.80}'


class Counts(NamedTuple):
  """Numbers of failures and of their kinds, and the faults found."""

  num_failures: int
  num_kinds: int
  found: list[str]


def scan(seeds: int, first_seed: int = 0, whole: bool = True) -> Counts:
  """Provokes failures and scans the texts that they produce.

  Args:
    seeds: Number of seeds; about 250 failures each, if `whole`.
    first_seed: The first of them.
    whole: If `True`, providers and many worlds fail, too.
  """
  found: list[str] = []
  errors_seen: list[str] = []
  with contextlib.ExitStack() as stack:
    heard = stack.enter_context(pairs.listening())
    for seed in range(first_seed, first_seed + seeds):
      sources = [provoke(0, seed)]
      if whole:
        sources += [
            provoke(2, seed),
            provoke_providers(0, seed),
            provoke_providers(2, seed),
        ]
      for source in sources:
        for provoked in source:
          if provoked.error is not None:
            errors_seen.append(provoked.how)
          found += complaints(provoked)
    for text in heard():
      if text not in (b'', b'[]'):
        found += complaints_about_text(text.decode(errors='replace'))
  return Counts(len(errors_seen), len(set(errors_seen)), found)
