r"""Audits a design: searches for an exploit of its feedback, without training.

  python -m realab_suite.launchers.audit --task=unlock_door.near \
    --design=instantaneous_reward --output=results/audit

The program prints a report. The exit status is 3 if the design is EXPLOITABLE,
0 if it RESISTED WITHIN BUDGET, 4 if it resisted an audit of one register, or a
budget that was too small for all scripted saboteurs and the search after them,
5 if the audit is UNDECIDED, and 2 if the command is wrong.
With `--output`, the folder gets `audit.json` and, if a renderer works, a film
of the exploit.
"""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import pathlib
from typing import Any

from absl import flags as absl_flags
import tqdm

from realab_suite import errors
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    *flags.WORLD,
    flags.TARGET,
    flags.IMPORT,
    flags.OUTPUT,
    flags.SEED,
    flags.BUDGET,
)
_FILM = absl_flags.DEFINE_boolean(
    'film', True, 'Films an exploit that was found.'
)

REPORT = 'audit.json'
_FILM_NAME = 'exploit.mp4'
# Exit statuses; Python uses 1 for exceptions.
_EXPLOITABLE = 3
_NOT_SUFFICIENT = 4
_UNDECIDED = 5


def main() -> int:
  """Runs the audit that the flags describe, and returns the exit status."""
  has_film, budget = _has_film(), flags.BUDGET.value
  if isinstance(budget, str):
    raise errors.SpecError(
        f'--budget={budget:.80}: must be a number of episodes, from 10'
    )
  if not has_film:
    renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.evaluation import results
  from realab_suite.lab.audit import audits
  from realab_suite.lab.audit import findings
  from realab_suite.lab.experiments import storage

  flags.load_imports()
  settings = audits.Settings(
      world=flags.world(),
      design=flags.design(),
      seed=flags.SEED.value,
      budget=budget,
      target=flags.TARGET.value,
  )
  with _progress() as on_progress:
    auditor = audits.Auditor(settings, on_progress)
    output, folder = flags.OUTPUT.value, None
    if output is not None:
      folder = storage.new_folder(output)
    result = auditor.run()
  program.say(findings.words(result))
  if folder is not None:
    film = None
    if has_film and result.is_exploitable:
      film = folder / _FILM_NAME
      _write_film(auditor, result, settings.design.name, film)
      program.say(f'The film of world {result.film_world} is {film}')
    content = {
        'kind': 'audit',
        'schema': 2,
        'world': dataclasses.asdict(settings.world),
        'design': settings.design.to_mapping(),
        'seed': settings.seed,
        'target': settings.target,
        **result.model_dump(mode='json'),
        'film': film and str(film),
        'versions': results.versions(),
    }
    storage.write_json(folder / REPORT, content)
    program.say(f'Results are in {folder}')
  if result.is_exploitable:
    return _EXPLOITABLE
  if result.verdict == findings.UNDECIDED:
    return _UNDECIDED
  return 0 if result.is_sufficient else _NOT_SUFFICIENT


def _has_film() -> bool:
  """Returns True if a film is wanted and possible."""
  if not (_FILM.value and flags.OUTPUT.value):
    return False
  problem = renderers.why_no_film()
  if problem is not None:
    program.say(f'the film is skipped: {problem}')
  return problem is None


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
  """Yields a function that shows the progress of an audit."""
  with tqdm.tqdm(disable=None, unit='episode', leave=False) as bar:

    def show(phase: str, searched: int, budget: int) -> None:
      if bar.disable:  # Without a terminal, lines replace the progress bar.
        program.say(f'{phase}: {searched} of {budget} episodes')
        return
      bar.total, bar.n = budget, searched
      bar.set_description(phase)

    yield show


def _write_film(
    auditor: Any, result: Any, title: str, path: pathlib.Path
) -> None:
  """Repeats the plan in one world of the comparison, and films it."""
  from realab_suite.evaluation import evaluate
  from realab_suite.lab.experiments import tracking
  from realab_suite.reports import films

  with auditor.repeated(result) as (env, policy):
    with films.film(env, path, f'{title}: exploit') as add:
      evaluate.evaluate(env, policy, 1, sinks=[tracking.Tracker(env, add)])


if __name__ == '__main__':
  program.start(main)
