"""Tests that failures tell the agent nothing, and the evaluator everything."""

from collections.abc import Callable, Iterator
import re
import sys
import traceback
from typing import Any, NamedTuple

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import agent_view
from realab_suite.evaluation import ledgers
from realab_suite.feedback.providers import constant
from tests.leaks import views

_TEXT = f'in /srv/truth/ledger.bin: the true return\nis {views.CANARY}'
# What no text for an agent may contain; numbers, too, as 1.732317e+02.
_FORBIDDEN = re.compile(
    r'173|1\.73|srv|\.py\b|Traceback|line \d|two_block|station|register|\n'
)
_WORLD_ERROR = re.compile(
    r'error (\d+) of this view: the world failed; '
    r'the evaluator has the exception'
)
_HOOKS = (
    'initialize_episode', 'before_step', 'after_step', 'latch_events',
    'should_terminate_episode', 'get_discount', 'senses',
)  # fmt: skip
# Functions that fail: the objects that have them, by environment, and names.
_PLACES: list[tuple[Callable[[Any], Any], str]] = [
    *((lambda env: env.task, hook) for hook in _HOOKS),
    (lambda env: env.sinks[0], 'step_ended'),
    (lambda env: constant.Constant, 'step'),
]
_ERRORS = [
    lambda: ZeroDivisionError(_TEXT),
    lambda: OSError(2, 'missing', '/srv/truth/ledger.bin'),
    lambda: StopIteration(views.CANARY),
    lambda: composer.EpisodeInitializationError(_TEXT),
    # Agents get errors of these classes, with another text.
    lambda: errors.ActionError(_TEXT),
    lambda: errors.WorldError(_TEXT),
    lambda: errors.ClosedError(_TEXT),
]


class _World(NamedTuple):
  """A world or a batch, its view, an action, and what the evaluator gets."""

  env: Any
  view: Any
  action: np.ndarray
  kept: list[Exception]


@pytest.fixture(name='world', scope='module', params=[0, 2])
def fixture_world(request: pytest.FixtureRequest) -> Iterator[_World]:
  env, kept = views.load(num_envs=request.param), []
  env.add_sink(ledgers.BatchLedger() if request.param else ledgers.Ledger())
  view = views.view_of(env, kept)
  yield _World(env, view, views.walk(view, 1, request.param)[0], kept)
  env.close()


def _complaints(error: BaseException) -> list[Any]:
  """Returns what an error says, or leads to, that it should not."""
  texts = [str(error), *map(str, error.args)]
  found = [text for text in texts if _FORBIDDEN.search(text)]
  found += [error.__cause__, error.__context__, *vars(error).values()]
  frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
  files = {frame.f_code.co_filename for frame in frames}
  found += files - {agent_view.__file__, views.__file__}
  return [one for one in found if one is not None]


def _chain(error: BaseException | None) -> Iterator[BaseException]:
  while error is not None:
    yield error
    error = error.__cause__ or error.__context__


@pytest.mark.parametrize(('owner', 'name'), _PLACES)
def test_what_fails_in_a_world_is_a_number_for_the_agent(
    owner: Any, name: str, world: _World, monkeypatch: Any, capfd: Any
):
  for make in _ERRORS:
    original = make()
    original.add_note(_TEXT)

    def fail(*unused: Any, _original: Any = original, **also: Any) -> Any:
      raise _original from OSError(_TEXT)

    world.view.reset()
    num_kept = len(world.kept)
    with monkeypatch.context() as patch:
      patch.setattr(owner(world.env), name, fail)
      step, reset = world.view.step, world.view.reset
      calls = (step, world.action), (step, world.action), (reset,)
      found = [views.error_of(*call) for call in calls]
    given = [error for error in found if error is not None]
    assert given
    for error in given:
      assert _complaints(error) == []
      if type(error) is errors.ClosedError:
        assert type(original) is errors.ClosedError
        continue
      assert type(error) is errors.WorldError
      [number] = _WORLD_ERROR.fullmatch(str(error)).groups()
      assert int(number) == num_kept
      assert original in _chain(world.kept[num_kept])
      num_kept += 1
    assert num_kept == len(world.kept)
  assert capfd.readouterr() == ('', '')


class _Spy:
  """Looks at the frames below which it runs, and fails."""

  def __init__(self) -> None:
    self.seen: set[str] = set()

  def __array__(self, *unused: Any, **also: Any) -> Any:
    frame: Any = sys._getframe(1)
    while frame:
      self.seen.add(frame.f_globals['__name__'])
      frame = frame.f_back
    raise ZeroDivisionError(_TEXT)


def test_a_hostile_action_is_refused_and_runs_below_no_world(world: _World):
  spy, num_kept = _Spy(), len(world.kept)
  world.view.reset()
  for action in (
      None, 'forwards', b'\x00', np.nan, [], [[1.0], [2.0, 3.0]], {'a': 1}, 1j,
      object(), np.zeros((2, 2, 2)), np.full(6, np.inf), np.array(['a'] * 6),
      spy,
  ):  # fmt: skip
    error = views.error_of(world.view.step, action)
    assert type(error) is errors.ActionError, action
    assert _complaints(error) == []
  assert len(world.kept) == num_kept
  seen = {name for name in spy.seen if name.startswith('realab_suite')}
  assert seen == {agent_view.__name__}
