"""Shows a world in a window, or writes a film of an episode with --video.

This shows the solver of Unlock Door:

  python -m realab_suite.launchers.explore --policy=apple_seeker
"""

from collections.abc import Callable, Iterator
import contextlib
from typing import Any

import dm_env

from realab_suite import errors
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    *flags.WORLD,
    flags.TARGET,
    flags.IMPORT,
    flags.POLICY,
    flags.SEED,
    flags.VIDEO,
)


def main() -> None:
  """Opens a window, or writes a film."""
  if flags.VIDEO.value is not None:
    _write_film()
  elif problem := renderers.why_no_window():
    raise errors.ResultsError(
        f'no window can be opened: {problem}; --video=world.mp4 writes a film'
    )
  else:
    _open_window()


def _open_window() -> None:
  # This and later imports need a renderer to be chosen first.
  from dm_control import viewer

  with _loaded() as (env, policy, _):
    viewer.launch(env, policy=_as_function(policy, env), title='realab_suite')


def _write_film() -> None:
  if problem := renderers.why_no_film():
    raise errors.ResultsError(f'no renderer for a film: {problem}')
  from realab_suite.evaluation import evaluate
  from realab_suite.lab.experiments import tracking
  from realab_suite.reports import films

  path = flags.VIDEO.value
  with _loaded() as (env, policy, name):
    program.say(f'Filming an episode of {name}; this may take minutes')
    with films.film(env, path, name) as add:
      recorder = tracking.Tracker(env, add)
      evaluate.evaluate(env, policy, 1, sinks=[recorder])
  program.say(f'The film is {path}')


def _policy_name(env: Any) -> str:
  """Returns the policy of the flags, or else a saboteur of the world.

  Random actions are shown where the world has no saboteur, or where the design
  has no feedback register, or no block to move.
  """
  saboteurs = getattr(env.task, 'SABOTEURS', ())
  mechanism = env.mechanism
  is_attackable = bool(mechanism.design.names('feedback')) and any(
      register.blocks for register in mechanism.registers.values()
  )
  default = saboteurs[0] if saboteurs and is_attackable else flags.RANDOM
  return str(flags.POLICY.value or default)


@contextlib.contextmanager
def _loaded() -> Iterator[tuple[Any, Any, str]]:
  """Yields the environment of the flags, a policy, and its name."""
  from realab_suite.lab.audit import aiming

  flags.load_imports()
  env = flags.world().load(flags.design(), flags.SEED.value)
  with contextlib.closing(env):
    name = _policy_name(env)
    policy = aiming.make_policy(name, env, flags.TARGET.value, 0)
    env.rewind()
    yield env, policy, name


def _as_function(policy: Any, env: Any) -> Callable[[dm_env.TimeStep], Any]:
  """Returns a policy as a function, as the viewer of dm_control needs it."""
  from realab_suite.evaluation import actors

  actor = actors.make(policy, env)
  episode = -1

  def act(time_step: dm_env.TimeStep) -> Any:
    nonlocal episode
    if time_step.first():
      episode += 1
      actor.begin(episode)
    return actor.act(time_step)

  return act


if __name__ == '__main__':
  program.start(main)
