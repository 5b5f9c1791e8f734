"""Audits with their files: a folder with the result and a film."""

from collections.abc import Callable
import contextlib
import pathlib
from typing import Any

import numpy as np

from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.experiments import audit
from realab_suite.experiments import audit_report
from realab_suite.experiments import audit_worlds
from realab_suite.experiments import scripted
from realab_suite.experiments import storage
from realab_suite.experiments import tracking
from realab_suite.policies import macros

REPORT = 'audit.json'
FILM = 'exploit.mp4'

# Opens a film of an environment: a path and a title.
OpenFilm = Callable[
    [environment.Environment, pathlib.Path, str],
    contextlib.AbstractContextManager[scripted.OnStep],
]


def run(
    settings: audit.Settings,
    output: str | None,
    say: Callable[[str], None],
    film: OpenFilm | None = None,
) -> audit.Audit:
  """Audits a design, and reports the result.

  Args:
    settings: Settings of the audit.
    output: New folder for `audit.json` and the film, or `None` for none.
    say: Called with the report.
    film: Function that opens a film, or `None` for no film. A film shows an
      exploit, so nothing is filmed if none was found.

  Raises:
    RealabError: If the settings are invalid, before anything is written.
  """
  auditor = audit.Auditor(settings)
  folder = None if output is None else scripted.make_folder(output)
  found = auditor.run()
  say(audit_report.words(found))
  if folder is None:
    return found
  path: pathlib.Path | None = None
  if film is not None and found.paths:
    path = folder / FILM
    _film(settings, found, path, film)
    say(f'The film of world {found.world} is {path}')
  storage.write_json(
      folder / REPORT,
      audit_report.as_json(
          found, settings, None if path is None else str(path)
      ),
  )
  say(f'Results are in {folder}')
  return found


def _film(
    settings: audit.Settings,
    found: audit.Audit,
    path: pathlib.Path,
    open_film: OpenFilm,
) -> None:
  """Repeats the policy in one world of the evaluation, and films it."""
  seed = found.seeds['evaluation']
  with contextlib.ExitStack() as stack:
    env = stack.enter_context(
        contextlib.closing(
            settings.world.load(settings.design, seed, found.world)
        )
    )
    env.reset()
    blocks = audit_worlds.targets(env, found.registers)
    plan = macros.Plan(**{n: np.array(v) for n, v in found.plan.items()})
    policy: Any = macros.MacroPolicy(
        plan,
        audit_worlds.starts(env.physics, blocks),
        audit_worlds.codes(blocks),
    )
    title = f'{settings.design.name}: exploit'
    add = stack.enter_context(open_film(env, path, title))
    evaluate.evaluate(env, policy, 1, sinks=[tracking.Tracker(env, add)])
