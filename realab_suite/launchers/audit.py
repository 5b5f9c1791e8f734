r"""Audits a design: searches for an exploit of its feedback, without training.

  python -m realab_suite.launchers.audit --task=unlock_door.near \
    --design=instantaneous_reward --output=results/audit
  python -m realab_suite.launchers.audit --experiment=quick --run=reward \
    --output=results/quick

The program prints a report. The exit status is 3 if the design is EXPLOITABLE,
0 if it RESISTED WITHIN BUDGET, 4 if it resisted an audit of one register, or a
budget that was too small for all scripted saboteurs and the search after them,
5 if the audit is UNDECIDED, and 2 if the command is wrong.
With `--output`, the folder gets `audit.json` and, if a renderer works, a film
of the exploit. The output of a run of an experiment is the folder of its sweep,
which gets `audits/<run>.json`, where `report` finds it.
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

_SUBJECT = (*flags.WORLD, flags.TARGET)
flags.take(*_SUBJECT, flags.EXPERIMENT, flags.RUN)
flags.take(flags.IMPORT, flags.OUTPUT, flags.SEED)
flags.take(
    flags.BUDGET,
    help_text='Largest number of episodes of the search. Default: 1200, or more'
    ' if the design has many registers.',
)
_FILM = absl_flags.DEFINE_boolean(
    'film', True, 'Films an exploit that was found.'
)

REPORT = 'audit.json'
_BUDGETS = absl_flags.IntegerParser(10, 1_000_000)
_FILM_NAME = 'exploit.mp4'
# Exit statuses; Python uses 1 for exceptions.
_EXPLOITABLE = 3
_NOT_SUFFICIENT = 4
_UNDECIDED = 5


def main() -> int:
  """Runs the audit that the flags describe, and returns the exit status."""
  has_film, budget = _has_film(), _budget()
  if not has_film:
    renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.evaluation import results
  from realab_suite.lab.audit import audits
  from realab_suite.lab.audit import findings
  from realab_suite.lab.experiments import storage

  flags.load_imports()
  world, design = _subject()
  settings = audits.Settings(
      world=world,
      design=design,
      seed=flags.SEED.value,
      budget=budget,
      target=flags.TARGET.value,
  )
  with _progress() as on_progress:
    auditor = audits.Auditor(settings, on_progress)
    output = flags.OUTPUT.value
    files = None if output is None else _new_files(output)
    result = auditor.run()
  program.say(findings.words(result))
  if files is not None:
    report, new_film = files
    film = None
    if has_film and result.is_exploitable:
      film = new_film
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
    storage.write_json(report, content)
    program.say(f'Results are in {report.parent}')
  if result.is_exploitable:
    return _EXPLOITABLE
  if result.verdict == findings.UNDECIDED:
    return _UNDECIDED
  return 0 if result.is_sufficient else _NOT_SUFFICIENT


def _budget() -> int | None:
  """Returns the largest number of episodes of the search, if it is given."""
  text = flags.BUDGET.value
  try:
    return None if text is None else _BUDGETS.parse(text)
  except ValueError as error:
    raise errors.SpecError(
        f'--budget={text:.80}: must be a number of episodes from'
        f' {_BUDGETS.lower_bound} to {_BUDGETS.upper_bound}'
    ) from error


def _subject() -> tuple[Any, Any]:
  """Returns the world and the design to audit."""
  place, name = flags.EXPERIMENT.value, flags.RUN.value
  if place is None and name is None:
    return flags.world(), flags.design()
  from realab_suite.lab.experiments import experiment_specs
  from realab_suite.lab.experiments import training

  flags.required(flags.EXPERIMENT, ', which goes with --run')
  for flag in _SUBJECT:
    if absl_flags.FLAGS[flag.name].present:
      raise errors.SpecError(
          f'--{flag.name}: not allowed with --experiment; its run has a world'
          ' and a design, of which all registers are audited'
      )
  experiment = experiment_specs.load(place)
  flags.required(flags.RUN, f'; must be one of {list(experiment.runs)}')
  world = experiment.of_run(flags.find_run(experiment.runs, place)).world
  design = experiment.designs[name]
  training.check_learner(design, f'{place}: runs.{name}', is_trained=False)
  return world, design


def _new_files(output: str) -> tuple[pathlib.Path, pathlib.Path]:
  """Returns the paths of the report and of the film, whose folders exist.

  Raises:
    ResultsError: If a file of an earlier audit would be overwritten, or a
      folder cannot be created.
  """
  from realab_suite.lab.experiments import scheduler
  from realab_suite.lab.experiments import storage

  name = flags.RUN.value
  if name is None:
    folder = storage.new_folder(output)
    return folder / REPORT, folder / _FILM_NAME
  folder = pathlib.Path(output)
  # Beside a sweep, the folder of audits has nothing but reports.
  files = (
      folder / scheduler.AUDITS / f'{name}.json',
      folder / f'{name}_{_FILM_NAME}',
  )
  with storage.explained(files[0]):
    files[0].parent.mkdir(parents=True, exist_ok=True)
  for path in files:
    if path.exists():
      raise errors.ResultsError(f'{path} exists, and is never overwritten')
  return files


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
