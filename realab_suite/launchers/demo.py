r"""Trains an agent that tampers, and its secure twin, and films both.

  python -m realab_suite.launchers.demo

The experiment is `quick`. The same command with the same --output continues an
interrupted demonstration. With --trained, agents that ship act instead, for
some seconds.
"""

from collections.abc import Callable, Iterable
import contextlib
import functools
import os
import pathlib
import shlex
import sys
import textwrap
import time

from absl import flags as absl_flags

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.OUTPUT, flags.ACCEPT_OTHER_CODE)
_TRAINED = absl_flags.DEFINE_boolean(
    'trained',
    False,
    'Shows trained agents that ship, in seconds, and trains none.',
)

EXPERIMENT = 'quick'
"""Experiment of the demonstration."""

_NEEDED = {
    'agents': ('jax', 'equinox', 'optax'),
    'report': ('matplotlib', 'jinja2', 'imageio', 'av', 'PIL'),
}
_BEGUN = 'unfinished.mp4'
# A wheel has no docs.
_PUBLISHED = pathlib.Path(__file__).parents[2] / 'docs/results/paper_near'


def main() -> None:
  """Trains, films and reports, or only plays what has been trained."""
  # NumPy and JAX read it once, when they are imported.
  threads.use_one()
  folder = flags.OUTPUT.value or time.strftime('results/demo-%Y%m%d-%H%M%S')
  if _TRAINED.value:
    _play(folder)
  else:
    _train(pathlib.Path(folder))


def _play(output: str) -> None:
  """Plays the trained agents that ship, and films them; needs no JAX.

  Args:
    output: New folder; without a film, none is made.

  Raises:
    RealabError: If a flag has no effect, or the folder cannot be created.
  """
  if flags.ACCEPT_OTHER_CODE.value:
    raise errors.SpecError(
        '--accept_other_code: must not be given with --trained, which has no'
        ' results of other code'
    )
  why_no_film = renderers.why_no_film()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import storage
  from realab_suite.reports import demonstrations

  folder = pathlib.Path(output)
  made = [x for x in (folder, *folder.parents) if not x.exists()]
  if why_no_film is None:
    folder = storage.new_folder(output)
  try:
    played = demonstrations.play_trained()
    _say_wrapped(' '.join(demonstrations.trained_sentences(played)))
    shoot = functools.partial(demonstrations.film_trained, played)
    _film(folder, why_no_film, shoot)
  finally:
    with contextlib.suppress(OSError):  # The film is in it.
      for path in made:
        path.rmdir()


def _train(folder: pathlib.Path) -> None:
  """Trains an agent and its twin, films and reports."""
  for extra, modules in _NEEDED.items():
    if problem := requirements.missing(*modules, extra=extra):
      raise errors.SpecError(f'cannot begin: {problem}')
  why_no_film = renderers.why_no_film()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.engine import arguments
  from realab_suite.lab.experiments import engines
  from realab_suite.lab.experiments import experiment_specs
  from realab_suite.lab.experiments import scheduler
  from realab_suite.lab.experiments import studies
  from realab_suite.lab.verdicts import study
  from realab_suite.reports import demonstrations
  from realab_suite.reports import html_page

  experiment = experiment_specs.load(EXPERIMENT)
  program.say(_beginning(experiment.training.steps, folder))
  accepts = flags.ACCEPT_OTHER_CODE.value
  scheduler.sweep(
      experiment,
      folder,
      engines.Local(arguments.processors()),
      program.say,
      accept_other_code=accepts,
  )
  sweep = studies.read_sweep(folder, accepts)
  _film(folder, why_no_film, functools.partial(demonstrations.film, sweep))
  told = demonstrations.sentences(sweep, study.judge(sweep))
  _say_wrapped(f'\n{" ".join(told)}')
  page = html_page.write(folder, folder, lambda line: None, accepts)
  program.say(f'\nThe report, with learning curves, is {page}\n')
  for line in _next(folder):
    program.say(line)


def _film(
    folder: pathlib.Path,
    why_no_film: str | None,
    shoot: Callable[[pathlib.Path], str],
) -> None:
  """Writes the film of a demonstration, or says why there is none.

  Args:
    folder: Folder of the film, unless there is none.
    why_no_film: Reason why films cannot be made, or `None`.
    shoot: Writes the film that it is given, and returns what that shows.
  """
  # Imports numpy.
  from realab_suite.lab.experiments import storage

  if why_no_film is None:
    begun, film = folder / _BEGUN, folder / storage.FILM
    begun.unlink(missing_ok=True)
    try:
      shown = shoot(begun)
      begun.replace(film)
      _say_wrapped(f'\nThe film {film} shows {shown}')
    except errors.RealabError as error:
      why_no_film = str(error)
    finally:
      begun.unlink(missing_ok=True)
  if why_no_film is not None:
    _say_wrapped(f'\nThere is no film: {why_no_film}')


def _beginning(steps: int, folder: pathlib.Path) -> str:
  """Returns the text before the training."""
  again = _command('demo', f'--output={folder}')
  return f"""\
Two agents learn to take apples for {steps:,} steps each. The large apple is
behind a door, which a pad opens. No reward is sent to the agents: they read it
from two blocks in their room, whose distance is the number.
  reward               is an agent that can move its blocks
  reward.secure        is its twin: nothing can move the twin's blocks
  reward.apple_seeker  is a script that takes the apples
  reward.random        acts at random
This takes five to ten minutes on two processors. To continue it after a stop:
  {again}
"""


def _say_wrapped(text: str) -> None:
  """Says a paragraph in lines of 80 characters."""
  wrapped = textwrap.fill(
      text,
      80,
      replace_whitespace=False,
      break_long_words=False,
      break_on_hyphens=False,
  )
  program.say(wrapped)


def _next(folder: pathlib.Path) -> Iterable[str]:
  """Yields what to do next."""
  yield 'What comes next:'
  if _PUBLISHED.is_dir():
    yield '* the same with ten seeds, which were trained for longer:'
    yield '  ' + _command(
        'report',
        f'--input={os.path.relpath(_PUBLISHED)}',
        '--output=results/paper_near',
    )
  else:
    yield '* scripts instead of agents: one does the task, one tampers:'
    yield '  ' + _command(
        'compare',
        '--task=unlock_door.near',
        '--set=dof=planar',
        '--output=results/compare',
    )
  yield '* can this reward be exploited? An audit says it without training:'
  yield '  ' + _command(
      'audit',
      '--task=unlock_door.near',
      '--design=instantaneous_reward',
      '--set=dof=planar',
      '--output=results/audit',
  )
  yield '* an experiment of your own, from a copy of this one:'
  copied = shlex.join(['cp', f'{folder / "experiment.yaml"}', 'mine.yaml'])
  mine = ('--experiment=mine.yaml', '--output=results/mine')
  yield f'  {copied} && {_command("sweep", *mine)}'


def _command(*arguments: str) -> str:
  """Returns a command of `realab`, of the installation that runs."""
  path = pathlib.Path(sys.executable).with_name('realab')
  name = 'realab'
  # `make demo` runs it from a folder in which shells do not look, and so do
  # `uvx` and `uv run`, which add that folder for this process alone.
  is_found = str(path.parent) in os.get_exec_path() and 'UV' not in os.environ
  if path.exists() and not is_found:
    name = min(os.path.relpath(path), str(path), key=len)
  return shlex.join([name, *arguments])


if __name__ == '__main__':
  program.start(main)
